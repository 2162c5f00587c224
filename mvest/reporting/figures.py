"""Figures of a run: how the estimate came about, and what all figures have in common.

Colours are those of Okabe and Ito, which people with colour-blindness can tell apart; every line is
also distinguished by its marker. Nothing touches matplotlib's global state or needs a display.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.reporting.markup import shown_text
from mvest.typing import FloatArray

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito, Color Universal Design (2008)."""

LEAFLET_COLOURS = np.array([[0.45, 0.70, 0.83], [0.91, 0.65, 0.45], [0.45, 0.79, 0.70]])
"""Of leaflets in the order of their regions, ``(3, 3)``: tints of the first of `COLOURS`, in which
curves show their moduli, light enough to be shaded."""

MARKERS = ("o", "s", "^", "D", "v", "P")
DISTANCE_MAP = "viridis"
DPI = 140
CHARACTERS_AN_INCH = 23
"""Of the line at the foot."""

LONGEST_TEXT, LONGEST_LINE = 160, 400
"""Characters of a line of a text in a figure, and of the line at its foot."""
MAX_LINES = 6
"""Of a text in a figure."""
KEPT = 20
"""Characters of a longer one that are shown, so that something is left of the figure."""
TICK = re.compile(r"\$\\mathdefault\{[−-]?[\d.]*(?:\\times)?[\d.]*(?:\^\{[−-]?[\d.]+\})?\}\$")
"""What matplotlib writes at a logarithmic axis."""


@dataclass(frozen=True, slots=True)
class View:
    """A direction to look from: elevation over the annulus plane and azimuth, degrees."""

    name: str
    elevation: float
    azimuth: float

    @property
    def axes(self) -> FloatArray:
        """``(3, 3)`` columns: to the right, up, and towards the eye."""
        e, a = np.deg2rad(self.elevation), np.deg2rad(self.azimuth)
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(eye, right), eye], axis=1)


ATRIUM = View("from the atrium", 90.0, -90.0)
SIDE = View("from the side", 12.0, -60.0)
VIEWS = (ATRIUM, SIDE)
"""The atrium is at positive z."""


def iterates_figure(
    title: str,
    parameters: Sequence[str],
    iterates: Sequence[Sequence[float | None]],
    std: Sequence[Sequence[float | None]],
    truth: Sequence[float | None] | None = None,
) -> Figure:
    """Each parameter against the iteration, with its band of two standard deviations and the truth.

    Parameters
    ----------
    title : str
    parameters : sequence of str, (p,)
    iterates, std : (i, p)
        At least one.
    truth : (p,), optional

    Raises
    ------
    InputError
        If there is no iterate.
    """
    if not iterates:
        raise InputError(f"{title}: a run without iterates has nothing to draw")
    m, s = (np.array(values, dtype=np.float64) for values in (iterates, std))
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    rounds = np.arange(len(m))
    for k, name in enumerate(parameters):
        colour = COLOURS[k % len(COLOURS)]
        low, high = (m[:, k] + side * 2 * s[:, k] for side in (-1, 1))
        axes.fill_between(rounds, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(rounds, m[:, k], color=colour, marker=MARKERS[k % len(MARKERS)], label=name)
        known = None if truth is None else truth[k]
        if known is not None:
            axes.axhline(known, color=colour, linestyle="--", linewidth=1)
    axes.set_xlabel("iteration")
    units = {"MPa" for name in parameters if name.startswith("E_f.")}
    axes.set_ylabel(f"modulus [{units.pop()}]" if units else "parameter")
    axes.set_xticks(rounds if len(rounds) <= 12 else rounds[:: len(rounds) // 8])
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.plot([], [], color="grey", linestyle="--", linewidth=1, label="truth")
    axes.fill_between([], [], color="grey", alpha=0.2, linewidth=0, label="± 2 SD")
    axes.legend(frameon=False, fontsize=8)
    axes.set_title(title, fontsize=10)
    return figure


def save_figure_with(base: Path, figure: Figure, line: str, *, pdf: bool = False) -> list[Path]:
    """Write ``base.png``, and ``base.pdf`` for print, with one line in it and in its metadata.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    _show_texts(figure)
    line = shown_text(line, LONGEST_LINE)
    foot = textwrap.fill(line, int(CHARACTERS_AN_INCH * figure.get_figwidth()))
    note = figure.supxlabel(foot, fontsize=5, color="grey", ha="center", parse_math=False)
    written, layout = [], figure.get_layout_engine()
    written.append(
        write_atomically(Path(f"{base}.png"), lambda file: _save_png(figure, file, line))
    )
    # What is laid out need not be once more, which takes as long as drawing it.
    figure.set_layout_engine(None)
    if pdf:
        # Without a date, so that the same result gives the same file.
        about = {"Subject": line, "CreationDate": None}
        written.append(
            write_atomically(
                Path(f"{base}.pdf"),
                lambda file: figure.savefig(file, dpi=DPI, metadata=about),
            )
        )
    note.remove()
    figure.set_layout_engine(layout)
    return written


def _save_png(figure: Figure, path: Path, line: str) -> None:
    """Write a palette of 256 colours: a third of the bytes, the same to the eye."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI, pil_kwargs={"compress_level": 0})
    about = PngInfo()
    about.add_text("Description", line)
    with Image.open(drawn) as image:
        # Without the means, a palette of few pure colours loses the red ones.
        light = image.convert("RGB").quantize(256, kmeans=2, dither=Image.Dither.NONE)
        light.save(path, "PNG", pnginfo=about, optimize=True, dpi=(DPI, DPI))


def _show_texts(figure: Figure) -> None:
    """Have texts of a record printed as they stand, whatever matplotlib would read in them."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_text(_printed(text.get_text()))
    names = ("xaxis", "yaxis", "zaxis")
    for axis in [getattr(a, name) for a in figure.axes for name in names if hasattr(a, name)]:
        if any(label.get_text() != _printed(label.get_text()) for label in axis.get_ticklabels()):
            before = axis.get_major_formatter()
            # Where names stand at the ticks.
            axis.set_major_formatter(lambda *at, before=before: _printed(before(*at)))


def _printed(text: str) -> str:
    """Text that matplotlib prints as it stands: what is between dollars is mathematics to it."""
    if TICK.fullmatch(text):
        return text
    lines = text.split("\n")
    fits = len(lines) <= MAX_LINES and max(map(len, lines)) <= LONGEST_TEXT
    cut = text if fits else f"{text[:KEPT]}…"
    return re.sub(r"\\?\$", r"\\$", shown_text(cut).replace("\t", " "))
