"""A volume over time to a case: the valve is detected, measured, and written for other software."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mvest.cases.case import ValveCase
from mvest.cases.folder import pressure_curve, write_case
from mvest.cases.from_images.build import CaseFrames, case_of_sequence, choose_frames
from mvest.cases.from_images.detector_errors import (
    samples_in_world,
    with_bands,
    without_expected_error,
)
from mvest.cases.from_images.measures import (
    Row,
    measure_sequence,
    write_landmarks,
    write_measures,
    write_surfaces,
)
from mvest.cases.from_images.settings import LEAFLETS, ImagedSettings
from mvest.cases.tissue import GENERIC_THICKNESS
from mvest.errors import InputError
from mvest.exchange.markups import read_markups
from mvest.exchange.volumes import read_volume
from mvest.imaging.detection.tracking import detect_valve
from mvest.imaging.detection.trained_model import (
    DetectionAccuracy,
    DetectionModel,
    default_model,
    load_model,
)
from mvest.imaging.learning.accuracy import unlike_share
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.valve_sequence import ANNULUS_LABELS, LANDMARKS, ValveSequence
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.reading.text import read_numbers
from mvest.typing import FloatArray

IMAGES, CASE = "images", "case"
"""Folders of measures, surfaces and landmarks, and of the case."""

STAND_IN_MMHG = 100.0
"""Pressure of a case without one: it is checked, and neither written nor estimated."""

NO_PRESSURE = (
    "No pressure is given, so no case is written; an estimate will need imaged.pressure_mmHg or "
    "imaged.pressure_curve, the transmitral pressure on the closed valve."
)


@dataclass(frozen=True, slots=True, eq=False)
class DetectedValve:
    """The valve that was detected in a volume, and the case that it makes.

    Attributes
    ----------
    volume : VolumeSequence
    valve : ValveSequence
    rows : list of dict
        Measures of every frame.
    frames : CaseFrames
        Those that the case is made of.
    case : ValveCase
        With a stand-in for the pressure if none is stated.
    settings : ImagedSettings
    model : DetectionModel
    unlike : str
        How the volume is unlike those of training; empty if it is not.
    """

    volume: VolumeSequence
    valve: ValveSequence
    rows: list[Row]
    frames: CaseFrames
    case: ValveCase
    settings: ImagedSettings
    model: DetectionModel
    unlike: str

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found and derived, for a reader."""
        volume, case, frames = self.volume, self.case, self.frames
        size = " x ".join(map(str, volume.frames.shape[1:]))
        confidence = self.valve.frame_confidence
        uncertainty = case.uncertainty
        return (
            f"{called(volume)}: {len(volume.times)} frames of {size} voxels, "
            f"{volume.modality.value}.",
            f"Valve detected with a confidence of {confidence.min():.2f} to "
            f"{confidence.max():.2f} (open frame {frames.open}: {confidence[frames.open]:.2f}, "
            f"closed frame {frames.closed}: {confidence[frames.closed]:.2f}).",
            "The detectors were trained and tested on simulated volumes only; their error there is "
            f"{uncertainty.typical_mm:.2f} mm in each coordinate, correlated over "
            f"{uncertainty.correlation_length_mm:.0f} mm.",
            *([f"{self.unlike[0].upper()}{self.unlike[1:]}."] if self.unlike else []),
            *(f"Derived: {sentence}." for sentence in case.derived),
            *(() if self.settings.states_pressure else (NO_PRESSURE,)),
        )

    def details(
        self, files: Sequence[str], pictures: Sequence[Mapping[str, Any]]
    ) -> dict[str, tuple[Mapping[str, Any], ...]]:
        """Details for a record (`mvest.personalisation.record`).

        ``image_step`` has one row about volume, frames, model and files beside the report,
        ``image_frames`` the measures of each frame, ``pictures`` the ``file`` and ``caption`` of
        each.
        """
        volume, frames = self.volume, self.frames
        about = {
            "volume": called(volume),
            "sha256": volume.sha256,
            "modality": volume.modality.value,
            "shape": list(volume.frames.shape),
            "spacing_mm": volume.spacing.tolist(),
            "open_frame": frames.open,
            "closed_frame": frames.closed,
            "confidence": self.valve.frame_confidence.tolist(),
            "unlike": self.unlike,
            "model_sha256": self.model.sha256,
            "trained_on": dict(self.model.trained_on),
            "sentences": list(self.sentences),
            "files": list(files),
        }
        rows = tuple(dict(row) for row in self.rows)
        return {"image_step": (about,), "image_frames": rows, "pictures": tuple(pictures)}


