"""What the image step leaves in a folder: figures, measures, surfaces, landmarks and the case."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvest.cases.from_images.detected import DetectedValve, called, image_step, write_detected
from mvest.imaging.valve_sequence import ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.reporting.figures import save_figure_with
from mvest.reporting.images.figures import measures_figure
from mvest.reporting.images.montage import montage_figure

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
    name, low = detected.case.name, detected.settings.min_confidence
    drawn = {
        "montage": montage_figure(
            detected.volume,
            detected.valve,
            title=name,
            closed=detected.frames.closed,
            low_confidence=low,
        ),
        "measures_over_time": measures_figure(detected.rows, title=name, low_confidence=low),
    }
    for key, figure in drawn.items():
        save_figure_with(folder / key, figure, called(detected.volume))
    pictures = [{"file": f"{key}.png", "caption": CAPTIONS[key]} for key in drawn]
    return image_step(detected, files, pictures)


def draw_candidate(
    volume: VolumeSequence, candidate: ValveSequence, low_confidence: float, folder: Path
) -> Path:
    """Draw a candidate that was not accepted, marked as such; returns the picture."""
    folder.mkdir(parents=True, exist_ok=True)
    name = called(volume)
    figure = montage_figure(
        volume, candidate, title=name, low_confidence=low_confidence, accepted=False
    )
    return save_figure_with(folder / "candidate", figure, name)[0]
