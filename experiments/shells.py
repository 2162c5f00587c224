"""Thin shells against published answers: ``python -m experiments.shells``.

Three problems of Sze, Liu and Lo (2004, Finite Elements in Analysis and Design 40:1551), whose
tables of load and deflection come from four-node shell elements on fine meshes: a cantilever under
a shear force at its end, a slit annular plate lifted at one lip of the slit, and a hemisphere with
a hole of 18 degrees that is pulled and pushed at its rim. Units are those of the publication.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import LightSource
from matplotlib.figure import Figure

from mvest.elements import element
from mvest.files import write_atomically
from mvest.mechanics.blocks import box
from mvest.mechanics.body import simulate_body
from mvest.mechanics.law.biot import TransverselyIsotropic
from mvest.mechanics.steps import Simulation
from mvest.reporting.style import COLOURS, SMALL, TEXT, WIDTH, plain_axes
from mvest.typing import BoolArray, FloatArray, IntArray

__all__ = ["PROBLEMS", "Shell", "ShellProblem", "main", "shell_table"]

CANTILEVER = np.array([
    [0.1, 1.309, 0.103], [0.2, 2.493, 0.381], [0.3, 3.488, 0.763], [0.4, 4.292, 1.184],
    [0.5, 4.933, 1.604], [0.6, 5.444, 2.002], [0.7, 5.855, 2.370], [0.8, 6.190, 2.705],
    [0.9, 6.467, 3.010], [1.0, 6.698, 3.286],
])  # fmt: skip
ANNULUS = np.array([
    [0.1, 4.277, 5.876], [0.2, 6.725, 9.160], [0.3, 8.340, 11.213], [0.4, 9.529, 12.661],
    [0.5, 10.468, 13.768], [0.6, 11.257, 14.674], [0.7, 11.970, 15.469], [0.8, 12.642, 16.202],
    [0.9, 13.282, 16.886], [1.0, 13.891, 17.528],
])  # fmt: skip
HEMISPHERE = np.array([
    [0.1, 1.499, 1.840], [0.2, 2.321, 3.261], [0.3, 2.819, 4.339], [0.4, 3.158, 5.196],
    [0.5, 3.406, 5.902], [0.6, 3.598, 6.497], [0.7, 3.750, 7.006], [0.8, 3.875, 7.448],
    [0.9, 3.979, 7.835], [1.0, 4.067, 8.178],
])  # fmt: skip
"""Share of the largest load, and the two deflections under it (Sze, Liu and Lo 2004)."""


@dataclass(frozen=True, slots=True, eq=False)
class Shell:
    """One problem on one mesh.

    Attributes
    ----------
    nodes, elements : ndarray
    forces : ndarray
        ``(n, 3)`` of the largest load.
    fixed : ndarray
        ``(n, 3)`` bool.
    first, second : tuple of ndarray
        Nodes and direction ``(3,)`` of the two deflections.
    """

    nodes: FloatArray
    elements: IntArray
    forces: FloatArray
    fixed: BoolArray
    first: tuple[IntArray, FloatArray]
    second: tuple[IntArray, FloatArray]

    def deflections(self, frames: FloatArray) -> FloatArray:
        """Both ``(f, 2)`` of the frames ``(f, n, 3)``."""
        moved = frames - self.nodes
        both = [moved[:, at].mean(axis=1) @ along for at, along in (self.first, self.second)]
        return np.stack(both, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class ShellProblem:
    """A published problem.

    Attributes
    ----------
    title : str
    names : tuple of str
        Of the two deflections.
    published : ndarray
        ``(s, 3)`` share of the load and deflections.
    material : TransverselyIsotropic
    build : callable
        Element and cells in the two directions of the shell -> mesh, loads and supports.
    steps : int
        Equal load steps to the largest load.
    cells : tuple
        Meshes of the table.
    """

    title: str
    names: tuple[str, str]
    published: FloatArray
    material: TransverselyIsotropic
    build: Callable[[str, tuple[int, int]], Shell]
    steps: int
    cells: tuple[tuple[int, int], ...]

    def solve(
        self,
        element_type: str,
        cells: tuple[int, int],
        *,
        steps: int | None = None,
        solver: str = "auto",
    ) -> tuple[Shell, Simulation]:
        """The equilibria under equal steps of the load."""
        shell = self.build(element_type, cells)
        result = simulate_body(
            shell.nodes,
            shell.elements,
            element_type,
            material=self.material,
            fixed_components=shell.fixed,
            forces=lambda t: t * shell.forces,
            times=np.arange(1, (steps or self.steps) + 1) / (steps or self.steps),
            static=True,
            solver=solver,
        )
        return shell, result


def _through(nodes: IntArray, unit: FloatArray) -> FloatArray:
    """Shares of a force on ``nodes`` across the thickness, in their order."""
    level = np.unique(unit[nodes, 2])
    shares = np.array([1, 1]) / 2 if len(level) == 2 else np.array([1, 4, 1]) / 6
    return np.asarray(shares[np.searchsorted(level, unit[nodes, 2])])


def _along_edge(edge: IntArray, unit: FloatArray, axis: int, length: float) -> FloatArray:
    """Force on each of the ``edge`` nodes of a load of one per length along ``axis``."""
    cells = (len(np.unique(unit[edge, axis])) - 1) // 2
    place = np.rint(unit[edge, axis] * 2 * cells).astype(int)
    simpson = np.where(place % 2 == 1, 4.0, 2.0)
    simpson[(place == 0) | (place == 2 * cells)] = 1.0
    return np.asarray(_through(edge, unit) * simpson * length / (6 * cells))


def _cantilever(element_type: str, cells: tuple[int, int]) -> Shell:
    """Length 10, width 1, thickness 0.1; a force of 4 across its end."""
    unit, elements = box(element_type, (*cells, 1), (1.0, 1.0, 1.0))
    nodes = unit * [10.0, 1.0, 0.1]
    end = np.flatnonzero(unit[:, 0] == 1)
    forces = np.zeros_like(nodes)
    forces[end, 2] = 4 * _along_edge(end, unit, 1, 1.0)
    fixed = np.zeros(nodes.shape, dtype=bool)
    fixed[unit[:, 0] == 0] = True
    up, back = np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0])
    return Shell(nodes, elements, forces, fixed, (end, up), (end, back))


def _annulus(element_type: str, cells: tuple[int, int]) -> Shell:
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
    fixed = np.zeros(nodes.shape, dtype=bool)
    fixed[unit[:, 1] == 0] = True
    up = np.array([0.0, 0.0, 1.0])
    inner, outer = lip[unit[lip, 0] == 0], lip[unit[lip, 0] == 1]
    return Shell(nodes, elements, forces, fixed, (inner, up), (outer, up))


def _hemisphere(element_type: str, cells: tuple[int, int]) -> Shell:
    """A quarter of a hemisphere of radius 10 and thickness 0.04, open above 72 degrees.

    Its rim is pulled out along x and pushed in along y by 400 each, of which a quarter of the body
    has half. The planes x = 0 and y = 0 are planes of symmetry; one node is kept at its height.
    """
    unit, elements = box(element_type, (*cells, 1), (1.0, 1.0, 1.0))
    longitude, latitude = 0.5 * np.pi * unit[:, 0], np.radians(72.0) * unit[:, 1]
    radius = 10 + 0.04 * (unit[:, 2] - 0.5)
    nodes = radius[:, None] * np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ],
        axis=1,
    )
    on_x, on_y = unit[:, 0] == 0, unit[:, 0] == 1
    first, second = (np.flatnonzero(on & (unit[:, 1] == 0)) for on in (on_x, on_y))
    forces = np.zeros_like(nodes)
    forces[first, 0] = 200 * _through(first, unit)
    forces[second, 1] = -200 * _through(second, unit)
    fixed = np.stack([on_y, on_x, np.zeros_like(on_x)], axis=1)
    fixed[np.flatnonzero(on_x & (unit[:, 1] == 1))[0], 2] = True
    out, into = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    return Shell(nodes, elements, forces, fixed, (first, out), (second, into))


PROBLEMS = {
    "cantilever": ShellProblem(
        "Cantilever, L/h = 100",
        ("tip up", "tip back"),
        CANTILEVER,
        TransverselyIsotropic.isotropic(1.2e6, 0.0),
        _cantilever,
        1,
        ((4, 1), (8, 1), (16, 1)),
    ),
    "annulus": ShellProblem(
        "Slit annular plate, R/h = 333",
        ("inner end up", "outer end up"),
        ANNULUS,
        TransverselyIsotropic.isotropic(21e6, 0.0),
        _annulus,
        10,
        ((15, 3), (30, 6), (60, 10)),
    ),
    "hemisphere": ShellProblem(
        "Pinched hemisphere, R/h = 250",
        ("outward", "inward"),
        HEMISPHERE,
        TransverselyIsotropic.isotropic(6.825e7, 0.3),
        _hemisphere,
        4,
        ((8, 8), (16, 16), (32, 32)),
    ),
}
ELEMENTS = ("hex18_thin", "hex18", "wedge12", "tet10")
"""``hex27`` and ``wedge18`` are as ``hex18`` and ``wedge12`` to three digits."""
SHOWN = {"cantilever": (8, 1), "annulus": (30, 6), "hemisphere": (16, 16)}
"""Meshes of the figure."""


def shell_table(
    problems: Iterable[str] = PROBLEMS, elements: Iterable[str] = ELEMENTS
) -> pd.DataFrame:
    """Deflections under the largest load, one row per problem, element and mesh.

    Returns
    -------
    DataFrame
        With the columns problem, element, cells, dof, first and second (deflections),
        first_ratio and second_ratio (over the published ones), steps, iterations, solver and
        seconds (processor time).
    """
    rows = []
    for name in problems:
        problem = PROBLEMS[name]
        for element_type in elements:
            for cells in problem.cells:
                start = time.process_time()
                shell, result = problem.solve(element_type, cells)
                both = shell.deflections(result.frames)[-1] if result.converged else [np.nan] * 2
                rows.append(
                    {
                        "problem": name,
                        "element": element_type,
                        "cells": "x".join(map(str, cells)),
                        "dof": shell.nodes.size,
                        "first": both[0],
                        "second": both[1],
                        "first_ratio": both[0] / problem.published[-1, 1],
                        "second_ratio": both[1] / problem.published[-1, 2],
                        "steps": len(result.records),
                        "iterations": result.iterations,
                        "solver": result.solver,
                        "seconds": time.process_time() - start,
                    }
                )
    return pd.DataFrame(rows)


def markdown(table: pd.DataFrame) -> str:
    """Ratios to the published deflections: a row per problem and mesh, columns per element."""
    elements = list(dict.fromkeys(table["element"]))
    lines = [
        "Deflections under the largest load over the published ones (Sze, Liu and Lo 2004, Finite",
        "Elements in Analysis and Design 40:1551), the two of each problem, one layer of elements.",
        "Written by `python -m experiments.shells`.",
        "",
        "| problem | cells | dof of hex18 | " + " | ".join(elements) + " |",
        "|---" * (len(elements) + 3) + "|",
    ]
    for (name, cells), rows in table.groupby(["problem", "cells"], sort=False):
        own = rows.set_index("element")
        values = [f"{own.first_ratio[e]:.3f}, {own.second_ratio[e]:.3f}" for e in elements]
        problem = PROBLEMS[str(name)]
        head = f"{problem.title}: {', '.join(problem.names)}"
        lines.append(f"| {head} | {cells} | {own.dof['hex18']} | " + " | ".join(values) + " |")
    thin = table[table["element"] == "hex18_thin"]
    per_step = thin["iterations"] / thin["steps"]
    lines += [
        "",
        f"Iterations per load step (`hex18_thin`): {per_step.min():.0f} to {per_step.max():.0f}. "
        f"Solved by: {'; '.join(sorted(set(table['solver'])))}.",
    ]
    return "\n".join(lines) + "\n"


def shell_figure() -> Figure:
    """Deformed shells, and load against deflection beside what is published."""
    figure = Figure(figsize=(WIDTH, 5.6), layout="constrained")
    for column, (name, problem) in enumerate(PROBLEMS.items()):
        shell, result = problem.solve("hex18_thin", SHOWN[name], steps=10)
        above = figure.add_subplot(2, 3, column + 1, projection="3d")
        _draw(above, shell, result.frames[-1], name)
        above.set_title(problem.title, fontsize=TEXT)
        below = figure.add_subplot(2, 3, column + 4)
        plain_axes(below)
        computed = shell.deflections(result.frames)
        for k, label in enumerate(problem.names):
            colour = COLOURS[k]
            below.plot(computed[:, k], result.times, color=colour, label=label)
            below.plot(problem.published[:, k + 1], problem.published[:, 0], "o", ms=4, mfc="w",
                       color=colour)  # fmt: skip
        below.set(xlabel="deflection", ylabel="load over the largest" if column == 0 else "")
        below.legend(frameon=False, fontsize=SMALL)
    return figure


def _draw(axes: Any, shell: Shell, x: FloatArray, name: str) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    top = shell.elements[:, element("hex18_thin").top_face]
    ring = top[:, [0, 1, 2, 5, 8, 7, 6, 3]]
    turns = [(1, 1), (-1, 1), (1, -1), (-1, -1)] if name == "hemisphere" else [(1, 1)]
    for at, colour in ((shell.nodes, None), (x, COLOURS[4])):
        every = np.concatenate([at[ring] * [*turn, 1] for turn in turns])
        faces = Poly3DCollection(
            every,
            facecolors=colour or (0, 0, 0, 0),
            edgecolors="0.75" if colour is None else "0.25",
            linewidths=0.3,
            shade=colour is not None,
            lightsource=LightSource(315, 45) if colour else None,
        )
        axes.add_collection3d(faces)
    both = np.concatenate([shell.nodes, x])
    low, high = both.min(axis=0), both.max(axis=0)
    if name == "hemisphere":
        low[:2] = -high[:2]
    axes.set(xlim=(low[0], high[0]), ylim=(low[1] - 0.5, high[1] + 0.5), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low + [0, 1, 0], zoom=1.2)
    axes.view_init(25, -60)
    axes.set_axis_off()


def main(arguments: Sequence[str] | None = None) -> int:
    """Write ``shells.csv``, ``shells.md`` and ``shells.png`` into the folder of the results."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    folder = Path(given[0] if given else "results")
    table = shell_table()
    print(write_atomically(folder / "shells.csv", table.to_csv(index=False, float_format="%.6g")))
    print(write_atomically(folder / "shells.md", markdown(table)))
    figure = shell_figure()
    print(write_atomically(folder / "shells.png", lambda part: figure.savefig(part, dpi=150)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
