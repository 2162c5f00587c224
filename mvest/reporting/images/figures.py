"""Figures of the detectors: their errors and their confidence in simulated volumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mvest.imaging.learning.accuracy import matern
from mvest.reporting.figures import (
    COLOURS,
    GREY,
    MARKERS,
    SEQUENTIAL,
    SMALL,
    headline,
    log_axis,
    panels,
)
from mvest.typing import FloatArray

Row = Mapping[str, Any]


def errors_figure(
    distances: Mapping[str, Sequence[float]],
    limits_mm: Sequence[float],
    stages: Sequence[Row],
    *,
    std_mm: FloatArray,
    distance_mm: FloatArray,
    correlation: FloatArray,
    length_mm: float,
) -> Figure:
    """Errors of detectors in simulated volumes that no training saw, in four panels.

    Parameters
    ----------
    distances : mapping
        Setting -> mean surface distance of each detected valve, mm.
    limits_mm : sequence of float
        Distances to be marked.
    stages : sequence of mapping
        ``setting``, ``stage``, ``unit``, and median and 90th percentile of the error: ``error``
        and ``error_90``.
    std_mm : (rows, columns) mm
        Standard deviation of a coordinate, from the annulus to the free edge.
    distance_mm, correlation : (b,)
        Correlation of errors at two vertices by their distance at rest.
    length_mm : float
        Of the Matérn correlation fitted to them.
    """
    figure, grid = panels(2, 2, 7.4)
    titles = (
        "Detected leaflets; whiskers: 5 to 95 %",
        "Error of each stage: median to 90th percentile",
        "Correlation of the errors at two vertices",
        "Standard deviation of a coordinate [mm]",
    )
    for axes, title in zip(grid.flat, titles, strict=True):
        axes.set_title(title, fontsize=SMALL, loc="left")
    _draw_distances(grid[0, 0], distances, limits_mm)
    _draw_stages(grid[0, 1], stages)
    axes = grid[1, 0]
    smooth = np.linspace(0.0, float(distance_mm.max()), 200)
    axes.plot(distance_mm, correlation, MARKERS[0], ms=4, color=COLOURS[0], label="measured")
    label = f"Matérn 3/2, {length_mm:.1f} mm"
    axes.plot(smooth, matern(smooth, length_mm), color=COLOURS[1], lw=1.3, label=label)
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.set_xlabel("distance of two vertices at rest [mm]")
    axes.legend(fontsize=SMALL, frameon=False)
    _draw_std(figure, grid[1, 1], std_mm)
    headline(
        figure,
        "Errors of the detectors in simulated volumes that no training saw",
        "Above: volumes of one frame. Below: the errors that are stated of a volume over time.",
    )
    return figure


def _draw_distances(
    axes: Any, distances: Mapping[str, Sequence[float]], limits_mm: Sequence[float]
) -> None:
    random = np.random.default_rng(0)
    axes.boxplot(
        [*distances.values()], positions=range(len(distances)), widths=0.5, whis=(5, 95),
        showfliers=False, manage_ticks=False, medianprops={"color": "black"},
    )  # fmt: skip
    for k, values in enumerate(distances.values()):
        places = k + random.uniform(-0.17, 0.17, len(values))
        axes.plot(places, values, MARKERS[k], ms=4, color=COLOURS[k], alpha=0.75, mew=0)
    for limit in limits_mm:
        axes.axhline(limit, color="0.25", lw=1.0, ls="--", zorder=0)
    axes.set_xticks(range(len(distances)), distances, fontsize=SMALL)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("distance from the true surface [mm]")


def _draw_stages(axes: Any, stages: Sequence[Row]) -> None:
    names = {row["stage"]: f"{row['stage']}\n[{row['unit']}]" for row in stages}
    for k, setting in enumerate(dict.fromkeys(row["setting"] for row in stages)):
        own = {row["stage"]: row for row in stages if row["setting"] == setting}
        places = np.arange(len(names)) + 0.2 * k - 0.1
        ends = [[own[name][end] for name in names] for end in ("error", "error_90")]
        axes.vlines(places, *ends, color=COLOURS[k], lw=1.2)
        axes.plot(places, ends[0], MARKERS[k], ms=5, color=COLOURS[k], label=setting)
    axes.set_xticks(range(len(names)), names.values(), fontsize=SMALL)
    axes.set_yscale("log")
    log_axis(axes.yaxis)
    axes.legend(fontsize=SMALL, frameon=False)


def _draw_std(figure: Figure, axes: Any, std_mm: FloatArray) -> None:
    """Over the valve's own plane: around it, and from the annulus to the free edge."""
    rows, columns = std_mm.shape
    phi = (np.arange(columns + 2) - 0.5) * 360.0 / columns
    s = np.clip((np.arange(rows + 1) - 0.5) / (rows - 1), 0.0, 1.0)
    # The last column is the first one again.
    closed = np.concatenate([std_mm, std_mm[:, :1]], axis=1)
    shown = axes.pcolormesh(phi, s, closed, cmap=SEQUENTIAL, vmin=0.0, rasterized=True)
    axes.grid(visible=False)
    axes.set(xlim=(0, 360), ylim=(1, 0))
    axes.set_xticks([90, 180, 270], ["anterior", "commissure", "posterior"])
    axes.set_yticks([0, 1], ["annulus", "free edge"])
    figure.colorbar(shown, ax=axes, pad=0.02).ax.tick_params(labelsize=SMALL)


def confidence_figure(rows: Sequence[Row], min_confidence: float, wrong_mm: float) -> Figure:
    """Confidence of detectors in every volume, by kind.

    Parameters
    ----------
    rows : sequence of mapping
        ``kind``, ``confidence``, and ``points``: the mean distance (mm) of the found points from
        the true ones, None without a valve.
    min_confidence : float
        From here on something is called a valve.
    wrong_mm : float
        Points this far off are those of something else, and are drawn hollow.
    """
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    figure, grid = panels(1, 1, 0.42 * len(kinds) + 1.6)
    axes, random, labels = grid[0, 0], np.random.default_rng(0), []
    for k, kind in enumerate(kinds):
        own = [row for row in rows if row["kind"] == kind]
        values, off = (np.array([row[of] for row in own], float) for of in ("confidence", "points"))
        places = k + random.uniform(-0.2, 0.2, len(own))
        absent = bool(np.isnan(off).all())
        for which, face in ((~(off >= wrong_mm), COLOURS[absent]), (off >= wrong_mm, "white")):
            axes.plot(
                values[which], places[which], MARKERS[absent], ms=4.2, mec=COLOURS[absent],
                mfc=face, alpha=0.8,
            )  # fmt: skip
        labels.append(f"{'no valve: ' if absent else ''}{kind} ({len(own)})")
    axes.axvline(min_confidence, color="0.25", lw=1.0, ls="--", zorder=0)
    axes.annotate(
        "called a valve from here", (min_confidence, 1.0), xytext=(3, 2),
        xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=SMALL,
        color="0.25", va="bottom",
    )  # fmt: skip
    axes.set_yticks(range(len(labels)), labels, fontsize=SMALL)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("confidence; of volumes over time (calibration, sequence) of the best frame")
    axes.grid(visible=False, axis="y")
    headline(
        figure,
        "How sure the detectors are that there is a valve",
        "Simulated volumes. Hollow: what was found is not the valve, its points are on average "
        f"{wrong_mm:g} mm off or more.",
    )
    return figure
