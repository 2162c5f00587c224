"""Bending strips: what each element makes of a known plate; ``python -m experiments.verification``.

A strip clamped at one end bends under pressure from below. The reference is ``hex27`` in two layers
with cells graded towards the clamp and the free edges, where nearly incompressible material has a
boundary layer that uniform meshes do not resolve (they miss up to 7 % of the deflection). The table
holds the deflection of the tip over the reference's for a small load and for one that turns the tip
by about 75 degrees, and the cost of one Newton iteration per unknown.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from mvest.files import write_atomically
from mvest.mechanics.blocks import box, outer_faces
from mvest.mechanics.body import simulate_body
from mvest.mechanics.law.biot import PoissonReading, TransverselyIsotropic
from mvest.mechanics.steps import NewtonSettings
from mvest.typing import FloatArray

__all__ = ["CASES", "MATERIALS", "Bending", "StripMesh", "bend", "main", "strip_table"]

MATERIALS = {
    "iso": TransverselyIsotropic.isotropic(2.0, 0.488),
    "A": TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.LITERAL),
    "C": TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.NEARLY_INCOMPRESSIBLE),
}
"""Isotropic at nu = 0.488, and the anterior leaflet in both readings of the ratio."""

STRIPS = {"13x10x1.26": (13.0, 10.0, 1.26), "20x10x1.3": (20.0, 10.0, 1.3)}
SMALL_LOAD = 1e-6
"""MPa; bends by hundredths of a millimetre."""
LARGE_LOAD = {
    "13x10x1.26": {"iso": 1.45e-3, "A": 4.1e-3, "C": 4.1e-3},
    "20x10x1.3": {"iso": 4.3e-4, "A": 1.25e-3, "C": 1.25e-3},
}
"""MPa; turns the tip by about 75 degrees."""
LARGE_STEPS = 6


@dataclass(frozen=True, slots=True)
class StripMesh:
    """One mesh: element, cells along length, width and thickness, graded towards the edges."""

    element: str
    cells: tuple[int, int, int]
    graded: bool = False


REFERENCE = StripMesh("hex27", (12, 8, 2), graded=True)
CASES = (
    StripMesh("tet4", (13, 10, 1)),
    StripMesh("tet10", (9, 7, 1)),
    StripMesh("hex18", (4, 3, 1)),
    StripMesh("hex18", (9, 7, 1)),
    StripMesh("hex18", (13, 10, 1)),
    StripMesh("hex27", (9, 7, 1)),
    StripMesh("wedge12", (9, 7, 1)),
    StripMesh("wedge18", (9, 7, 1)),
)
"""One layer each."""
FINE_CASES = (
    StripMesh("hex27", (16, 10, 3), graded=True),
    StripMesh("tet4", (26, 20, 2)),
    StripMesh("tet4", (39, 30, 4)),
    StripMesh("tet10", (13, 10, 2)),
)
"""For the small load only. The first shows how far the reference has converged."""


@dataclass(frozen=True, slots=True)
class Bending:
    """Result of one strip.

    Attributes
    ----------
    tip : ndarray
        ``(3,)`` mm mean displacement of the tip.
    angle : float
        Degrees by which the tip has turned.
    dof, iterations : int
        Unknowns and Newton iterations.
    seconds : float
        Processor time of the run.
    converged : bool
    """

    tip: FloatArray
    angle: float
    dof: int
    iterations: int
    seconds: float
    converged: bool

    @property
    def deflection(self) -> float:
        """Length of the tip's displacement, mm."""
        return float(np.linalg.norm(self.tip))


def bend(
    case: StripMesh, size: tuple[float, float, float], material: str, pressure: float, steps: int
) -> Bending:
    """Bend a strip of the given size (mm) by a follower pressure (MPa) in equilibrium steps."""
    nodes, elements = box(case.element, case.cells, size)
    if case.graded:
        u, v = nodes[:, 0] / size[0], 2 * nodes[:, 1] / size[1] - 1
        nodes[:, 0] = size[0] * u**2
        nodes[:, 1] = size[1] * (0.5 + 0.5 * np.sign(v) * (1 - (1 - np.abs(v)) ** 1.5))
    faces = outer_faces(elements, case.element)
    start = time.process_time()
    result = simulate_body(
        nodes,
        elements,
        case.element,
        material=MATERIALS[material],
        fibre=(1.0, 0.0, 0.0),
        fixed_nodes=np.flatnonzero(nodes[:, 0] == 0),
        pressure_faces=faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)],
        pressure=[(0.0, 0.0), (1.0, pressure)],
        times=np.arange(1, steps + 1) / steps,
        static=True,
        newton=NewtonSettings(tolerance=1e-8),
    )
    seconds = time.process_time() - start
    x = result.frames[-1]
    tip = nodes[:, 0] == size[0]
    director = x[tip & (nodes[:, 2] == size[2])].mean(0) - x[tip & (nodes[:, 2] == 0)].mean(0)
    return Bending(
        (x - nodes)[tip].mean(axis=0),
        float(np.degrees(np.arctan2(-director[0], director[2]))),
        nodes.size,
        result.iterations,
        seconds,
        result.converged,
    )