def called(volume: VolumeSequence) -> str:
    """A volume named by its content: files are often named after a patient."""
    return f"volume {volume.sha256[:12]}"


def read_for_case(file: Path, settings: ImagedSettings) -> VolumeSequence:
    """The volume in a file, which shows the valve open and closed.

    Raises
    ------
    InputError
        It cannot be read or has one frame only.
    """
    volume = read_volume(
        file,
        modality=None if settings.modality is None else Modality(settings.modality),
        frame_interval_s=settings.frame_interval_s,
        time_unit=settings.time_unit,
    )
    if len(volume.times) < 2:
        raise InputError(
            f"{volume.source}: one frame, expected two or more: the valve open and closed"
        )
    return volume


def detect_in_volume(
    file: Path | str,
    settings: ImagedSettings | None = None,
    *,
    estimate: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> DetectedValve:
    """The valve in a volume over time, and the case that it makes.

    Parameters
    ----------
    file : Path
    settings : ImagedSettings, optional
    estimate : bool
        Whether the case is to be estimated, so that a pressure must be given.
    progress : callable, optional
        (frames done, all frames) -> None.

    Raises
    ------
    NoValveError
        The volume shows no valve; the error has the best candidate that was not accepted.
    MvestError
        The volume cannot be read, or the valve in it makes no case.
    """
    settings = settings or ImagedSettings()
    # Settings are checked before anything that takes long.
    landmarks, unplaced = _landmarks(settings)
    pressure: Any = settings.pressure_mmHg
    if settings.pressure_curve is not None:
        table = read_numbers(Path(settings.pressure_curve), ("time", "pressure"))
        pressure = pressure_curve(*table.T)
    elif estimate and pressure is None:
        raise InputError(
            "imaged.pressure_mmHg or imaged.pressure_curve: expected one of them, the transmitral "
            "pressure on the closed valve"
        )
    volume = read_for_case(Path(file), settings)
    model, measured = _model(settings, volume.modality)
    valve = detect_valve(
        volume,
        model,
        min_confidence=settings.min_confidence,
        landmarks=landmarks or None,
        progress=progress,
    )
    thickness = settings.thickness
    rows = measure_sequence(valve, float(np.mean(list((thickness or GENERIC_THICKNESS).values()))))
    frames = choose_frames(
        valve,
        rows,
        STAND_IN_MMHG if pressure is None else pressure,
        open_=settings.open_frame,
        closed=settings.closed_frame,
        min_confidence=settings.min_confidence,
    )
    accuracy = measured.at(valve.confidence)
    corrected, errors = without_expected_error(valve, frames, measured)
    # Samples that are evenly spread over the errors.
    spread = np.linspace(0, len(errors) - 1, settings.error_samples)
    chosen = np.unique(spread.round().astype(np.int64))
    case = case_of_sequence(
        corrected,
        frames,
        {
            "name": settings.name or called(volume),
            "description": settings.description,
            "source": settings.source or called(volume),
            "licence": settings.licence,
            "simulated": settings.simulated,
        },
        thickness_mm=thickness,
        error_samples=samples_in_world(corrected, frames, errors[chosen]),
    )
    off = np.linalg.norm(corrected.vertices[frames.closed] - valve.vertices[frames.closed], axis=1)
    less = (
        "leaflets and tips: less the error that is expected of the detectors where they find such "
        f"a valve, by simulated volumes ({off.mean():.2f} mm in the closed frame)"
    )
    return DetectedValve(
        volume=volume,
        valve=valve,
        rows=with_bands(valve, rows, accuracy),
        frames=frames,
        case=replace(case, derived=(*case.derived, less, *unplaced)),
        settings=settings,
        model=model,
        unlike=_unlike(valve.confidence, accuracy),
    )


def write_detected(detected: DetectedValve, folder: Path) -> list[str]:
    """Write measures, surfaces, landmarks and, if its pressure is stated, the case.

    The folders ``images`` and ``case`` within the given one are emptied before. Returns the main
    files, relative to it.
    """
    images, case = folder / IMAGES, folder / CASE
    for place in (images, case):
        shutil.rmtree(place, ignore_errors=True)
    images.mkdir(parents=True)
    write_measures(images, detected.rows)
    write_surfaces(images, detected.valve)
    for frame in (detected.frames.open, detected.frames.closed):
        write_landmarks(images / f"valve_{frame:04d}.mrk.json", detected.valve, frame)
    files = [f"{IMAGES}/measures.csv", f"{IMAGES}/valve.pvd"]
    if not detected.settings.states_pressure:
        return files
    write_case(case, detected.case)
    return [*files, f"{CASE}/case.yaml"]


def _model(
    settings: ImagedSettings, modality: Modality
) -> tuple[DetectionModel, DetectionAccuracy]:
    """The detection model for a modality, whose accuracy was measured."""
    if settings.model is None and modality is not Modality.ULTRASOUND:
        raise InputError(
            f"imaged.model is not given; for {modality.value} no model comes with the package: "
            "expected a detection model's file"
        )
    model = default_model() if settings.model is None else load_model(Path(settings.model))
    if model.accuracy is None:
        raise InputError(
            f"{settings.model or MODEL_FILE}: its accuracy was never measured, expected a model "
            "whose was"
        )
    found = model.shape.layout.region_names
    if settings.thickness is not None and set(found) != set(LEAFLETS):
        raise InputError(
            f"imaged.thickness_mm is of {', '.join(LEAFLETS)}; the model finds the leaflets "
            f"{', '.join(found)}"
        )
    return model, model.accuracy


def _unlike(confidence: float, accuracy: DetectionAccuracy) -> str:
    """How a volume is unlike those of training; empty if it is not."""
    if confidence >= accuracy.like_from:
        return ""
    share = unlike_share(len(accuracy.samples))
    return (
        f"the volume is unlike those that the detectors were trained on: confidence "
        f"{confidence:.2f} in the median frame, expected at least {accuracy.like_from:.2f}, below "
        f"which {100 * share:.2g} % of volumes like those are expected"
    )


def _landmarks(settings: ImagedSettings) -> tuple[dict[int, dict[str, FloatArray]], list[str]]:
    """Frame -> name -> position (mm) of the files in the settings; sentences on unplaced ones."""
    landmarks: dict[int, dict[str, FloatArray]] = {}
    unplaced = []
    for frame, file in settings.landmarks:
        lists = read_markups(Path(file))
        mine = [
            item
            for name, item in lists.items()
            if item.kind == "Fiducial" and name != ANNULUS_LABELS
        ]
        points = dict(pair for item in mine for pair in zip(item.labels, item.points, strict=True))
        strange = sorted(set(points) - set(LANDMARKS))
        if strange or not points or len(points) < sum(len(item.labels) for item in mine):
            raise InputError(
                f"{file}: points {', '.join(strange) or 'none'}, expected some of "
                f"{', '.join(LANDMARKS)}, each once (lists {', '.join(lists)})"
            )
        landmarks[frame] = points
        missing = [label for item in mine for label in item.unplaced]
        if missing:
            unplaced.append(f"landmarks of frame {frame}: {', '.join(missing)} not placed")
    return landmarks, unplaced
