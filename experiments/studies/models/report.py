"""One sheet in two finite-element codes: what each estimates, and how far apart they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D

from experiments.common.records.record import Record
from experiments.studies.models.findings import Apart, Difference, Findings
from experiments.studies.models.sheet.sheet import Sheet
from mvest.reporting.figures import COLOURS, MARKERS
from mvest.reporting.markup import MISSING, markdown_rows, number
from mvest.typing import FloatArray

__all__ = ["models_answer", "models_figure", "models_table", "models_text"]

AGAINST = (
    "this project, the same elements",
    "this project, solid-shells",
    "scikit-fem, St. Venant-Kirchhoff",
)
"""What is compared with scikit-fem's Biot law on the same mesh."""


def _against(row: Difference) -> tuple[Apart | None, ...]:
    """In the order of `AGAINST`."""
    return row.hex27, row.hex18, row.st_venant_kirchhoff


def models_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per model and data."""
    return pd.DataFrame(
        [
            {
                "data": row.data,
                "model": row.model,
                "converged": row.converged,
                "residual_mm": row.residual_mm,
                "iterations": row.iterations,
                "forward_solves": row.forward_solves,
                "program_runs": row.program_runs,
                "seconds": row.seconds,
            }
            | {
                f"{name}_{what}": values[k]
                for k, name in enumerate(record.parameters)
                for what, values in (
                    ("estimate", row.estimate),
                    ("std", row.std),
                    ("relative_error", row.relative_error),
                )
            }
            for row in record.findings.rows
        ]
    )


def _estimates(record: Record[Findings]) -> list[dict[str, str]]:
    rows = []
    alone = {row.data: row.estimate for row in record.findings.rows if row.model == row.data}
    for row in record.findings.rows:
        cells = {"data of": row.data, "model of the filter": row.model}
        for k, name in enumerate(record.parameters):
            value = f"{row.estimate[k]:.3f} ± {row.std[k]:.3f}"
            cells[f"{name} (MPa)"] = value if row.converged else MISSING
            error = f"{100 * row.relative_error[k]:+.2f}"
            cells[f"error of {name} (%)"] = error if row.converged else MISSING
        apart = [100 * (e / o - 1) for e, o in zip(row.estimate, alone[row.data], strict=True)]
        cells |= {
            "apart from the data's own model (%)": ", ".join(f"{value:+.2f}" for value in apart),
            "residual (mm)": number(row.residual_mm),
            "predictions": str(row.forward_solves),
            "program runs": MISSING if row.program_runs is None else str(row.program_runs),
            "time (s)": number(row.seconds, 2),
        }
        rows.append(cells)
    return rows


def _differences(findings: Findings) -> list[dict[str, str]]:
    rows = []
    for row in findings.differences:
        cells = {"cells": " × ".join(map(str, row.cells))}
        for name, apart in zip(AGAINST, _against(row), strict=True):
            cells[f"{name}: largest (mm)"] = number(apart and apart.max_mm, 2)
            cells[f"{name}: derivatives (%)"] = number(apart and 100 * apart.derivatives, 2)
        rows.append(cells)
    return rows


def _words(record: Record[Findings]) -> str:
    findings, sheet = record.findings, record.findings.sheet
    truth = ", ".join(
        f"{name} = {value:g} MPa"
        for name, value in zip(record.parameters, findings.truth, strict=True)
    )
    return (
        f"Simulated: a sheet of {sheet.length:g} × {sheet.width:g} × "
        f"{sheet.thickness:g} mm, clamped at three sides, under {sheet.pressure_mmHg:g} "
        f"mmHg; truth {truth}; errors of {findings.noise_mm:g} mm SD, the same in both sets of "
        "data. ± is one standard deviation. The estimates that belong to one set of data see the "
        "same numbers, so that what they differ by is the model."
    )


def models_answer(record: Record[Findings]) -> str:
    """How alike two codes are on the same elements, and what the model is worth in moduli."""
    found = record.findings
    alike = [row.hex27.max_mm for row in found.differences if row.hex27 is not None]
    same = f"at most {max(alike):.1g} mm apart" if alike else "not compared"
    own = {row.data: row.estimate for row in found.rows if row.model == row.data}
    apart = [
        abs(e / o - 1)
        for row in found.rows
        if row.converged and row.model != row.data and row.model in own
        for e, o in zip(row.estimate, own[row.data], strict=True)
    ]
    moduli = f"; with other elements, moduli up to {100 * max(apart):.2g} % apart" if apart else ""
    return f"Simulated sheet in two finite-element codes, the same elements: {same}{moduli}."


def models_text(record: Record[Findings]) -> str:
    """Markdown of the two tables and the words around them."""
    if not record.findings.rows:
        return f"No estimate: {record.reason}."
    return "\n\n".join(
        [
            _words(record),
            markdown_rows(_estimates(record)),
            "How far the observed points, and their derivatives by the moduli, are from those of "
            "scikit-fem with the Biot law on the same mesh, at the true moduli. The same elements "
            "are triquadratic bricks, in both codes with the same quadrature; solid-shells are "
            "what this project uses for leaflets, compared with fully integrated bricks:",
            markdown_rows(_differences(record.findings)),
        ]
    )


def models_figure(record: Record[Findings]) -> Figure | None:
    """The deformed sheet of both codes, the codes' difference, and the estimates of every model."""
    findings = record.findings
    if not findings.rows:
        return None
    figure = Figure(figsize=(11.0, 7.4), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[1.0, 1.1])
    _draw_sheet(
        figure.add_subplot(grid[0, 0], projection="3d", computed_zorder=False), record.findings
    )
    _draw_differences(figure.add_subplot(grid[1, 0]), findings)
    panels = [figure.add_subplot(grid[k, 1]) for k in range(len(record.parameters))]
    for k, axes in enumerate(panels):
        _draw_iterates(axes, findings, k)
        axes.set_ylabel(f"{record.parameters[k]} [MPa]")
    panels[0].set_title("estimates iterate by iterate; the start lies outside", fontsize=10)
    lines, names = panels[0].get_legend_handles_labels()
    panels[0].legend(lines, names, frameon=False, fontsize=8, ncols=2)
    return figure


