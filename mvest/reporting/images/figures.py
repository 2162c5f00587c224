"""Figures of the image step: measures over time, errors and confidence of the detectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mvest.errors import InputError
from mvest.imaging.learning.accuracy import matern
from mvest.imaging.valve_sequence import MIN_CONFIDENCE
from mvest.reporting.figures import COLOURS, MARKERS
from mvest.reporting.style import GREY, SEQUENTIAL, SMALL, headline, log_axis, panels, plain_axes
from mvest.typing import FloatArray

Row = Mapping[str, Any]


class _Panel(NamedTuple):
    title: str
    unit: str
    curves: tuple[tuple[str, str], ...]


_OVER_TIME = (
    _Panel(
        "Annulus area",
        "mm²",
        (("annulus_area_mm2", "projected"), ("annulus_area_3d_mm2", "in space")),
    ),
    _Panel(
        "Annulus diameters",
        "mm",
        (("ap_diameter_mm", "anteroposterior"), ("commissural_diameter_mm", "commissural")),
    ),
    _Panel("Annulus height", "mm", (("annulus_height_mm", "height"),)),
    _Panel(
        "Closed leaflets",
        "mm",
        (("tenting_height_mm", "tenting height"), ("billow_height_mm", "billow height")),
    ),
    _Panel("Orifice", "mm²", (("orifice_mm2", "seen from the atrium"),)),
    _Panel("Coaptation", "mm", (("coaptation_length_mm", "length in the middle"),)),
    _Panel(
        "Leaflet areas",
        "mm²",
        (("anterior_area_mm2", "anterior"), ("posterior_area_mm2", "posterior")),
    ),
    _Panel(
        "Papillary tips",
        "mm",
        (("tip_separation_mm", "between the tips"), ("tip_depth_mm", "mean depth")),
    ),
)


def measures_figure(
    rows: Sequence[Row], *, title: str, low_confidence: float = MIN_CONFIDENCE
) -> Figure:
    """Measures of a valve over time.

    Parameters
    ----------
    rows : sequence of mapping
        From `mvest.cases.from_images.measures.measure_sequence`: for each frame ``time_s``,
        ``confidence`` and the measures; None leaves a gap. Of those that have bounds
        (`mvest.cases.from_images.detector_errors.with_bands`) the band is drawn, too.
    title : str
    low_confidence : float
        Frames below this are drawn hollow.

    Raises
    ------
    InputError
        No frames.
    """
    if not rows:
        raise InputError(f"measures of {title}: no frames, expected at least one")
    table = pd.DataFrame(list(rows))
    time = 1e3 * table["time_s"].to_numpy(float)
    sure = table["confidence"].to_numpy(float) >= low_confidence
    figure, grid = panels(4, 2, 9.6, sharex=True)
    for axes, panel in zip(grid.flat, _OVER_TIME, strict=True):
        axes.set_title(panel.title, fontsize=SMALL + 0.5, loc="left")
        axes.set_ylabel(panel.unit)
        for k, (name, words) in enumerate(panel.curves):
            values = table[name].to_numpy(float)
            colour, marker = COLOURS[k], MARKERS[k]
            axes.plot(time, values, color=colour, lw=1.2, label=words)
            if f"{name}_low" in table:
                band = [table[f"{name}_{end}"].to_numpy(float) for end in ("low", "high")]
                axes.fill_between(time, *band, color=colour, alpha=0.16, lw=0)
            for which, face in ((sure, colour), (~sure, "white")):
                axes.plot(
                    time[which], values[which], ls="none", marker=marker, ms=4.2, mec=colour,
                    mfc=face,
                )  # fmt: skip
        if len(panel.curves) > 1:
            axes.legend(fontsize=SMALL - 0.5, frameon=False, handlelength=1.4)
        drawn = [name for name, _ in panel.curves]
        bounds = [f"{name}_{end}" for name in drawn for end in ("low", "high")]
        shown = table[[*drawn, *(name for name in bounds if name in table)]].to_numpy(float)
        if not np.isfinite(shown).any():
            axes.text(
                0.5, 0.5, "not measured in any frame", transform=axes.transAxes, ha="center",
                fontsize=SMALL, color=GREY,
            )  # fmt: skip
        else:
            _leave_room(axes, shown[np.isfinite(shown)])
    for axes in grid[-1]:
        axes.set_xlabel("time [ms]")
    low = int((~sure).sum())
    note = f"Hollow: confidence below {low_confidence:g} ({low} of {len(sure)} frames). "
    banded = table.columns.str.endswith("_low").any()
    note += "Gaps: the shape defies the measure" + (". Bands: 95 %." if banded else ".")
    headline(figure, title, note)
    return figure


def _leave_room(axes: Any, values: FloatArray) -> None:
    """Limits that neither magnify noise nor let the legend cover a curve."""
    low, high = float(values.min()), float(values.max())
    span = max(high - low, 0.1 * max(abs(high), abs(low)), 0.5)
    middle = 0.5 * (high + low)
    axes.set_ylim(middle - 0.6 * span, middle + 0.95 * span)


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
    figure = Figure(figsize=(8.3, 7.4), layout="constrained")
    panels = figure.subplot_mosaic([["distance", "stages"], ["correlation", "std"]])
    for axes in panels.values():
        plain_axes(axes)
    _draw_distances(panels["distance"], distances, limits_mm)
    _draw_stages(panels["stages"], stages)
    axes = panels["correlation"]
    smooth = np.linspace(0.0, float(distance_mm.max()), 200)
    axes.plot(distance_mm, correlation, MARKERS[0], ms=4, color=COLOURS[0], label="measured")
    label = f"Matérn 3/2, {length_mm:.1f} mm"
    axes.plot(smooth, matern(smooth, length_mm), color=COLOURS[1], lw=1.3, label=label)
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.set_xlabel("distance of two vertices at rest [mm]")
    axes.set_title("Correlation of the errors at two vertices", fontsize=SMALL, loc="left")
    axes.legend(fontsize=SMALL, frameon=False)
    _draw_std(figure, panels["std"], std_mm)
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
    for k, values in enumerate(map(np.array, distances.values())):
        axes.boxplot(
            values, positions=[k], widths=0.5, whis=(5, 95), showfliers=False, manage_ticks=False,
            medianprops={"color": "black"},
        )  # fmt: skip
        places = k + random.uniform(-0.17, 0.17, len(values))
        axes.plot(places, values, MARKERS[k], ms=4, color=COLOURS[k], alpha=0.75, mew=0)
    for limit in limits_mm:
        axes.axhline(limit, color="0.25", lw=1.0, ls="--", zorder=0)
    axes.set_xticks(range(len(distances)), distances, fontsize=SMALL)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("distance from the true surface [mm]")
    axes.set_title("Detected leaflets; whiskers: 5 to 95 %", fontsize=SMALL, loc="left")


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
    axes.set_title("Error of each stage: median to 90th percentile", fontsize=SMALL, loc="left")


def _draw_std(figure: Figure, axes: Any, std_mm: FloatArray) -> None:
    """Over the valve's own plane: around it, and from the annulus to the free edge."""
    rows, columns = std_mm.shape
    phi = (np.arange(columns + 2) - 0.5) * 360.0 / columns
    s = np.clip((np.arange(rows + 1) - 0.5) / (rows - 1), 0.0, 1.0)
    # The last column is the first one again.
    closed = np.concatenate([std_mm, std_mm[:, :1]], axis=1)
    shown = axes.pcolormesh(phi, s, closed, cmap=SEQUENTIAL, vmin=0.0, rasterized=True)
    axes.grid(visible=False)
    axes.set_xlim(0, 360)
    axes.set_ylim(1, 0)
    axes.set_xticks([90, 180, 270], ["anterior", "commissure", "posterior"])
    axes.set_yticks([0, 1], ["annulus", "free edge"])
    axes.set_title("Standard deviation of a coordinate [mm]", fontsize=SMALL, loc="left")
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
        values = np.array([row["confidence"] for row in own])
        places = k + random.uniform(-0.2, 0.2, len(own))
        absent = all(row["points"] is None for row in own)
        wrong = np.array([row["points"] is not None and row["points"] >= wrong_mm for row in own])
        for which, face in ((~wrong, COLOURS[absent]), (wrong, "white")):
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
