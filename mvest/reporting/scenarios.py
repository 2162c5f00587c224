"""Predicted closed valves seen from the atrium, with measures and their intervals below.

Leaflets are midsurfaces, which lie a thickness apart where they touch; the slit between them is
drawn as tissue, and what is left open in the colour of blood.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from pandas import DataFrame

from mvest.errors import InputError
from mvest.problem.fields import read_case_fields
from mvest.reporting.case.drawing import (
    BLOOD,
    TISSUE,
    draw_valve,
    leaflet_colours,
    name_leaflets,
    paint_leak,
    same_scale,
)
from mvest.reporting.figures import ATRIUM, COLOURS, SMALL, TEXT, plain_axes

Row = Mapping[str, Any]

OTHER = "0.55"
"""Colour of further patients."""


def scenarios_figure(
    fields: Path,
    rows: Sequence[Row],
    labels: Mapping[str, str],
    reach_mm: float,
    failed: Mapping[str, str],
) -> Figure:
    """The first patient's valve by scenario, above dots with 95 % intervals of all patients.

    Parameters
    ----------
    fields : Path
        As `mvest.problem.fields.read_case_fields` reads it: the frames are the titles of the
        scenarios, the fitted shapes the closed valves, NaN where one did not close.
    rows : sequence of mapping
        ``patient``, ``scenario``, ``measure`` and what
        `mvest.scenarios.predict.PredictedScenario.against` says of it.
    labels : mapping
        Measures to be drawn, six at most, and what readers call them.
    reach_mm : float
        Distance of midsurfaces within which leaflets touch.
    failed : mapping
        Title of a scenario -> why the valve did not close.

    Raises
    ------
    InputError
        If the fields cannot be read.
    """
    valve = replace(read_case_fields(fields, turned=False), reach_mm=reach_mm)
    if valve.fitted is None:
        raise InputError(f"{fields}: no closed valves")
    figure = Figure(figsize=(max(2.7 * len(valve.frames), 8.0), 8.6), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[1.0, 1.75])
    upper, lower = parts
    panels = upper.subplots(1, len(valve.frames), squeeze=False)[0]
    colours = leaflet_colours(valve.region)
    every = DataFrame(list(rows))
    patients = list(every["patient"].unique())
    first = every[(every["patient"] == patients[0]) & (every["measure"] == "gap_mm2")]
    gaps = first.set_index("scenario")["estimate"]
    for axes, title, shape in zip(panels, valve.frames, valve.fitted, strict=True):
        if not np.isfinite(shape).all():
            axes.set_axis_off()
            axes.set_title(f"{title}\nnot closed: {failed.get(title, '')}", fontsize=SMALL)
            continue
        draw_valve(axes, valve, shape, colours, ATRIUM, 0)
        paint_leak(axes, valve, shape, 0)
        axes.set_title(f"{title}\ngap {gaps[title]:.1f} mm²", fontsize=TEXT)
    name_leaflets(panels[0], valve, ("anterior", "posterior"))
    known = [shape for shape in valve.fitted if np.isfinite(shape).all()]
    same_scale(panels, [*known, valve.rest], ATRIUM)
    names = {"gap": BLOOD, "leaflets touch (between midsurfaces)": TISSUE}
    handles = [Patch(color=colour, label=label) for label, colour in names.items()]
    upper.legend(handles=handles, loc="lower right", fontsize=SMALL, frameon=False, ncols=2)
    grid = lower.subplots(2, 3)
    for axes, (measure, label) in zip(grid.flat, labels.items(), strict=False):
        _draw_measure(axes, every[every["measure"] == measure], valve.frames, patients)
        axes.set_title(label, fontsize=SMALL, loc="left")
    keys, where = grid[0, 0].get_legend_handles_labels(), "outside lower center"
    lower.legend(*keys, loc=where, fontsize=SMALL, frameon=False, ncols=4)
    title = "An estimated valve as observed and under changed conditions (simulated)"
    figure.suptitle(f"{title}\n", fontsize=TEXT + 2)
    return figure


def _draw_measure(
    axes: Any, rows: DataFrame, titles: Sequence[str], patients: Sequence[Any]
) -> None:
    """Draw one measure of all patients; matplotlib leaves out what is missing."""
    plain_axes(axes)
    further = rows["patient"].map(patients.index)
    x = rows["scenario"].map(titles.index) - 0.12 + (0.14 + 0.13 * further) * (further > 0)
    numbers = rows.filter(regex="low|high|estimate|truth").astype(float)
    for own, colour, label in (
        (
            further == 0,
            COLOURS[0],
            "estimate (drawn above), 95 %: thick samples, thin with the mesh",
        ),
        (further > 0, OTHER, "further simulated patients"),
    ):
        at, of = x[own], numbers[own]
        axes.vlines(at, of["wide_low"], of["wide_high"], color=colour, lw=0.8)
        axes.vlines(at, of["low"], of["high"], color=colour, lw=2.5)
        axes.plot(at, of["estimate"], "o", color=colour, ms=5)
        axes.errorbar([], [], yerr=[], fmt="o", color=colour, label=label)
    for truth, label, marker, colour, size in (
        ("truth_own_mesh", "true valve (its own mesh)", "x", COLOURS[1], 6),
        ("truth_same_mesh", "true valve (same mesh)", "_", "black", 9),
    ):
        axes.plot(x, numbers[truth], marker, color=colour, ms=size, zorder=4, label=label)
    axes.set_xticks(range(len(titles)), titles, fontsize=SMALL, rotation=20, ha="right")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