def strip_table(
    cases: Iterable[StripMesh] = CASES,
    *,
    strips: Iterable[str] = STRIPS,
    materials: Iterable[str] = MATERIALS,
    loads: Iterable[str] = ("small", "large"),
    reference: StripMesh = REFERENCE,
) -> pd.DataFrame:
    """Deflections of all cases over the reference's, one row per strip, material, load and case.

    Returns
    -------
    DataFrame
        With the columns strip_name, material, load, element, cells, graded, dof, deflection_mm,
        ratio (deflection over the reference's), angle_deg, iterations and us_per_iteration_and_dof
        (microseconds of processor time per Newton iteration and unknown).
    """
    rows = []
    cases = (reference, *cases)
    for case in cases:  # compiled kernels are loaded before anything is timed
        bend(StripMesh(case.element, (1, 1, 1)), (1.0, 1.0, 1.0), "A", SMALL_LOAD, 1)
    for strip in strips:
        for material in materials:
            for load in loads:
                pressure = SMALL_LOAD if load == "small" else LARGE_LOAD[strip][material]
                steps = 1 if load == "small" else LARGE_STEPS
                measure = np.nan
                for case in cases:
                    result = bend(case, STRIPS[strip], material, pressure, steps)
                    deflection = result.deflection if result.converged else np.nan
                    if case is reference:
                        measure = deflection
                    cost = result.seconds / max(result.iterations, 1) / result.dof
                    rows.append(
                        {
                            "strip_name": strip,
                            "material": material,
                            "load": load,
                            "element": case.element,
                            "cells": "x".join(map(str, case.cells)),
                            "graded": case.graded,
                            "dof": result.dof,
                            "deflection_mm": deflection,
                            "ratio": deflection / measure,
                            "angle_deg": result.angle,
                            "iterations": result.iterations,
                            "us_per_iteration_and_dof": 1e6 * cost,
                        }
                    )
    return pd.DataFrame(rows)


def markdown(table: pd.DataFrame) -> str:
    """The ratios as a table in Markdown: a row per mesh, a column per strip, material and load."""
    rows = table.assign(
        mesh=table["element"] + " " + table["cells"] + np.where(table["graded"], " graded", ""),
        column=table["strip_name"] + " " + table["material"] + " " + table["load"],
    )
    columns, meshes = list(dict.fromkeys(rows["column"])), list(dict.fromkeys(rows["mesh"]))
    ratio = rows.set_index(["mesh", "column"])["ratio"]
    cost = rows.groupby("mesh")["us_per_iteration_and_dof"].median()
    lines = [
        "Deflection of the tip of a clamped strip under pressure over the reference's (first row).",
        "Material `iso` has nu = 0.488; `A` and `C` are the anterior leaflet in both readings of",
        "the Poisson ratio. The large load turns the tip by about 75 degrees. Cost: microseconds",
        "of processor time per Newton iteration and unknown, median of all columns. Written by",
        "`python -m experiments.verification`.",
        "",
        "| mesh | dof | " + " | ".join(columns) + " | cost |",
        "|---" * (len(columns) + 3) + "|",
    ]
    dof = rows.groupby("mesh")["dof"].first()
    for mesh in meshes:
        values = [f"{ratio[mesh, c]:.3f}" if (mesh, c) in ratio else "" for c in columns]
        lines.append(f"| {mesh} | {dof[mesh]} | " + " | ".join(values) + f" | {cost[mesh]:.0f} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write ``strip.csv`` and ``strip.md`` into the folder of the results."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    folder = Path(given[0] if given else "results")
    small = strip_table((*CASES, *FINE_CASES), loads=("small",))
    large = strip_table(CASES, loads=("large",), strips=("13x10x1.26",))
    table = pd.concat([small, large], ignore_index=True)
    print(write_atomically(folder / "strip.csv", table.to_csv(index=False, float_format="%.6g")))
    print(write_atomically(folder / "strip.md", markdown(table)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
