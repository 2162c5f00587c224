r"""The same sheet in mvest and in another finite element library, timed side by side.

A square sheet of linear tetrahedra, clamped on its four sides, is inflated from below by a follower
pressure in one static step. All libraries get the same nodes, elements, law (St Venant-Kirchhoff),
load and convergence criterion, and start from the flat sheet; so the deflections must agree, and
what differs is the time. The peer is felupe; if it is not installed, its row says so. One more row
per mesh factorises and solves mvest's tangent and does nothing else: the least cost of an iteration
with this direct solver.

felupe solves with PARDISO, as its documentation advises. What is set up once (mesh, sparsity
pattern) is not timed; the symbolic analysis of the matrix is. All take turns, so that load of the
machine slows all of them alike.

    python -m tests.benchmark.peers [OUTPUT.json]

All use one thread, which the package of this module sees to before any of them is imported.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

import mvest
from mvest.mechanics import (
    Loads,
    NewtonSettings,
    Simulation,
    Step,
    System,
    box,
    outer_faces,
    simulate,
)
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.law import Points
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import linear_solver
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

MESHES = ((40, 40, 1), (60, 60, 1))
SIZE = (20.0, 20.0, 1.3)
"""mm."""
YOUNG, POISSON = 2.0, 0.45
"""Young's modulus in MPa and Poisson's ratio."""
PRESSURE = 0.002
"""MPa."""
TOLERANCE = 1e-8
"""Residual at which Newton's method stops, over the forces that the residual is made of."""
MAX_ITERATIONS = 16
REPEATS = 6
"""Whole solves by each library; the first is not counted."""
AGREEMENT = 1e-6
"""Relative difference of the deflections from mvest's above which the comparison is void."""

Row = dict[str, Any]

MU = YOUNG / (2 * (1 + POISSON))
LAMBDA = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))


class Solved(NamedTuple):
    """One solve: its Newton iterations and how far the centre moved up (mm), if it did."""

    iterations: int
    deflection: float | None


class Candidate(NamedTuple):
    """A library with the sheet set up, ready to be solved again and again."""

    version: str
    note: str
    solve: Callable[[], Solved]


class Sheet:
    """The mesh that all libraries share: ``(n, 3)`` nodes in mm and ``(m, 4)`` elements."""

    def __init__(self, cells: tuple[int, int, int]) -> None:
        self.nodes, self.elements = box("tet4", cells, SIZE)
        faces = outer_faces(self.elements, "tet4")
        self.under = faces[np.all(self.nodes[faces][:, :, 2] == 0, axis=1)]
        plane = self.nodes[:, :2]
        self.clamped = np.flatnonzero(np.any((plane == 0) | (plane == SIZE[:2]), axis=1))
        middle = (SIZE[0] / 2, SIZE[1] / 2, 0.0)
        self.centre = int(np.argmin(np.linalg.norm(self.nodes - middle, axis=1)))


class SaintVenantKirchhoff:
    """The law ``S = C E`` with constant isotropic moduli, for one region."""

    kinds: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.moduli = np.diag([2 * MU] * 3 + [MU] * 3)
        self.moduli[:3, :3] += LAMBDA

    def strain(self, green: FloatArray) -> FloatArray:
        """The Green-Lagrange strain itself; nothing is damped."""
        return green

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)``."""
        stress = (at.green.reshape(-1, 6) @ self.moduli).reshape(at.green.shape)
        return stress, np.tile(self.moduli, (*at.green.shape[:2], 1, 1))


def own_body(sheet: Sheet) -> tuple[System, Loads]:
    """The sheet in mvest."""
    region = np.zeros(len(sheet.elements), dtype=np.int64)
    fibre = np.broadcast_to([1.0, 0.0, 0.0], sheet.nodes.shape).copy()
    mesh = SolidMesh(
        sheet.nodes, sheet.elements, "tet4", region, ("sheet",), fibre, sheet.under
    )  # fmt: skip
    load = PressureLoad(mesh.pressure_faces, mesh.reference.face)
    system = System(Solid(mesh, SaintVenantKirchhoff()), pressure=load, fixed_nodes=sheet.clamped)
    return system, Loads(pressure=PRESSURE, fixed=sheet.nodes[sheet.clamped])


def inflated(system: System, loads: Loads) -> Simulation:
    """One static step, with a solver that has not seen the matrix before."""
    newton = NewtonSettings(tolerance=TOLERANCE, max_iterations=MAX_ITERATIONS)
    steps = [Step(1.0, static=True)]
    result = simulate(system, lambda _: loads, steps, newton=newton, solver=linear_solver())
    if not result.converged:
        raise RuntimeError(f"mvest: {result.reason.value}")
    return result


def with_mvest(sheet: Sheet) -> Candidate:
    """The sheet in mvest."""
    body = own_body(sheet)

    def solve() -> Solved:
        result = inflated(*body)
        return Solved(result.iterations, float(result.frames[-1, sheet.centre, 2]))

    return Candidate(mvest.__version__, f"solver {linear_solver().name}", solve)


def factor_alone(sheet: Sheet) -> Candidate:
    """Factorising and solving mvest's tangent of the inflated sheet, analysed beforehand."""
    system, loads = own_body(sheet)
    x, strain = inflated(system, loads).frames[-1], system.solid.initial_strain()
    state = system.evaluate(x, loads, None, strain, 0.0, tangent=True)
    assert state.blocks is not None
    matrix = system.matrix(state.blocks, 0.0)
    right = np.ones(matrix.shape[0])
    solver = linear_solver()
    solver.factorize(matrix)

    def solve() -> Solved:
        solver.factorize(matrix)
        solver.solve(right)
        return Solved(1, None)

    version = metadata.version("mkl" if solver.name == "pardiso" else "scipy")
    return Candidate(version, f"{solver.name}, mvest's tangent", solve)


