"""What the image step leaves in a folder: figures, measures, surfaces, landmarks and the case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mvest.cases.from_images.detected import DetectedValve, called, image_step, write_detected
from mvest.errors import InputError
from mvest.imaging.valve_sequence import ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.reporting.case.tables import unit_of_measure
from mvest.reporting.figures import (
    COLOURS,
    GREY,
    MARKERS,
    SMALL,
    headline,
    panels,
    save_figure_with,
)
from mvest.reporting.images.montage import montage_figure

OVER_TIME = {
    "Annulus area": {"annulus_area_mm2": "projected", "annulus_area_3d_mm2": "in space"},
    "Annulus diameters": {
        "ap_diameter_mm": "anteroposterior",
        "commissural_diameter_mm": "commissural",
    },
    "Annulus height": {"annulus_height_mm": "height"},
    "Closed leaflets": {
        "tenting_height_mm": "tenting height",
        "billow_height_mm": "billow height",
    },
    "Orifice": {"orifice_mm2": "seen from the atrium"},
    "Coaptation": {"coaptation_length_mm": "length in the middle"},
    "Leaflet areas": {"anterior_area_mm2": "anterior", "posterior_area_mm2": "posterior"},
    "Papillary tips": {"tip_separation_mm": "between the tips", "tip_depth_mm": "mean depth"},
}
"""Title of a panel -> the measures in it, and what readers call them."""

CAPTIONS = {
    "montage": "The valve as it was detected, drawn on the volume.",
    "measures_over_time": (
        "Measures of the valve over time. Hollow: frames of low confidence. Bands: where 95 % of "
        "true values are expected, from the detectors' errors on simulated valves."
    ),
}


def write_image_step(
    detected: DetectedValve, folder: Path
) -> dict[str, tuple[Mapping[str, Any], ...]]:
    """Draw and write a detected valve; returns what its record says of the images.

    Parameters
    ----------
    detected : DetectedValve
    folder : Path
        Existing folder.

    Returns
    -------
    dict
        As `mvest.cases.from_images.detected.image_step` has it.
    """
    files = write_detected(detected, folder)
    volume, valve, closed = detected.volume, detected.valve, detected.frames.closed
    name, low = detected.case.name, detected.settings.min_confidence
    drawn = {
        "montage": montage_figure(volume, valve, title=name, closed=closed, low_confidence=low),
        "measures_over_time": measures_figure(detected.rows, title=name, low_confidence=low),
    }
    for key, figure in drawn.items():
        save_figure_with(folder / key, figure, called(volume))
    pictures = [{"file": f"{key}.png", "caption": CAPTIONS[key]} for key in drawn]
    return image_step(detected, files, pictures)


def draw_candidate(
    volume: VolumeSequence, candidate: ValveSequence, low_confidence: float, folder: Path
) -> Path:
    """Draw a candidate that was not accepted, marked as such; returns the picture."""
    folder.mkdir(parents=True, exist_ok=True)
    name, low = called(volume), low_confidence
    figure = montage_figure(volume, candidate, title=name, low_confidence=low, accepted=False)
    return save_figure_with(folder / "candidate", figure, name)[0]


def measures_figure(
    rows: Sequence[Mapping[str, Any]], *, title: str, low_confidence: float
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
    time, sure = 1e3 * table["time_s"], table["confidence"] >= low_confidence
    figure, grid = panels(4, 2, 9.6, sharex=True)
    for axes, (heading, curves) in zip(grid.flat, OVER_TIME.items(), strict=True):
        axes.set_title(heading, fontsize=SMALL + 0.5, loc="left")
        axes.set_ylabel(unit_of_measure(next(iter(curves))))
        bounds = [f"{name}_{end}" for name in curves for end in ("low", "high")]
        shown = table.reindex(columns=[*curves, *bounds]).astype(float)
        for k, (name, words) in enumerate(curves.items()):
            colour = COLOURS[k]
            axes.plot(time, shown[name], color=colour, lw=1.2, label=words)
            if f"{name}_low" in table:
                band = shown[f"{name}_low"], shown[f"{name}_high"]
                axes.fill_between(time, *band, color=colour, alpha=0.16, lw=0)
            for which, face in ((sure, colour), (~sure, "white")):
                style = {"marker": MARKERS[k], "ms": 4.2, "mec": colour, "mfc": face}
                axes.plot(time[which], shown[name][which], ls="none", **style)
        if len(curves) > 1:
            axes.legend(fontsize=SMALL - 0.5, frameon=False, handlelength=1.4)
        if shown.isna().all(axis=None):
            axes.text(
                0.5, 0.5, "not measured in any frame", transform=axes.transAxes, ha="center",
                fontsize=SMALL, color=GREY,
            )  # fmt: skip
        else:
            # Limits that neither magnify noise nor let the legend cover a curve.
            low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
            span = max(high - low, 0.1 * max(abs(high), abs(low)), 0.5)
            middle = 0.5 * (high + low)
            axes.set_ylim(middle - 0.6 * span, middle + 0.95 * span)
    for axes in grid[-1]:
        axes.set_xlabel("time [ms]")
    note = f"Hollow: confidence below {low_confidence:g} ({(~sure).sum()} of {len(sure)} frames). "
    banded = table.columns.str.endswith("_low").any()
    note += "Gaps: the shape defies the measure" + (". Bands: 95 %." if banded else ".")
    headline(figure, title, note)
    return figure
