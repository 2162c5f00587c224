"""From a volume over time to a case: the valve is detected, measured and written."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from scipy.interpolate import PchipInterpolator

from mvest.cases.case import Arrival, ValveCase
from mvest.cases.folder import write_case
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
from mvest.cases.tissue import GENERIC_THICKNESS
from mvest.errors import InputError
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
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, ValveSequence
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.quantities import BeatTime, Count, Pressure, Share, Thickness, within
from mvest.reading.text import read_numbers
from mvest.typing import FloatArray

LEAFLETS = ("anterior", "posterior")
"""Order of ``ImagedSettings.thickness_mm``."""

IMAGES, CASE = "images", "case"
"""Folders of measures, surfaces and landmarks, and of the case."""

STAND_IN_MMHG = 100.0
"""Pressure of a case without one. It passes the checks and is neither written nor estimated."""

NO_PRESSURE = (
    "No pressure is given, so no case is written; an estimate will need imaged.pressure_mmHg or "
    "imaged.pressure_curve, the transmitral pressure on the closed valve."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedSettings:
    """What a case needs that the file of a volume does not state."""

    model: str | None = None  #: file of the detection model; None: the package's, for ultrasound
    modality: Literal["ultrasound", "ct", "mr"] | None = None  #: if the file does not state it
    frame_interval_s: BeatTime | None = None  #: if the file states no times
    time_unit: str | None = None  #: s or ms, if the file states times without a unit
    open_frame: Count | None = None  #: None: the frame with the largest orifice
    closed_frame: Count | None = None  #: None: the frame whose leaflets touch most
    pressure_mmHg: Pressure | None = None  #: transmitral, in the closed frame
    pressure_curve: str | None = None  #: .csv of time,pressure (s, mmHg) instead
    thickness_mm: tuple[Thickness, ...] = ()  #: of the LEAFLETS; empty: generic
    min_confidence: Share = MIN_CONFIDENCE  #: of the best frame, and of the frames that are chosen
    #: At most, from held-out volumes; their mirror images are added.
    error_samples: Annotated[int, within(2, 250, "", "with mirror images, those of a case")] = 200
    name: str | None = None  #: None: made of the file's content, as files are named after patients
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = False  #: the volume comes from a simulation

    def __post_init__(self) -> None:
        if self.thickness_mm and len(self.thickness_mm) != len(LEAFLETS):
            raise InputError(
                f"imaged.thickness_mm = {list(self.thickness_mm)}, expected one number for each of "
                f"{', '.join(LEAFLETS)}, or none"
            )
        if self.pressure_mmHg is not None and self.pressure_curve is not None:
            raise InputError(
                "imaged.pressure_mmHg and imaged.pressure_curve are both given, expected one of "
                "them, the transmitral pressure on the closed valve"
            )

    @property
    def states_pressure(self) -> bool:
        """Whether the pressure on the closed valve is given, so that a case can be estimated."""
        return self.pressure_mmHg is not None or self.pressure_curve is not None


@dataclass(frozen=True, slots=True, eq=False)
class DetectedValve:
    """The valve that was detected in a volume, and the case made of it."""

    volume: VolumeSequence
    valve: ValveSequence
    rows: list[Row]  #: measures of every frame
    frames: CaseFrames  #: of the case
    case: ValveCase  #: with a stand-in for the pressure if none is given
    settings: ImagedSettings
    model: DetectionModel
    unlike: str  #: how the volume is unlike those of training; empty if it is not

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

        One row about volume, frames, model and the report's files, one for the measures of each
        frame, and one for ``file`` and ``caption`` of each picture.
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
    """A name made of a volume's content: files are often named after a patient."""
    return f"volume {volume.sha256[:12]}"


def read_for_case(file: Path, settings: ImagedSettings) -> VolumeSequence:
    """Read a volume of two or more frames; InputError if it cannot be read or has only one."""
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


def pressure_curve(time: FloatArray, pressure_mmhg: FloatArray) -> Callable[[float], float]:
    """Transmitral pressure (mmHg) over time (s): a monotone cubic through points ``(k,)``.

    InputError unless there are two or more times that increase. The curve itself raises InputError
    at a time outside it.
    """
    if len(time) < 2 or (np.diff(time) <= 0).any():
        raise InputError(f"pressure curve: times {time} s, expected two or more that increase")
    interpolated = PchipInterpolator(time, pressure_mmhg)

    def curve(at: float) -> float:
        if not time[0] <= at <= time[-1]:
            raise InputError(
                f"time {at:g} s lies outside the pressure curve, which runs from {time[0]:g} to "
                f"{time[-1]:g} s; give the pressure of the frame, or a curve that covers its time"
            )
        return float(interpolated(at))

    return curve


def detect_in_volume(
    file: Path | str,
    settings: ImagedSettings | None = None,
    *,
    estimate: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> DetectedValve:
    """Detect the valve in a volume over time and make a case of it.

    NoValveError if the volume shows no valve; the error holds the best candidate. MvestError if the
    volume cannot be read, or the valve in it makes no case.

    Parameters
    ----------
    estimate : bool
        Whether the case will be estimated, so that a pressure is required.
    progress : callable, optional
        Called with the number of finished frames and the number of all frames.
    """
    settings = settings or ImagedSettings()
    # Settings are checked before anything that takes long.
    pressure: Any = settings.pressure_mmHg
    if settings.pressure_curve is not None:
        points = read_numbers(Path(settings.pressure_curve), ("time", "pressure"))
        pressure = pressure_curve(*points.T)
    elif estimate and pressure is None:
        raise InputError(
            "imaged.pressure_mmHg or imaged.pressure_curve: expected one of them, the transmitral "
            "pressure on the closed valve"
        )
    volume = read_for_case(Path(file), settings)
    model, measured = _model(settings, volume.modality)
    valve = detect_valve(volume, model, min_confidence=settings.min_confidence, progress=progress)
    thickness = dict(zip(LEAFLETS, settings.thickness_mm, strict=False)) or None
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
    correction = (
        "leaflets and tips: corrected for the error that simulated volumes predict for the "
        f"detectors where they find such a valve ({off.mean():.2f} mm in the closed frame)"
    )
    unlike = ""
    if valve.confidence < accuracy.like_from:
        unlike = (
            f"the volume is unlike those that the detectors were trained on: confidence "
            f"{valve.confidence:.2f} in the median frame, expected at least "
            f"{accuracy.like_from:.2f}, below which {100 * unlike_share(len(accuracy.samples)):.2g}"
            " % of volumes like those are expected"
        )
    return DetectedValve(
        volume=volume,
        valve=valve,
        rows=with_bands(valve, rows, accuracy),
        frames=frames,
        case=replace(
            case,
            derived=(*case.derived, correction),
            arrival=Arrival("volume", model.digest),
        ),
        settings=settings,
        model=model,
        unlike=unlike,
    )


def write_detected(detected: DetectedValve, folder: Path) -> list[str]:
    """Write measures, surfaces, landmarks and, if its pressure is given, the case.

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
            "with a measured accuracy"
        )
    return model, model.accuracy
