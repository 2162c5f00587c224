"""Shared parts of all figures: colours, sizes, axes, viewing directions, and output files.

Sizes are meant for a page about 800 pixels wide, on which a figure of 8.3 inches shows 9-point text
at about 12 pixels. The colours suit people with colour blindness, every line also has its own
marker, and colour maps are perceptually uniform. Nothing here touches matplotlib's global state or
needs a display.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, NullFormatter
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mvest.files import write_atomically
from mvest.reporting.markup import shown_text
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from mvest.problem.record import EstimateRecord

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito, Color Universal Design (2008)."""
GOOD, BAD, GREY = COLOURS[0], COLOURS[1], "0.45"

LEAFLET_COLOURS = np.array([[0.45, 0.70, 0.83], [0.91, 0.65, 0.45], [0.45, 0.79, 0.70]])
"""Of the leaflets by region, ``(3, 3)``: tints of the first `COLOURS`, which can be shaded."""

MARKERS = ("o", "s", "^", "D", "v", "P")
SEQUENTIAL, DISTANCE_MAP = "cividis", "viridis"
DPI = 140
WIDTH = 8.3
"""Inches."""
SCALE_MM = 10.0
TEXT, SMALL = 10, 8.5
"""Points, of titles and of everything else."""
CHARACTERS_AN_INCH = 23
"""Of the provenance line at the foot."""

LONGEST_LINE, LONGEST_TEXT, MAX_LINES, CUT_TO = 400, 160, 6, 20
"""Most characters of the provenance line, and of a line of other texts; most lines of a text; and
characters that are shown of a text beyond these limits, which would leave no room for the plot."""
TICK = re.compile(r"\$\\mathdefault\{[−-]?[\d.]*(?:\\times)?[\d.]*(?:\^\{[−-]?[\d.]+\})?\}\$")
"""Tick labels of logarithmic axes."""


@dataclass(frozen=True, slots=True)
class View:
    """A direction to look from: elevation over the annulus plane and azimuth, degrees."""

    name: str
    elevation: float
    azimuth: float

    @property
    def axes(self) -> FloatArray:
        """``(3, 3)``, columns: to the right, up, and towards the eye."""
        e, a = np.deg2rad(self.elevation), np.deg2rad(self.azimuth)
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(eye, right), eye], axis=1)


ATRIUM = View("from the atrium", 90.0, -90.0)
SIDE = View("from the side", 12.0, -60.0)
VIEWS = (ATRIUM, SIDE)
"""The atrium is at positive z."""


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
    for axis in (axes.xaxis, axes.yaxis):
        axis.label.set_size(SMALL + 0.5)


def scale_bar(axes: Any, colour: str) -> None:
    """Draw a bar of `SCALE_MM` into the lower left corner of axes in millimetres."""
    bar = AnchoredSizeBar(
        axes.transData, SCALE_MM, f"{SCALE_MM:.0f} mm", loc="lower left", color=colour,
        frameon=False, size_vertical=0.25, label_top=True,
        fontproperties=FontProperties(size=SMALL - 0.5),
    )  # fmt: skip
    axes.add_artist(bar)


def headline(figure: Figure, text: str, note: str) -> None:
    """Write a title above everything on the left, and below it a note on how to read the figure."""
    size = TEXT + 0.5
    # Empty lines in the title reserve the space of the note.
    room = "\n" * (note.count("\n") + 1)
    figure.suptitle(text + room, fontsize=size, x=0.01, ha="left", fontweight="bold")
    below = 1.0 - (4.0 + 1.45 * size) / 72.0 / figure.get_figheight()
    figure.text(0.01, below, note, fontsize=SMALL, color="0.25", va="top")


