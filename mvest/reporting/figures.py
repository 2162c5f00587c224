"""Figures of a run: how the estimate came about, and the valve open and closed.

Colours are those of Okabe and Ito, which people with colour-blindness can tell apart; every line is
also distinguished by its marker. Nothing touches matplotlib's global state or needs a display.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure

from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.reading.npz import read_npz
from mvest.typing import FloatArray, IntArray

__all__ = [
    "COLOURS",
    "LEAFLET_COLOURS",
    "MARKERS",
    "iterates_figure",
    "save_figure_with",
    "valve_figure",
]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito, Color Universal Design (2008)."""

LEAFLET_COLOURS = np.array([[0.45, 0.70, 0.83], [0.91, 0.65, 0.45], [0.45, 0.79, 0.70]])
"""Of leaflets in the order of their regions, ``(3, 3)``: tints of the first of `COLOURS`, in which
curves show their moduli, light enough to be shaded."""

MARKERS = ("o", "s", "^", "D", "v", "P")
DISTANCE_MAP = "viridis"
UNSEEN = (0.75, 0.75, 0.75)
DPI = 200

VIEWS = (("from the atrium", 90.0, -90.0), ("from the side", 12.0, -60.0))
"""Title, elevation and azimuth in degrees; the atrium is at positive z."""


def iterates_figure(
    title: str,
    parameters: Sequence[str],
    iterates: Sequence[Sequence[float]] | None,
    std: Sequence[Sequence[float]] | None,
    truth: Sequence[float] | None = None,
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
    m, s = np.array(iterates), np.array(std)
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    rounds = np.arange(len(m))
    for k, name in enumerate(parameters):
        colour = COLOURS[k % len(COLOURS)]
        low, high = (m[:, k] + side * 2 * s[:, k] for side in (-1, 1))
        axes.fill_between(rounds, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(rounds, m[:, k], color=colour, marker=MARKERS[k % len(MARKERS)], label=name)
        if truth is not None:
            axes.axhline(truth[k], color=colour, linestyle="--", linewidth=1)
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


def valve_figure(fields: Path) -> Figure:
    """The fitted valve open and closed, from the atrium and from the side.

    The closed valve is coloured by the distance of each vertex from where it was observed, and grey
    where it was not seen (NaN).

    Parameters
    ----------
    fields : Path
        An ``.npz`` file with ``triangles (m, 3)``, ``region (m,)``, ``fitted (f, n, 3)`` mm with
        the closed frame last, ``rest (n, 3)`` mm and ``distance (n,)`` mm.
    """
    try:
        data = read_npz(fields, ("triangles", "region", "rest", "fitted", "distance"))
        triangles, region = data["triangles"], data["region"]
        rest, closed = data["rest"].astype(float), data["fitted"][-1].astype(float)
        distance = data["distance"]
    except (LookupError, ValueError) as error:
        raise InputError(f"{fields}: no fields of a valve ({error})") from error
    figure = Figure(figsize=(8.4, 6.4), layout="constrained")
    tissue = LEAFLET_COLOURS[region % len(LEAFLET_COLOURS)]
    unit, factor = next(
        ((name, f) for name, f in (("mm", 1.0), ("µm", 1e3)) if f * np.nanmax(distance) >= 0.1),
        ("nm", 1e6),
    )
    distance = factor * distance
    norm = Normalize(0.0, max(float(np.nanmax(distance)), 1e-3))
    shown = ScalarMappable(norm, DISTANCE_MAP)
    mean = distance[triangles].mean(axis=1)
    coloured = np.where(np.isnan(mean)[:, None], UNSEEN, shown.to_rgba(mean)[:, :3])
    columns = (("open", rest, tissue), ("closed", closed, coloured))
    span = (np.minimum(rest.min(0), closed.min(0)), np.maximum(rest.max(0), closed.max(0)))
    axes = []
    for row, (view, elevation, azimuth) in enumerate(VIEWS):
        for column, (frame, points, colours) in enumerate(columns):
            panel = figure.add_subplot(2, 2, 2 * row + column + 1, projection="3d")
            _draw(panel, points, triangles, colours, span)
            panel.view_init(elevation, azimuth)
            panel.set_title(f"{frame}, {view}", fontsize=10)
            axes.append(panel)
    bar = figure.colorbar(shown, ax=[axes[1], axes[3]], shrink=0.6, pad=0.02)
    bar.set_label(f"distance, fitted to observed [{unit}]")
    return figure


def save_figure_with(base: Path, figure: Figure, line: str) -> list[Path]:
    """Write ``base.png`` and ``base.pdf`` with one line in print and in their metadata.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    note = figure.supxlabel(line, fontsize=5, color="grey", ha="center")
    # Without dates, so that the same result gives the same file.
    metadata = {".png": {"Description": line}, ".pdf": {"Subject": line, "CreationDate": None}}
    written = []
    for suffix, entries in metadata.items():
        path = base.with_name(base.name + suffix)
        written.append(
            write_atomically(
                path,
                lambda file, entries=entries: figure.savefig(file, dpi=DPI, metadata=entries),  # type: ignore[misc]
            )
        )
    note.remove()
    return written


def _draw(
    axes: Any,
    points: FloatArray,
    triangles: IntArray,
    colours: FloatArray,
    span: tuple[FloatArray, FloatArray],
) -> None:
    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = LightSource(azdeg=225, altdeg=55).direction
    # Both sides of a leaflet are seen: what faces away is lit as if it faced the light.
    shade = 0.6 + 0.4 * np.abs(normal @ light)
    # The midsurface folds over itself seen from above; its own triangles are drawn, none are made.
    faces = axes.plot_trisurf(*points.T, triangles=triangles, shade=False, antialiased=False)
    faces.set_facecolor(colours * shade[:, None])
    faces.set_edgecolor("none")
    faces.set_rasterized(True)
    low, high = span
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(high - low), zoom=1.2)
    axes.set_proj_type("ortho")
    axes.set_axis_off()