def with_felupe(sheet: Sheet) -> Candidate:
    """The sheet in felupe."""
    import felupe as fem
    from pypardiso import spsolve

    eye = np.eye(3)[:, :, None, None]

    def second(f: FloatArray) -> FloatArray:
        green = 0.5 * (np.einsum("ki...,kj...->ij...", f, f) - eye)
        return LAMBDA * np.trace(green) * eye + 2 * MU * green

    def stress(x: list[Any]) -> list[Any]:
        f, state = x[0], x[-1]
        return [np.einsum("ik...,kj...->ij...", f, second(f)), state]

    def elasticity(x: list[Any]) -> list[Any]:
        f = x[0]
        s = second(f)
        left = np.einsum("ik...,jk...->ij...", f, f)
        moduli = LAMBDA * np.einsum("ij...,kl...->ijkl...", f, f)
        moduli += MU * np.einsum("il...,kj...->ijkl...", f, f)
        for i in range(3):
            moduli[i, :, i, :] += s
            moduli[:, i, :, i] += MU * left
        return [moduli]

    region = fem.RegionTetra(fem.Mesh(sheet.nodes, sheet.elements, "tetra"))
    solid = fem.SolidBody(
        fem.Material(stress, elasticity), fem.FieldContainer([fem.Field(region, dim=3)])
    )
    load = fem.SolidBodyPressure(
        fem.FieldContainer([fem.Field(_felupe_underside(sheet), dim=3)]), pressure=PRESSURE
    )
    held = (3 * sheet.clamped[:, None] + np.arange(3)).ravel()
    free = np.setdiff1d(np.arange(sheet.nodes.size), held)

    def check(dx: FloatArray, f: Any, ftol: float, **_: Any) -> tuple[float, float, bool]:
        relative = float(np.linalg.norm(f[free]) / np.linalg.norm(f))
        return float(np.linalg.norm(dx)), relative, relative <= ftol

    def solve() -> Solved:
        result = fem.newtonraphson(
            items=[solid, load],
            x0=fem.FieldContainer([fem.Field(region, dim=3)]),
            dof0=held,
            dof1=free,
            ext0=np.zeros(len(held)),
            solver=spsolve,
            tol=TOLERANCE,
            maxiter=MAX_ITERATIONS,
            check=check,
            verbose=0,
        )
        return Solved(result.iterations, float(result.x[0].values[sheet.centre, 2]))

    return Candidate(metadata.version("felupe"), "solver pypardiso.spsolve", solve)


def _felupe_underside(sheet: Sheet) -> Any:
    """Region of the faces underneath; felupe has boundary regions of bricks only.

    The tetrahedra above the faces, the corners of the face first, with one quadrature point in the
    middle of the face: exact, for the deformation gradient is constant.
    """
    import felupe as fem

    on = np.isin(sheet.elements, sheet.under)
    above = on.sum(axis=1) == 3
    order = np.argsort(~on[above], axis=1, kind="stable")
    cells = np.take_along_axis(sheet.elements[above], order, axis=1)
    edges = np.diff(sheet.nodes[cells], axis=1)
    inverted = np.linalg.det(edges) < 0
    cells[inverted] = cells[inverted][:, [1, 0, 2, 3]]
    middle = fem.quadrature.Scheme(np.array([[1 / 3, 1 / 3, 0.0]]), np.array([0.5]))
    region = fem.RegionTetra(fem.Mesh(sheet.nodes, cells, "tetra"), quadrature=middle)
    region.dV = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)[None, :]
    region.normals = np.tile(np.array([0.0, 0.0, -1.0])[:, None, None], (1, 1, len(cells)))
    return region


def measure(sheet: Sheet) -> list[Row]:
    """Rows of all libraries, mvest first."""
    candidates: dict[str, Candidate] = {}
    missing: list[Row] = []
    for name, prepare in PREPARE.items():
        try:
            candidates[name] = prepare(sheet)
        except ImportError as error:
            missing.append({"library": name, "note": f"not importable: {error}"})
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    solved: dict[str, Solved] = {}
    for _ in range(REPEATS):
        for name, candidate in candidates.items():
            start = time.process_time()
            solved[name] = candidate.solve()
            seconds[name].append((time.process_time() - start) / solved[name].iterations)
    expected = solved["mvest"].deflection
    rows: list[Row] = []
    for name, own in candidates.items():
        moved = solved[name].deflection
        rows.append({
            "library": name, "version": own.version, "nodes": len(sheet.nodes),
            "seconds_per_iteration": float(np.median(seconds[name][1:])),
            "iterations": solved[name].iterations, "deflection_mm": moved,
            "difference": None if moved is None else abs(moved / expected - 1), "note": own.note,
        })  # fmt: skip
    return rows + missing


PREPARE: dict[str, Callable[[Sheet], Candidate]] = {
    "mvest": with_mvest,
    "felupe": with_felupe,
    "factor + solve alone": factor_alone,
}


def main(arguments: list[str]) -> str | None:
    """Print the rows and write them to the named file; returns what is wrong, if anything."""
    rows = [row for cells in MESHES for row in measure(Sheet(cells))]
    print(pd.DataFrame(rows).to_string(index=False))
    if arguments:
        Path(arguments[0]).write_text(json.dumps({"rows": rows}, indent=2) + "\n")
    apart = [row["library"] for row in rows if not (row.get("difference") or 0.0) < AGREEMENT]
    return f"deflections differ from mvest's: {', '.join(apart)}" if apart else None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
