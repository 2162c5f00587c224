"""Predicted closed valves seen from the atrium, with measures and their intervals below.

The leaflets are midsurfaces, which lie a thickness apart where they touch; the slit between them is
drawn as tissue, and what is left open in the colour of blood.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from experiments.studies.prediction.findings import Findings, Patient
from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reporting.case.drawing import (
    ATRIUM,
    BLOOD,
    TISSUE,
    draw_valve,
    leaflet_colours,
    name_leaflets,
    paint_gap,
    same_scale,
)
from mvest.reporting.case.fields import CaseFields
from mvest.reporting.figures import COLOURS
from mvest.typing import FloatArray

__all__ = ["prediction_figure"]

PANELS = (
    ("gap_mm2", "regurgitant gap (mm²)"),
    ("coaptation_length_mm", "coaptation length (mm)"),
    ("coaptation_area_mm2", "coaptation area (mm²)"),
    ("tenting_height_mm", "tenting height (mm)"),
    ("stress_p99_anterior_mpa", "stress, anterior,\n99th percentile (MPa)"),
    ("stress_p99_posterior_mpa", "stress, posterior,\n99th percentile (MPa)"),
)
OTHER = "0.55"


def prediction_figure(findings: Findings, fields: Path) -> Figure:
    """Valves by scenario above dots with 95 % intervals, the truth beside them.

    Parameters
    ----------
    findings : Findings
    fields : Path
        An ``.npz`` file with ``shapes (s, n, 3)`` mm in the order of the scenarios, ``rest
        (n, 3)`` mm, ``triangles``, ``region``, ``annulus``, ``free_edge`` and ``tips``.

    Raises
    ------
    InputError
        If the fields cannot be read.
    """
    try:
        arrays = read_npz(fields)
        valve = _valve(arrays)
        shapes = arrays["shapes"].astype(float)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{fields}: no fields of a prediction ({error})") from error
    titles = list(findings.scenarios.values())
    figure = Figure(figsize=(max(2.7 * len(titles), 8.0), 8.6), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[1.0, 1.75])
    upper, lower = parts
    _draw_valves(upper, valve, shapes, findings)
    _draw_measures(lower, findings)
    figure.suptitle(
        "An estimated valve as observed and under changed conditions (simulated)\n", fontsize=12
    )
    return figure


def _valve(arrays: Mapping[str, Any]) -> CaseFields:
    none = np.zeros(0, dtype=np.int64)
    return CaseFields(
        triangles=arrays["triangles"].astype(np.int64),
        region=arrays["region"].astype(np.int64),
        rest=arrays["rest"].astype(float),
        annulus=arrays["annulus"].astype(np.int64),
        free_edge=arrays["free_edge"].astype(np.int64),
        frames=("closed",),
        seen=np.ones(1, dtype=bool),
        tips=np.stack([arrays["tips"].astype(float)] * 2),
        chord_tip=none,
        chord_insertion=none,
        observed_points={},
    )


# -- pictures -------------------------------------------------------------------------------------
def _draw_valves(part: Any, valve: CaseFields, shapes: FloatArray, findings: Findings) -> None:
    panels = np.atleast_1d(part.subplots(1, len(shapes)))
    scenarios = findings.patients[0].scenarios
    colours = leaflet_colours(valve.region)
    for panel, (name, title), shape in zip(panels, findings.scenarios.items(), shapes, strict=True):
        if not np.isfinite(shape).all():
            panel.set_axis_off()
            panel.set_title(f"{title}\nnot closed: {scenarios[name].failure}", fontsize=9)
            continue
        draw_valve(panel, valve, shape, colours, ATRIUM, 0)
        paint_gap(panel, valve, shape, 0, findings.reach_mm)
        area = scenarios[name].measures["gap_mm2"].estimate
        panel.set_title(f"{title}\ngap {area:.1f} mm²", fontsize=10)
    name_leaflets(panels[0], valve, ("anterior", "posterior"))
    known = [shape for shape in shapes if np.isfinite(shape).all()]
    same_scale(list(panels), [*known, valve.rest], ATRIUM)
    part.legend(
        handles=[
            Patch(color=BLOOD, label="gap"),
            Patch(color=TISSUE, label="leaflets touch (between midsurfaces)"),
        ],
        loc="lower right",
        fontsize=8,
        frameon=False,
        ncols=2,
    )


# -- measures -------------------------------------------------------------------------------------
def _draw_measures(part: Any, findings: Findings) -> None:
    panels = part.subplots(2, 3).ravel()
    names = list(findings.scenarios)
    for panel, (measure, label) in zip(panels, PANELS, strict=True):
        for number, patient in enumerate(findings.patients):
            shift = 0.0 if number == 0 else 0.14 + 0.13 * number
            _dots(panel, patient, names, measure, shift, COLOURS[0] if number == 0 else OTHER)
        panel.set_xticks(range(len(names)), list(findings.scenarios.values()))
        panel.set_xticklabels(panel.get_xticklabels(), fontsize=8, rotation=20, ha="right")
        panel.set_ylabel(label, fontsize=9)
        panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
        panel.grid(axis="y", alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
    first = panels[0]
    first.errorbar(
        [],
        [],
        yerr=[],
        fmt="o",
        color=COLOURS[0],
        label="estimate (drawn above), 95 %: thick samples, thin with the mesh",
    )
    first.errorbar([], [], yerr=[], fmt="o", color=OTHER, label="further simulated patients")
    first.plot([], [], "x", color=COLOURS[1], ls="none", label="true valve (its own mesh)")
    first.plot([], [], "_", color="black", ls="none", label="true valve (same mesh)")
    handles, labels = first.get_legend_handles_labels()
    part.legend(handles, labels, loc="outside lower center", fontsize=8, frameon=False, ncols=4)


def _dots(
    panel: Any,
    patient: Patient,
    names: Sequence[str],
    measure: str,
    shift: float,
    colour: str,
) -> None:
    for place, name in enumerate(names):
        scenario = patient.scenarios.get(name)
        row = None if scenario is None else scenario.measures.get(measure)
        if row is None:
            continue
        x = place + shift - 0.12
        if row.wide_low is not None:
            panel.plot([x, x], [row.wide_low, row.wide_high], color=colour, linewidth=0.8)
        if row.low is not None:
            panel.plot([x, x], [row.low, row.high], color=colour, linewidth=2.5)
        panel.plot([x], [row.estimate], "o", color=colour, markersize=5)
        if row.truth_own_mesh is not None:
            panel.plot([x], [row.truth_own_mesh], "x", color=COLOURS[1], markersize=6, zorder=4)
        if row.truth_same_mesh is not None:
            panel.plot([x], [row.truth_same_mesh], "_", color="black", markersize=9, zorder=4)