def _draw_sheet(axes: Axes3D, findings: Findings) -> None:
    sheet = findings.sheet
    (one, first), (other, second) = findings.shapes.items()
    surface = _with_clamped_sides(np.array(first), sheet)
    middle = surface.shape[0] // 2
    halves = ((surface[: middle + 1], COLOURS[4]), (surface[middle:], COLOURS[5]))
    for part, colour in halves:
        axes.plot_surface(
            *np.moveaxis(part, -1, 0), color=colour, edgecolor="white", linewidth=0.6, shade=True,
            rstride=1, cstride=1, alpha=0.6, zorder=1,
        )  # fmt: skip
    axes.scatter(
        *np.array(second).T,
        color="black",
        s=8,
        depthshade=False,
        zorder=2,
        label=f"{other}, points",
    )
    for name, colour in (("annulus", COLOURS[4]), ("free edge", COLOURS[5])):
        axes.plot([], [], color=colour, linewidth=6, label=f"{one}, half at the {name}")
    axes.set_box_aspect(tuple(np.ptp(surface.reshape(-1, 3), axis=0)), zoom=1.25)
    axes.set_proj_type("ortho")
    axes.view_init(28, -28)
    axes.set_axis_off()
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    axes.set_title(
        f"the pressed sheet, {sheet.length:g} × {sheet.width:g} mm, to scale", fontsize=10
    )


def _with_clamped_sides(points: FloatArray, sheet: Sheet) -> FloatArray:
    """Observed points as a grid ``(along, across, 3)``, the sides that do not move added."""
    along, across = sheet.observed
    grid = np.zeros((along + 1, across + 2, 3))
    grid[..., 0] = np.linspace(0.0, sheet.length, along + 1)[:, None]
    grid[..., 1] = np.linspace(0.0, sheet.width, across + 2)
    grid[..., 2] = 0.5 * sheet.thickness
    grid[1:, 1:-1] = points.reshape(along, across, 3)
    return grid


def _draw_iterates(axes: Any, findings: Findings, k: int) -> None:
    """One modulus iterate by iterate: the colour is the model's, the line the data's."""
    styles = dict(zip(findings.shapes, ("-", ":"), strict=True))
    models = list(dict.fromkeys(row.model for row in findings.rows))
    shown = [findings.truth[k]]
    for row in findings.rows:
        n = models.index(row.model)
        values = np.array(row.iterates)[:, k]
        shown += values[1:].tolist()
        axes.plot(
            np.arange(len(values)), values, linestyle=styles[row.data], color=COLOURS[n],
            marker=MARKERS[n], markersize=10 - 1.5 * n, markerfacecolor="none",
        )  # fmt: skip
    first = findings.rows[0]
    axes.errorbar(
        len(first.iterates) - 0.85, first.estimate[k], first.std[k], color="black",
        capsize=3, linewidth=1, label="± 1 SD of the noise and the prior",
    )  # fmt: skip
    shown += [first.estimate[k] + sign * first.std[k] for sign in (-1, 1)]
    axes.axhline(findings.truth[k], color="grey", linestyle="--", linewidth=1, label="truth")
    for data, style in styles.items():
        axes.plot([], [], color="black", linestyle=style, label=f"data of {data}")
    for n, model in enumerate(models):
        axes.plot([], [], color=COLOURS[n], marker=MARKERS[n], markerfacecolor="none", label=model)
    margin = 0.1 * (max(shown) - min(shown))
    # Room for the legend above the first panel's lines.
    axes.set_ylim(min(shown) - margin, max(shown) + (5 if k == 0 else 1) * margin)
    axes.set_xlabel("iteration")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_differences(axes: Axes, findings: Findings) -> None:
    rows = findings.differences
    at = np.arange(len(rows))
    for n, name in enumerate(AGAINST):
        column = [_against(row)[n] for row in rows]
        values = [np.nan if apart is None else apart.max_mm for apart in column]
        axes.semilogy(at, values, color=COLOURS[n], marker=MARKERS[n], label=name)
    axes.set_xticks(at, [" × ".join(map(str, row.cells)) for row in rows])
    axes.set_xlabel("cells along × across × through the thickness")
    axes.set_ylabel("largest distance [mm]")
    axes.set_title("distance from scikit-fem with the Biot law, same mesh", fontsize=10)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="center right")