def plain_number(value: float) -> str:
    """A number for an axis or a cell: two digits, powers of ten only if they are shorter."""
    if value == 0:
        return "0"
    if abs(value) < 1e-3 or abs(value) >= 1e5:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def log_axis(axis: Any) -> None:
    """Label a logarithmic axis with 0.01, 0.1, 1 instead of powers of ten."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    axis.set_minor_formatter(NullFormatter())


def levels(n: int) -> Any:
    """N ordered colours from dark to light, all visible on white."""
    return colormaps["viridis"](np.linspace(0.0, 0.85, n))


def iterates_figure(estimates: Sequence[EstimateRecord]) -> Figure | None:
    """Each parameter over the iterations, in a panel each; None if no estimate has iterates.

    A single estimate has a band of two standard deviations. The dashed line is the truth.
    """
    drawn = [one for one in estimates if one.iterates]
    if not drawn:
        return None
    unknowns = drawn[0].unknowns[: len(drawn[0].iterates[0])]
    figure, (grid,) = panels(1, len(unknowns), 4.2 if drawn[1:] else 3.4)
    for k, (axes, unknown) in enumerate(zip(grid, unknowns, strict=True)):
        for n, one in enumerate(drawn):
            turn, place = divmod(n, len(COLOURS))
            style = {"color": COLOURS[place], "marker": MARKERS[place], "fillstyle": "none"}
            m = np.array([at[k] for at in one.iterates], dtype=np.float64)
            axes.plot(m, ("-", ":")[turn % 2], label=one.case or "estimate", **style)
            if not drawn[1:] and one.iterate_std:
                s = 2.0 * np.array([at[k] for at in one.iterate_std], dtype=np.float64)
                band = {"color": COLOURS[place], "alpha": 0.2, "linewidth": 0}
                axes.fill_between(np.arange(len(m)), m - s, m + s, label="± 2 SD", **band)
        if unknown.truth is not None:
            axes.axhline(unknown.truth, color=GREY, linestyle="--", label="truth")
        unit = f" ({unknown.unit})" if unknown.unit else ""
        axes.set(xlabel="iteration", ylabel=unknown.name + unit)
        axes.xaxis.get_major_locator().set_params(integer=True)
    where: Any = "outside upper center"
    handles, labels = grid[0].get_legend_handles_labels()
    across = 3 if max(map(len, labels)) <= 30 else 2
    figure.legend(handles, labels, loc=where, ncols=across, frameon=False, fontsize=SMALL)
    return figure


def save_figure_with(base: Path, figure: Figure, line: str, *, pdf: bool = False) -> list[Path]:
    """Write ``base.png``, and ``base.pdf`` for print, with a provenance line in foot and metadata.

    InputError if a file cannot be written.
    """
    _show_texts(figure)
    line = shown_text(line, LONGEST_LINE)
    foot = textwrap.fill(line, int(CHARACTERS_AN_INCH * figure.get_figwidth()))
    note = figure.supxlabel(foot, fontsize=5, color="grey", ha="center", parse_math=False)
    layout = figure.get_layout_engine()
    png = Path(f"{base}.png")
    written = [write_atomically(png, lambda file: _save_png(figure, file, line))]
    # The layout is computed once, since it takes as long as drawing.
    figure.set_layout_engine(None)
    if pdf:
        # Without a date, so that equal results give equal files.
        about = {"Subject": line, "CreationDate": None}
        path = Path(f"{base}.pdf")
        written.append(
            write_atomically(path, lambda file: figure.savefig(file, dpi=DPI, metadata=about))
        )
    note.remove()
    figure.set_layout_engine(layout)
    return written


def _save_png(figure: Figure, path: Path, line: str) -> None:
    """Write with a palette of 256 colours, which takes a third of the bytes and looks the same."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI, pil_kwargs={"compress_level": 0})
    about = PngInfo()
    about.add_text("Description", line)
    with Image.open(drawn) as image:
        # Without k-means, rare pure colours such as red are lost.
        light = image.convert("RGB").quantize(256, kmeans=2, dither=Image.Dither.NONE)
        light.save(path, "PNG", pnginfo=about, optimize=True, dpi=(DPI, DPI))


def _show_texts(figure: Figure) -> None:
    """Make all texts literal, so that matplotlib reads no mathematics in text of a record."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_text(_printed(text.get_text()))
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        if any(label.get_text() != _printed(label.get_text()) for label in axis.get_ticklabels()):
            before = axis.get_major_formatter()
            # Names at the ticks.
            axis.set_major_formatter(lambda *at, before=before: _printed(before(*at)))


def _printed(text: str) -> str:
    """Text that matplotlib prints literally, also between dollars."""
    if TICK.fullmatch(text):
        return text
    lines = text.split("\n")
    fits = len(lines) <= MAX_LINES and max(map(len, lines)) <= LONGEST_TEXT
    cut = text if fits else f"{text[:CUT_TO]}…"
    return re.sub(r"\\?\$", r"\\$", shown_text(cut).replace("\t", " "))
