"""One look for all figures: colours, sizes, axes.

Sizes are meant for a page about 800 pixels wide, where a figure of 8.3 inches shows 9-point text at
about 12 pixels. Colours are Okabe and Ito's, colour maps run evenly in lightness.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from mvest.reporting.figures import COLOURS

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
