"""The closing valve: a table of its steps, and pictures with the curves that matter."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from experiments.common.plain import Plain, flat
from experiments.common.record import Record as Run
from mvest.files import write_atomically
from mvest.reporting.figures import save_figure
from mvest.reporting.files import provenance_line
from mvest.typing import FloatArray, IntArray

__all__ = ["closure_figure", "closure_text", "write_closure"]

Record = Mapping[str, Any]

COLOURS = np.array([[0.85, 0.45, 0.40], [0.40, 0.55, 0.85], [0.45, 0.70, 0.45]])
LIGHT = np.array([0.3, 0.5, 0.81])


def closure_figure(record: Record, fields: Path) -> Figure:
    """Four moments seen from the atrium and from the side, above opening, leak and coaptation."""
    with np.load(fields, allow_pickle=False) as stored:
        frames, times = stored["frames"].astype(float), stored["times"]
        triangles, region = stored["triangles"], stored["region"]
    table = pd.DataFrame(record["rows"])
    shown = _moments(table)
    figure = Figure(figsize=(11, 8.2), layout="constrained")
    grid = figure.add_gridspec(3, 4, height_ratios=[1.1, 0.9, 0.9])
    for column, k in enumerate(shown):
        for row, (elevation, azimuth) in enumerate(((89.0, -90.0), (8.0, -90.0))):
            axes = figure.add_subplot(grid[row, column], projection="3d")
            _draw(axes, frames[k], frames[0], triangles, region, elevation, azimuth)
            if row == 0:
                pressure = table.pressure_mmhg[k]
                static = k == len(times) - 1
                label = "equilibrium" if static else f"{times[k]:.2f} s"
                axes.set_title(f"{label}, {pressure:.0f} mmHg", fontsize=9)
    step = np.arange(len(table))
    for column, (name, label) in enumerate(
        (
            ("orifice_mm2", "orifice (mm²)"),
            ("passing_ball_mm", "passing ball (mm)"),
            ("coaptation_mm", "coaptation (mm)"),
            ("chord_strain", "largest chord strain"),
        )
    ):
        axes = figure.add_subplot(grid[2, column])
        axes.plot(step, table[name], ".-", color="black", lw=1)
        axes.set_xlabel("stored step")
        axes.set_ylabel(label)
    figure.suptitle("A simulated valve closing: from the atrium (top) and from the posterior side")
    return figure


def _moments(table: pd.DataFrame) -> list[int]:
    """Open, half open, nearly closed, closed."""
    opening = table.orifice_mm2.to_numpy()
    share = opening / max(float(opening[0]), 1e-9)
    return [0, *(int(np.argmax(share < level)) for level in (0.75, 0.1)), len(table) - 1]


def _draw(
    axes: Any,
    x: FloatArray,
    rest: FloatArray,
    triangles: IntArray,
    region: IntArray,
    elevation: float,
    azimuth: float,
) -> None:
    corners = x[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shade = 0.45 + 0.55 * np.abs(normal @ LIGHT)
    colours = np.clip(COLOURS[region % len(COLOURS)] * shade[:, None], 0, 1)
    axes.add_collection3d(Poly3DCollection(corners, facecolors=colours, edgecolors="none"))
    low, high = rest.min(axis=0), rest.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.22)
    axes.set_proj_type("ortho")
    axes.view_init(elevation, azimuth)
    axes.set_axis_off()


def _summary(record: Record) -> str:
    rows = record["rows"]
    first, last = rows[0], rows[-1]
    return "\n".join(
        [
            "| measure | value |",
            "|---|---|",
            f"| orifice open | {first['orifice_mm2']:.0f} mm² |",
            f"| orifice closed | {last['orifice_mm2']:.1f} mm² |",
            f"| largest passing ball, closed | {last['passing_ball_mm']:.2f} mm |",
            f"| coaptation in the middle (midsurfaces within "
            f"{record['contact_distance_mm']:.2f} mm) | {last['coaptation_mm']:.1f} mm |",
            f"| intersecting leaflet faces, all {len(rows)} stored steps | "
            f"{sum(r['intersections'] for r in rows)} |",
            f"| peak chord strain, closed / any step | {100 * last['chord_strain']:.1f} % / "
            f"{100 * max(r['chord_strain'] for r in rows):.1f} % |",
            f"| peak chord force, closed | {last['chord_force_n']:.2f} N |",
            f"| smallest determinant of F, any step | "
            f"{min(r['smallest_jacobian'] for r in rows):.2f} |",
            f"| Newton iterations | {last['newton_iterations']} |",
        ]
    )


def closure_text(record: Record) -> str:
    """The summary for the terminal."""
    return _summary(record)


def write_closure_tables(folder: Path, record: Record) -> list[Path]:
    """``closure.csv`` (every step) and ``closure.md`` (the summary)."""
    table = pd.DataFrame(record["rows"])
    text = f"# {record['title']}\n\n{_summary(record)}\n\n{provenance_line(record)}\n"
    return [
        write_atomically(folder / "closure.csv", lambda path: table.to_csv(path, index=False)),
        write_atomically(folder / "closure.md", text),
    ]


def write_closure(
    folder: Path, records: Mapping[str, Run[Plain]], arrays: Mapping[str, Path]
) -> list[Path]:
    """Table and words of each closure, and its figure where its frames are still there."""
    written = []
    for name, run in records.items():
        record = flat(run)
        written += write_closure_tables(folder, record)
        if name in arrays:
            written += save_figure(folder / "closure", closure_figure(record, arrays[name]), record)
    return written
