"""The closing valve: a table of its steps, and pictures with the curves that matter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.common.records.record import Record
from experiments.common.records.report import write_report
from mvest.closure.measures import StepMeasures
from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reporting.case.drawing import (
    ATRIUM,
    View,
    draw_valve,
    leaflet_colours,
    name_leaflets,
    paint_leak,
    same_scale,
)
from mvest.reporting.case.fields import CaseFields
from mvest.reporting.style import COLOURS, plain_axes
from mvest.typing import FloatArray

__all__ = [
    "Findings",
    "closure_answer",
    "closure_figure",
    "closure_table",
    "closure_words",
    "write_closure",
]

POSTERIOR = View("seen from the posterior side", 8.0, -90.0)
CURVES = (
    ("orifice_mm2", "orifice (mm²)", 1.0),
    ("passing_ball_mm", "largest ball that passes (mm)", 1.0),
    ("coaptation_mm", "coaptation in the middle (mm)", 1.0),
    ("chord_strain", "largest strain of a chord (%)", 100.0),
)


@dataclass(frozen=True, slots=True)
class Findings:
    """How the valve closes.

    Attributes
    ----------
    rows : tuple of StepMeasures
        One for each stored step.
    contact_distance_mm : float
        Between midsurfaces, up to which leaflets count as coapting.
    equilibrium : bool
        Whether the last step is the static equilibrium after the motion.
    """

    rows: tuple[StepMeasures, ...]
    contact_distance_mm: float
    equilibrium: bool


def closure_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per stored step."""
    return pd.DataFrame(map(asdict, record.findings.rows))


