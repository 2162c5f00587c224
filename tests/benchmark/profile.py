"""Where the time of a closure goes, guided and continued, and what bounds its parts.

``python -m tests.benchmark.profile OUT.json [SIZE ...]`` closes the default valve under Python's
profiler, whose cost is small here since a closure makes few calls, and sets the work that the
largest parts do per second beside what this machine can do: products of dense matrices for
arithmetic, a long vector sum for memory. CPU seconds of one thread.
"""

from __future__ import annotations

import cProfile
import json
import pstats
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.mechanics.forces.contact import Contact
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import PardisoSolver
from mvest.mechanics.system import System
from mvest.typing import FloatArray
from tests.benchmark.valves import VALUES, Closed, closed, farther, model

SIZES = ("default", "25k")
PARTS: dict[str, tuple[Callable[..., Any], ...]] = {
    "factorisation": (PardisoSolver.factorize,),
    "solves (GMRES, back-substitution)": (PardisoSolver.solve,),
    "law, enhanced strains": (Solid.evaluate,),
    "element tangents": (Solid.add_tangents,),
    "contact search": (Contact.search,),
    "contact Hessian": (Contact.add_tangent,),
    "collision detection": (Contact.largest_step, Contact.intersects),
    "sparsity pattern": (System._build_pattern,),
}
"""Disjoint parts of a closure; what is outside of them is assembly, forces and the rest."""


def machine() -> dict[str, float]:
    """What one thread can do: GFlop/s of dense products, GB/s of a vector sum."""
    a, v = np.random.default_rng(0).normal(size=(1500, 1500)), np.ones(20_000_000)
    w, b = np.empty_like(v), a.astype(np.float32)
    return {
        "GFlop/s": 2 * 1500**3 / _seconds(lambda: a @ a) / 1e9,
        "GFlop/s, single precision": 2 * 1500**3 / _seconds(lambda: b @ b) / 1e9,
        "GB/s": 24 * len(v) / _seconds(lambda: np.add(v, w, out=w)) / 1e9,
    }


def _seconds(call: Callable[[], object], repeats: int = 7) -> float:
    call()
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        taken.append(time.process_time() - start)
    return float(np.median(taken))


def shares(valve: ClosureModel, size: str) -> list[dict[str, Any]]:
    """Iterations and seconds of each part of a closure, on the finest mesh and on its guides.

    From the open valve first, then from where that ended.
    """
    assert valve.close(1.01 * VALUES).simulation.converged  # builds the mechanics
    valve.restart(None)
    valve.continuation = True
    closures = {"guided": VALUES, "continued": farther(size)}
    return [{"closure": kind, **_shares(valve, m)} for kind, m in closures.items()]


def _shares(valve: ClosureModel, m: FloatArray) -> dict[str, Any]:
    profiler = cProfile.Profile(time.process_time)
    start = time.process_time()
    profiler.enable()
    result = valve.close(m).simulation
    profiler.disable()
    total = time.process_time() - start
    assert result.converged, result.reason.value
    stats = pstats.Stats(profiler).stats  # type: ignore[attr-defined]

    def of(functions: tuple[Callable[..., Any], ...], column: int) -> float:
        codes = [f.__code__ for f in functions]
        keys = [(c.co_filename, c.co_firstlineno, c.co_name) for c in codes]
        return sum(stats[key][column] for key in keys if key in stats)

    seconds = {name: of(functions, 3) for name, functions in PARTS.items()}
    seconds["assembly, forces, the rest"] = total - sum(seconds.values())
    return {
        "seconds": total,
        "iterations on the finest mesh": result.iterations,
        "factorisations": of((PardisoSolver.factorize,), 0),
        "evaluations": of((System.evaluate,), 0),
        "parts": seconds,
    }


def bounds(case: Closed) -> list[dict[str, Any]]:
    """Work per second of factorisation, matrix-vector product and element tangents."""
    system = case.system
    state = system.solid.evaluate(case.x, case.strain, 0.0)
    at = (case.x, case.loads, case.pairs, case.strain, 0.0)
    blocks = system.evaluate(*at, tangent=True).blocks
    assert blocks is not None
    matrix = system.matrix(blocks, 0.0)
    solver = PardisoSolver()
    solver._pardiso.settings[18] = -1  # count the operations
    solver.factorize(matrix)
    # PARDISO counts millions of operations on blocks, 3 x 3 x 3 each.
    operations = 27e6 * solver._pardiso.settings[18]
    v = np.random.default_rng(0).normal(size=matrix.shape[0])
    _, points = system.solid.volumes.shape
    nodes = system.solid.mesh.elements.shape[1]
    # g (dP/dF) g: nine components by three, times the gradients of one node, then of the other.
    per_point = 2 * 27 * nodes * (3 + nodes)
    return [
        {
            "what": "factorisation",
            "bound by": "GFlop/s, single precision",
            "reached": operations / _seconds(lambda: solver.factorize(matrix), 3) / 1e9,
        },
        {
            "what": "product of matrix and vector",
            "bound by": "GB/s",
            "reached": (matrix.blocks.nbytes + matrix.pattern.columns.nbytes)
            / _seconds(lambda: matrix @ v)
            / 1e9,
        },
        {
            "what": "element tangents",
            "bound by": "GFlop/s",
            "reached": per_point
            * points
            * len(system.solid.mesh.elements)
            / _seconds(lambda: system.solid.add_tangents(state, system._at_elements, blocks))
            / 1e9,
        },
    ]


def main(arguments: list[str]) -> None:
    """Measure, and write the record where told."""
    limits = machine()
    found = []
    for size in arguments[1:] or SIZES:
        case = closed("hex18", size)  # compiles, and builds what the bounds are measured on
        rows = [row | {"machine": limits[row["bound by"]]} for row in bounds(case)]
        for entry in shares(model("hex18", size).fresh(), size):
            found.append({"size": size, "nodes": case.nodes, **entry, "bounds": rows})
            print(json.dumps({key: found[-1][key] for key in entry}, indent=1))
    Path(arguments[0]).write_text(json.dumps({"profile": found}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
