"""Thin shells against published answers: ``python -m tests.verification.shells`` writes the tables.

Three problems of Sze, Liu and Lo (2004, Finite Elements in Analysis and Design 40:1551), whose
tables of load and deflection come from four-node shell elements on fine meshes: a cantilever under
a shear force at its end, a slit annular plate lifted at one lip of the slit, and a hemisphere with
a hole of 18 degrees that is pulled and pushed at its rim. Units are those of the publication.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from mvest.elements import element
from mvest.files import write_atomically
from mvest.mechanics.body import box, simulate_body
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.steps import Simulation
from mvest.typing import BoolArray, FloatArray, IntArray
from tests.places import ROOT
from tests.tables import markdown, write_text

ELEMENTS = ("hex18", "wedge12", "tet10")
"""``hex27`` and ``wedge18`` are as ``hex18`` and ``wedge12`` to three digits."""


class Loaded(NamedTuple):
    """A mesh with the largest load, its supports, and nodes and directions of two deflections."""

    nodes: FloatArray  # (n, 3)
    elements: IntArray
    forces: FloatArray  # (n, 3)
    fixed: BoolArray  # (n, 3)
    measured: tuple[tuple[IntArray, tuple[float, float, float]], ...]

    def deflections(self, frames: FloatArray) -> FloatArray:
        """Both ``(f, 2)`` of the frames ``(f, n, 3)``."""
        both = [(frames - self.nodes)[:, at].mean(axis=1) @ along for at, along in self.measured]
        return np.stack(both, axis=1)


def _through(nodes: IntArray, unit: FloatArray) -> FloatArray:
    """Shares of a force on ``nodes`` across the thickness, in their order."""
    level = np.unique(unit[nodes, 2])
    shares = np.array([1, 1]) / 2 if len(level) == 2 else np.array([1, 4, 1]) / 6
    return shares[np.searchsorted(level, unit[nodes, 2])]


def _along_edge(edge: IntArray, unit: FloatArray, axis: int, length: float) -> FloatArray:
    """Force on each of the ``edge`` nodes of a load of one per length along ``axis``."""
    cells = (len(np.unique(unit[edge, axis])) - 1) // 2
    place = np.rint(unit[edge, axis] * 2 * cells).astype(int)
    simpson = np.where(place % 2 == 1, 4.0, 2.0)
    simpson[(place == 0) | (place == 2 * cells)] = 1.0
    return _through(edge, unit) * simpson * length / (6 * cells)


def cantilever(element_type: str, cells: tuple[int, int]) -> Loaded:
    """Length 10, width 1, thickness 0.1; a force of 4 across its end."""
    unit, elements = box(element_type, (*cells, 1), (1.0, 1.0, 1.0))
    end = np.flatnonzero(unit[:, 0] == 1)
    forces = np.zeros_like(unit)
    forces[end, 2] = 4 * _along_edge(end, unit, 1, 1.0)
    fixed = np.repeat(unit[:, :1] == 0, 3, axis=1)
    measured = ((end, (0.0, 0.0, 1.0)), (end, (-1.0, 0.0, 0.0)))
    return Loaded(unit * [10.0, 1.0, 0.1], elements, forces, fixed, measured)


def annulus(element_type: str, cells: tuple[int, int]) -> Loaded:
    """Radii 6 and 10, thickness 0.03; one lip of the slit is clamped, 0.8 per length on the other.

    The first deflection is that of the inner end of the lip, the second of the outer one.
    """
    unit, elements = box(element_type, (cells[1], cells[0], 1), (1.0, 1.0, 1.0))
    radius, angle = 6 + 4 * unit[:, 0], 2 * np.pi * unit[:, 1]
    nodes = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), 0.03 * (unit[:, 2] - 0.5)], axis=1
    )
    lip = np.flatnonzero(unit[:, 1] == 1)
    forces = np.zeros_like(nodes)
    forces[lip, 2] = 0.8 * _along_edge(lip, unit, 0, 4.0)
    fixed = np.repeat(unit[:, 1:2] == 0, 3, axis=1)
    measured = tuple((lip[unit[lip, 0] == k], (0.0, 0.0, 1.0)) for k in (0, 1))
    return Loaded(nodes, elements, forces, fixed, measured)


def hemisphere(element_type: str, cells: tuple[int, int]) -> Loaded:
    """A quarter of a hemisphere of radius 10 and thickness 0.04, open above 72 degrees.

    Its rim is pulled out along x and pushed in along y by 400 each, of which a quarter of the body
    has half. The planes x = 0 and y = 0 are planes of symmetry; one node is kept at its height.
    """
    unit, elements = box(element_type, (*cells, 1), (1.0, 1.0, 1.0))
    longitude, latitude = 0.5 * np.pi * unit[:, 0], np.radians(72.0) * unit[:, 1]
    around = [
        np.cos(latitude) * np.cos(longitude),
        np.cos(latitude) * np.sin(longitude),
        np.sin(latitude),
    ]
    nodes = (10 + 0.04 * (unit[:, 2:] - 0.5)) * np.stack(around, axis=1)
    on_x, on_y = unit[:, 0] == 0, unit[:, 0] == 1
    out, inward = (np.flatnonzero(on & (unit[:, 1] == 0)) for on in (on_x, on_y))
    forces = np.zeros_like(nodes)
    forces[out, 0] = 200 * _through(out, unit)
    forces[inward, 1] = -200 * _through(inward, unit)
    fixed = np.stack([on_y, on_x, np.zeros_like(on_x)], axis=1)
    fixed[np.flatnonzero(on_x & (unit[:, 1] == 1))[0], 2] = True
    measured = ((out, (1.0, 0.0, 0.0)), (inward, (0.0, -1.0, 0.0)))
    return Loaded(nodes, elements, forces, fixed, measured)


@dataclass(frozen=True, eq=False)
class ShellProblem:
    """A published problem: ten rows of both deflections, from a tenth of the largest load to it.

    The table has ``steps`` load steps and three meshes of ``cells``; the figure has the last.
    """

    title: str
    names: tuple[str, str]
    build: Callable[[str, tuple[int, int]], Loaded]
    modulus: float
    poisson: float
    steps: int
    cells: tuple[tuple[int, int], ...]
    published: FloatArray

    def solve(
        self, element_type: str, cells: tuple[int, int], steps: int | None = None, **options: Any
    ) -> tuple[Loaded, Simulation]:
        """The equilibria under equal steps of the load."""
        steps = steps or self.steps
        shell = self.build(element_type, cells)
        result = simulate_body(
            shell.nodes,
            shell.elements,
            element_type,
            material=TransverselyIsotropic.isotropic(self.modulus, self.poisson),
            fixed_components=shell.fixed,
            forces=lambda t: t * shell.forces,
            times=np.arange(1, steps + 1) / steps,
            static=True,
            **options,
        )
        return shell, result


PROBLEMS = {
    "cantilever": ShellProblem(
        "Cantilever, L/h = 100", ("tip up", "tip back"), cantilever, 1.2e6, 0.0,
        1, ((4, 1), (8, 1), (16, 1)),
        np.array([[1.309, 0.103], [2.493, 0.381], [3.488, 0.763], [4.292, 1.184], [4.933, 1.604],
                  [5.444, 2.002], [5.855, 2.370], [6.190, 2.705], [6.467, 3.010], [6.698, 3.286]]),
    ),
    "annulus": ShellProblem(
        "Slit annular plate, R/h = 333", ("inner end up", "outer end up"), annulus, 21e6, 0.0,
        10, ((15, 3), (30, 6), (60, 10)),
        np.array([[4.277, 5.876], [6.725, 9.160], [8.340, 11.213], [9.529, 12.661],
                  [10.468, 13.768], [11.257, 14.674], [11.970, 15.469], [12.642, 16.202],
                  [13.282, 16.886], [13.891, 17.528]]),
    ),
    "hemisphere": ShellProblem(
        "Pinched hemisphere, R/h = 250", ("outward", "inward"), hemisphere, 6.825e7, 0.3,
        4, ((8, 8), (16, 16), (32, 32)),
        np.array([[1.499, 1.840], [2.321, 3.261], [2.819, 4.339], [3.158, 5.196], [3.406, 5.902],
                  [3.598, 6.497], [3.750, 7.006], [3.875, 7.448], [3.979, 7.835], [4.067, 8.178]]),
    ),
}  # fmt: skip


def row(name: str, element_type: str, cells: tuple[int, int]) -> dict[str, Any]:
    """Deflections under the largest load, and what they cost (s of the processor)."""
    problem = PROBLEMS[name]
    start = time.process_time()
    shell, result = problem.solve(element_type, cells)
    both = shell.deflections(result.frames)[-1] if result.converged else np.full(2, np.nan)
    ratio = both / problem.published[-1]
    return {
        "problem": name, "element": element_type, "cells": "x".join(map(str, cells)),
        "dof": shell.nodes.size, "first": both[0], "second": both[1],
        "first_ratio": ratio[0], "second_ratio": ratio[1],
        "steps": len(result.records), "iterations": result.iterations,
        "solver": result.solver, "seconds": time.process_time() - start,
    }  # fmt: skip


def ratios(table: pd.DataFrame) -> pd.DataFrame:
    """Both ratios to the published deflections, a row per mesh and a column per element."""
    both = [f"{a:.3f}, {b:.3f}" for a, b in table[["first_ratio", "second_ratio"]].to_numpy()]
    titles = {name: f"{one.title}: {', '.join(one.names)}" for name, one in PROBLEMS.items()}
    table = table.assign(both=both, problem=table["problem"].map(titles))
    mesh = ["problem", "cells"]
    dof = table[table["element"] == "hex18"].set_index(mesh)["dof"].rename("dof of hex18")
    wide = table.set_index([*mesh, "element"])["both"].unstack()[list(ELEMENTS)]
    return dof.to_frame().join(wide).reset_index()


def draw() -> Any:
    """Deformed shells, and load against deflection beside what is published."""
    from matplotlib.colors import LightSource
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    figure = Figure(figsize=(10, 6), layout="constrained")
    for column, problem in enumerate(PROBLEMS.values()):
        shell, result = problem.solve("hex18", problem.cells[-1], steps=10)
        ring = shell.elements[:, element("hex18").top_face][:, [0, 1, 2, 5, 8, 7, 6, 3]]
        turns = [(1, 1), (-1, 1), (1, -1), (-1, -1)] if problem.build is hemisphere else [(1, 1)]
        above = figure.add_subplot(2, 3, column + 1, projection="3d", title=problem.title)
        every = []
        for x, colours in (
            (shell.nodes, {"facecolors": (0, 0, 0, 0), "edgecolors": "0.75"}),
            (result.frames[-1], {"facecolors": "#56B4E9", "edgecolors": "0.25", "shade": True,
                                 "lightsource": LightSource(315, 45)}),
        ):  # fmt: skip
            faces = np.concatenate([x[ring] * [*turn, 1] for turn in turns])
            above.add_collection3d(Poly3DCollection(faces, linewidths=0.3, **colours))
            every.append(faces.reshape(-1, 3))
        low, high = np.min(np.concatenate(every), axis=0), np.max(np.concatenate(every), axis=0)
        above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        above.set_box_aspect(high - low, zoom=1.2)
        above.view_init(25, -60)
        above.set_axis_off()
        below = figure.add_subplot(2, 3, column + 4, xlabel="deflection", ylabel="share of load")
        for k, (computed, name) in enumerate(
            zip(shell.deflections(result.frames).T, problem.names, strict=True)
        ):
            below.plot(computed, result.times, color=f"C{k}", label=name)
            below.plot(problem.published[:, k], result.times[1:], "o", mfc="w", color=f"C{k}")
        below.legend(frameon=False)
    return figure


def text(table: pd.DataFrame) -> tuple[str, ...]:
    """What the table says, in Markdown."""
    return (
        "Deflections under the largest load over the published ones (Sze, Liu and Lo 2004, Finite "
        "Elements in Analysis and Design 40:1551), the two of each problem, one layer of elements. "
        "Written by `python -m tests.verification.shells`.",
        markdown(ratios(table)),
        f"Solved by: {'; '.join(sorted(set(table['solver'])))}.",
    )


if __name__ == "__main__":
    chosen = [(name, e, n) for name, one in PROBLEMS.items() for e in ELEMENTS for n in one.cells]
    found = pd.DataFrame([row(*one) for one in chosen])
    folder = ROOT / "results"
    write_atomically(folder / "shells.csv", found.to_csv(index=False, float_format="%.6g"))
    write_text(folder / "shells.md", *text(found))
    write_atomically(folder / "shells.png", lambda part: draw().savefig(part, dpi=100))
