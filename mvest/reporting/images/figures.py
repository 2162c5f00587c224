"""Figures of the image step: measures over time, errors on held-out volumes, where it is unsure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MIN_CONFIDENCE
from mvest.reporting.style import (
    COLOURS,
    GREY,
    MARKERS,
    SEQUENTIAL,
    SMALL,
    headline,
    log_axis,
    panels,
    plain_axes,
)
from mvest.typing import FloatArray

__all__ = [
    "LIMITS_MM",
    "SETTINGS",
    "STAGES",
    "distance_figure",
    "measures_figure",
    "std_figure",
    "training_figure",
]

SETTINGS: Final = ("in distribution", "shifted")
"""Held-out simulated volumes drawn as the training ones, and with other image properties."""

LIMITS_MM: Final = (0.5, 0.8, 1.5)
"""Surface distances marked in figures and counted in tables."""

FARTHEST_MM: Final = 4.5
"""Volumes with a larger surface distance are counted at the edge of the figure."""

STAGES: Final = ("position", "pose", "landmarks", "hinge", "surface")
"""In the order in which the image step takes them; others follow."""

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
        From `mvest.cases.from_images.measure_sequence`: for each frame ``time_s``, ``confidence``
        and the measures; None leaves a gap. Of those that have bounds
        (`mvest.cases.from_images.with_bands`) the band is drawn, too.
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


def distance_figure(rows: Sequence[Row]) -> Figure:
    """Mean surface distance of every held-out volume, in distribution and shifted.

    Parameters
    ----------
    rows : sequence of mapping
        For each volume ``setting`` (see `SETTINGS`) and ``surface_mm``; None counts as a valve that
        was not found.

    Raises
    ------
    InputError
        No volumes, or another setting.
    """
    table = pd.DataFrame(list(rows))
    if table.empty or not set(table["setting"]) <= set(SETTINGS):
        found = "none" if table.empty else ", ".join(sorted(set(map(str, table["setting"]))))
        raise InputError(f"surface distances: settings {found}, expected {' or '.join(SETTINGS)}")
    figure, grid = panels(1, 1, 3.6)
    axes = grid[0, 0]
    random = np.random.default_rng(0)
    top = float(np.nanmax([*table["surface_mm"].astype(float), LIMITS_MM[-1]]))
    edge = min(1.06 * top, FARTHEST_MM)
    labels = []
    for k, setting in enumerate(SETTINGS):
        own = table.loc[table["setting"] == setting, "surface_mm"].astype(float)
        values = own.dropna().to_numpy()
        labels.append(f"{setting}\n({len(own)} volumes{_lost(len(own) - len(values))})")
        if not len(values):
            continue
        axes.boxplot(
            values, positions=[k], orientation="horizontal", widths=0.5, whis=(5, 95),
            showfliers=False, manage_ticks=False, medianprops={"color": "black", "lw": 1.6},
            boxprops={"color": GREY}, whiskerprops={"color": GREY}, capprops={"color": GREY},
        )  # fmt: skip
        places, beyond = k + random.uniform(-0.17, 0.17, len(values)), values > edge
        axes.plot(
            values[~beyond], places[~beyond], ls="none", marker=MARKERS[k], ms=4, color=COLOURS[k],
            alpha=0.75, mew=0, label=setting,
        )  # fmt: skip
        if beyond.any():
            axes.annotate(
                f"{int(beyond.sum())} beyond, up to {values.max():.1f} mm →", (edge, k + 0.36),
                ha="right", va="center", fontsize=SMALL, color=COLOURS[k],
            )  # fmt: skip
    for limit in LIMITS_MM:
        axes.axvline(limit, color="0.25", lw=1.0, ls="--", zorder=0, label="limit")
        axes.annotate(
            f"{limit:g}", (limit, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
            textcoords="offset points", ha="center", va="bottom", fontsize=SMALL, color="0.25",
        )  # fmt: skip
    axes.set_yticks(range(len(SETTINGS)), labels, fontsize=SMALL)
    axes.set_ylim(len(SETTINGS) - 0.5, -0.5)
    axes.set_xlim(0, edge)
    axes.set_xlabel("mean distance between found and true leaflets [mm]")
    axes.grid(visible=False, axis="y")
    headline(
        figure,
        "Distance of the found leaflets from the true ones",
        "Simulated volumes that no training saw. Box: quartiles and median; whiskers: 5 to 95 %.",
    )
    return figure


def _lost(count: int) -> str:
    return f", {count} without a valve found" if count else ""


def training_figure(table: pd.DataFrame) -> Figure:
    """Error of every stage of the image step against the number of training volumes.

    Parameters
    ----------
    table : DataFrame
        Columns ``stage``, ``training_volumes``, ``setting``, ``median``, ``p90`` and ``unit``.

    Raises
    ------
    InputError
        Columns are missing, or there are no rows.
    """
    wanted = ["stage", "training_volumes", "setting", "median", "p90", "unit"]
    missing = [name for name in wanted if name not in table.columns]
    if missing or table.empty:
        what = f"no columns {', '.join(missing)}" if missing else "no rows"
        raise InputError(f"errors by training volumes: {what}, expected {', '.join(wanted)}")
    found = list(dict.fromkeys(table["stage"]))
    stages = [s for s in STAGES if s in found] + [s for s in found if s not in STAGES]
    columns = min(3, len(stages))
    lines = -(-len(stages) // columns)
    figure, grid = panels(lines, columns, 2.6 * lines + 0.9)
    for axes, stage in zip(grid.flat, stages, strict=False):
        part = table[table["stage"] == stage]
        axes.set_title(stage, fontsize=SMALL + 0.5, loc="left")
        axes.set_ylabel(f"error [{part['unit'].iloc[0]}]")
        for k, setting in enumerate(SETTINGS):
            own = part[part["setting"] == setting].sort_values("training_volumes")
            for value, style, words in (("median", "-", "median"), ("p90", ":", "90 %")):
                axes.plot(
                    own["training_volumes"], own[value].astype(float), ls=style, lw=1.3,
                    color=COLOURS[k], marker=MARKERS[k], ms=4, mfc=COLOURS[k] if style == "-" else
                    "white", label=f"{setting}, {words}",
                )  # fmt: skip
        counts = sorted(set(part["training_volumes"]))
        axes.set_xscale("log")
        log_axis(axes.xaxis)
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.set_xticks([], minor=True)
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("training volumes")
    for axes in grid.flat[len(stages) :]:
        axes.set_axis_off()
    handles, labels = grid.flat[0].get_legend_handles_labels()
    if len(stages) < grid.size:
        grid.flat[-1].legend(handles, labels, fontsize=SMALL, frameon=False, loc="center")
    else:
        figure.legend(
            handles, labels, fontsize=SMALL, frameon=False, ncols=4, loc="outside lower center"
        )
    headline(
        figure,
        "Errors of the image step against the number of training volumes",
        "Simulated volumes that no training saw.",
    )
    return figure


def std_figure(layout: ValveLayout, std_mm: FloatArray) -> Figure:
    """Standard deviation of every point of the tissue over the valve's own plane (phi, s).

    Parameters
    ----------
    layout : ValveLayout
    std_mm : (n,) mm
        NaN where it was never measured.

    Raises
    ------
    InputError
        Another number of values than the layout has vertices.
    """
    values = np.asarray(std_mm, dtype=np.float64)
    if values.shape != (layout.size,):
        raise InputError(f"std_mm: shape {values.shape}, expected ({layout.size},)")
    figure = Figure(figsize=(8.3, 3.4), layout="constrained")
    axes = figure.subplots()
    plain_axes(axes)
    image = values.reshape(layout.rows, layout.columns)
    # The last column is the first one again.
    image = np.ma.masked_invalid(np.concatenate([image, image[:, :1]], axis=1))
    step, rise = 360.0 / layout.columns, 1.0 / (layout.rows - 1)
    phi = np.arange(layout.columns + 2) * step - 0.5 * step
    s = np.clip((np.arange(layout.rows + 1) - 0.5) * rise, 0.0, 1.0)
    axes.set_facecolor("0.8")
    axes.grid(visible=False)
    shown = axes.pcolormesh(phi, s, image, cmap=SEQUENTIAL, vmin=0.0, rasterized=True)
    axes.set_xlim(0, 360)
    axes.set_ylim(1, 0)
    axes.set_xticks(
        [0, 90, 180, 270, 360],
        ["0°\ncommissure", f"90°\nmiddle of the\n{layout.region_names[0]} leaflet",
         "180°\ncommissure", f"270°\nmiddle of the\n{layout.region_names[1]} leaflet",
         "360°\ncommissure"],
    )  # fmt: skip
    axes.set_yticks([0, 0.5, 1], ["annulus", "half way", "free edge"])
    axes.axvline(180, color="white", lw=0.8, ls="--")
    figure.colorbar(shown, ax=axes, pad=0.01).set_label("standard deviation [mm]", size=SMALL)
    known = values[np.isfinite(values)]
    note = "Of each coordinate of a point"
    if len(known):
        note += f"; median {np.median(known):.2f} mm, largest {known.max():.2f} mm"
    unknown = len(values) - len(known)
    note += f"; grey: never measured ({unknown} points)." if unknown else "."
    headline(figure, "Where the image step is sure of the leaflets", note)
    return figure