def closure_figure(record: Record[Findings], fields: Path) -> Figure:
    """Four moments seen from the atrium and from the side, above opening, leak and coaptation.

    Parameters
    ----------
    record : Record
    fields : Path
        An ``.npz`` file with ``frames (f, n, 3)`` mm, ``times (f,)`` s, ``triangles``, ``region``,
        ``annulus`` in loop order, ``tips (f, t, 3)`` mm, ``chord_end (f, c, 3)`` mm,
        ``chord_tip (c,)`` and ``reach_mm``, the distance of faces within which leaflets touch.

    Raises
    ------
    InputError
        If the fields cannot be read.
    """
    try:
        arrays = read_npz(fields)
        # The ends of the chordae are points of no triangle.
        shapes = np.concatenate([arrays["frames"], arrays["chord_end"]], axis=1).astype(float)
        valve = _valve(arrays, shapes)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{fields}: no fields of a closing valve ({error})") from error
    found = record.findings
    moments = _moments(found)
    figure = Figure(figsize=(11, 8.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[2.2, 1.0])
    _draw_moments(parts[0], valve, shapes, found, moments)
    _draw_curves(parts[1], found, moments)
    figure.suptitle(
        "A simulated valve closing, from the atrium and from the posterior side"
        " (dots: the moments shown)",
        fontsize=11,
    )
    return figure


def _valve(arrays: Mapping[str, Any], shapes: FloatArray) -> CaseFields:
    count = len(arrays["chord_tip"])
    return CaseFields(
        triangles=arrays["triangles"].astype(np.int64),
        region=arrays["region"].astype(np.int64),
        rest=shapes[0],
        annulus=arrays["annulus"].astype(np.int64),
        free_edge=np.zeros(0, dtype=np.int64),
        frames=tuple(f"{t:g} s" for t in arrays["times"][1:]),
        seen=np.ones(len(shapes) - 1, dtype=bool),
        tips=arrays["tips"].astype(float),
        chord_tip=arrays["chord_tip"].astype(np.int64),
        chord_insertion=shapes.shape[1] - count + np.arange(count),
        observed_points={},
        reach_mm=float(arrays["reach_mm"]),
    )


def _moments(found: Findings) -> list[int]:
    """Open, half open, nearly closed, closed; the last one for what is never reached."""
    opening = np.array([row.orifice_mm2 for row in found.rows])
    share = opening / max(float(opening[0]), 1e-9)
    last = len(opening) - 1
    reached = [np.append(np.flatnonzero(share < level), last)[0] for level in (0.75, 0.1)]
    return [0, *map(int, reached), last]


def _draw_moments(
    part: Any, valve: CaseFields, shapes: FloatArray, found: Findings, moments: list[int]
) -> None:
    panels = part.subplots(2, len(moments), height_ratios=[1.0, 1.35])
    colours = leaflet_colours(valve.region)
    for column, k in enumerate(moments):
        for view, panel in zip((ATRIUM, POSTERIOR), panels[:, column], strict=True):
            draw_valve(panel, valve, shapes[k], colours, view, k, chords=view is POSTERIOR)
        row = found.rows[k]
        at_rest = found.equilibrium and k == len(found.rows) - 1
        when = "at rest" if at_rest else f"{row.time:.2f} s"
        panels[0, column].set_title(f"{when}, {row.pressure_mmhg:.0f} mmHg", fontsize=10)
    paint_leak(panels[0, -1], valve, shapes[moments[-1]], moments[-1])
    name_leaflets(panels[0, 0], valve, ("anterior", "posterior"))
    shown = [shapes[k] for k in moments]
    same_scale(list(panels[0]), shown, ATRIUM)
    same_scale(list(panels[1]), [*shown, *(valve.tips[k] for k in moments)], POSTERIOR)


def _draw_curves(part: Any, found: Findings, moments: list[int]) -> None:
    """Measures over time; what was drawn above is marked, and the equilibrium stands apart."""
    table = pd.DataFrame(map(asdict, found.rows))
    moving = table[: len(table) - 1] if found.equilibrium else table
    end = float(moving.time.iloc[-1])
    # The equilibrium is at no time.
    place = np.append(moving.time, 1.13 * end)[: len(table)]
    for axes, (name, label, scale) in zip(part.subplots(1, len(CURVES)), CURVES, strict=True):
        plain_axes(axes)
        values = scale * table[name].to_numpy()
        axes.plot(moving.time, values[: len(moving)], ".-", color="black", lw=1, ms=4)
        axes.plot(place[moments], values[moments], "o", color=COLOURS[1], ms=5.5)
        axes.set_xlabel("time (s)")
        axes.set_ylim(bottom=min(0.0, 1.1 * values.min()))
        axes.set_title(label, fontsize=9, loc="left")
        if found.equilibrium:
            axes.axvline(1.065 * end, color="0.8", lw=0.8)
            ticks = [t for t in axes.get_xticks() if 0 <= t <= 0.9 * end]
            axes.set_xticks([*ticks, place[-1]], [*(f"{t:g}" for t in ticks), "at rest"])
            axes.set_xlim(-0.03 * end, 1.22 * end)


def closure_answer(record: Record[Findings]) -> str:
    """How well the simulated valve closes."""
    rows = record.findings.rows
    first, last = rows[0], rows[-1]
    return (
        f"The simulated valve closes from {first.orifice_mm2:.0f} to {last.orifice_mm2:.1f} mm² "
        f"of orifice, {sum(row.intersections for row in rows)} intersecting faces in "
        f"{len(rows)} stored steps."
    )


def closure_words(record: Record[Findings]) -> str:
    """The summary for readers."""
    found = record.findings
    rows = found.rows
    first, last = rows[0], rows[-1]
    return "\n".join(
        [
            "| measure | value |",
            "|---|---|",
            f"| orifice open | {first.orifice_mm2:.0f} mm² |",
            f"| orifice closed | {last.orifice_mm2:.1f} mm² |",
            f"| largest passing ball, closed | {last.passing_ball_mm:.2f} mm |",
            f"| coaptation in the middle (midsurfaces within "
            f"{found.contact_distance_mm:.2f} mm) | {last.coaptation_mm:.1f} mm |",
            f"| intersecting leaflet faces, all {len(rows)} stored steps | "
            f"{sum(row.intersections for row in rows)} |",
            f"| peak chord strain, closed / any step | {100 * last.chord_strain:.1f} % / "
            f"{100 * max(row.chord_strain for row in rows):.1f} % |",
            f"| peak chord force, closed | {last.chord_force_n:.2f} N |",
            f"| smallest determinant of F, any step | "
            f"{min(row.smallest_jacobian for row in rows):.2f} |",
            f"| Newton iterations | {last.newton_iterations} |",
        ]
    )


def write_closure(
    folder: Path, records: Mapping[str, Record[Findings]], arrays: Mapping[str, Path]
) -> list[Path]:
    """Table and words of each closure, and its figure where its frames are still there."""
    written = []
    for name, record in records.items():
        figure = closure_figure(record, arrays[name]) if name in arrays else None
        words = closure_words(record)
        written += write_report(folder, record, closure_table(record), words, figure)
    return written
