"""One look for all figures of sweeps: colours, sizes, labels at the data.

Sizes are meant for a page about 800 pixels wide, where a figure of 8.3 inches shows 9-point text at
about 12 pixels. Colours are Okabe and Ito's, colour maps run evenly in lightness.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from mvest.reporting.figures import COLOURS, MARKERS
from mvest.typing import FloatArray

__all__ = [
    "BAD",
    "COLOURS",
    "GOOD",
    "GREY",
    "MARKERS",
    "SEQUENTIAL",
    "SMALL",
    "TEXT",
    "WIDTH",
    "headline",
    "label_ends",
    "levels",
    "log_axis",
    "panels",
    "plain_axes",
    "plain_number",
]

WIDTH = 8.3
"""Inches."""
TEXT, SMALL = 10, 8.5
"""Points, of titles and of everything else."""
GOOD, BAD, GREY = COLOURS[0], COLOURS[1], "0.45"
SEQUENTIAL = "cividis"


def panels(
    rows: int, columns: int, height: float, *, sharex: Any = False, sharey: Any = False
) -> tuple[Figure, Any]:
    """A figure of the common width and its axes ``(rows, columns)``; height in inches."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
    for one in axes.flat:
        plain_axes(one)
    return figure, axes


def plain_axes(axes: Any) -> None:
    """No frame on top and right, a faint grid behind the data, readable ticks."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL)
    axes.xaxis.label.set_size(SMALL + 0.5)
    axes.yaxis.label.set_size(SMALL + 0.5)


def headline(figure: Figure, text: str, note: str = "") -> None:
    """What the figure shows, left above everything, and below it how to read it."""
    size = TEXT + 0.5
    room = "\n" * (note.count("\n") + 1) if note else ""
    title = figure.suptitle(text + room, fontsize=size, x=0.01, ha="left")
    title.set_fontweight("bold")
    if note:
        # The empty lines of the title keep this place free.
        below = 1.0 - (4.0 + 1.45 * size) / 72.0 / figure.get_figheight()
        figure.text(0.01, below, note, fontsize=SMALL, color="0.25", va="top")


def plain_number(value: float) -> str:
    """A number for an axis or a cell: two digits, powers of ten only where they are shorter."""
    if value == 0:
        return "0"
    if abs(value) < 1e-3 or abs(value) >= 1e5:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def log_axis(axis: Any) -> None:
    """Label a logarithmic axis with 0.01, 0.1, 1 instead of powers of ten."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    axis.set_minor_formatter(NullFormatter())


def levels(n: int) -> list[Any]:
    """N colours in order from dark to light, light enough to part and dark enough to see."""
    return [colormaps["viridis"](value) for value in np.linspace(0.0, 0.85, max(n, 1))]


def label_ends(
    axes: Any, x: float, ends: Sequence[tuple[float, str, Any]], *, gap: float = 0.055
) -> None:
    """Names beside the right ends of curves, pushed apart where they would overlap.

    Parameters
    ----------
    axes : Axes
        Its limits and scales are what they will be.
    x : float
        Where the curves end, in data coordinates.
    ends : sequence of (y, text, colour)
        y in data coordinates.
    gap : float
        Least distance between two labels, as part of the height of the axes.
    """
    if not ends:
        return
    # Asking for the limits makes matplotlib settle them; the transformation alone does not.
    axes.get_xlim(), axes.get_ylim()
    to_axes = axes.transData + axes.transAxes.inverted()
    places = np.array([to_axes.transform((x, y))[1] for y, _, _ in ends])
    left = float(to_axes.transform((x, ends[0][0]))[0]) + 0.02
    spread = _apart(np.clip(places, 0.0, 1.0), gap)
    for (_, text, colour), place in zip(ends, spread, strict=True):
        axes.annotate(
            text, (left, place), xycoords="axes fraction", color=colour, fontsize=SMALL,
            va="center", ha="left", annotation_clip=False,
        )  # fmt: skip


def _apart(places: FloatArray, gap: float) -> FloatArray:
    """Positions in the same order, at least ``gap`` apart and below 1."""
    order = np.argsort(places, kind="stable")
    moved = places[order].copy()
    for k in range(1, len(moved)):
        moved[k] = max(moved[k], moved[k - 1] + gap)
    # What was pushed beyond the top comes back down together.
    over = max(float(moved[-1]) - 1.0, 0.0)
    for k in range(len(moved) - 1, -1, -1):
        limit = moved[k + 1] - gap if k + 1 < len(moved) else 1.0
        moved[k] = min(moved[k], limit) if over else moved[k]
    result = np.empty_like(moved)
    result[order] = moved
    return result
