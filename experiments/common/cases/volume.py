"""A volume over time to its moduli: the valve detected, measured, made a case, personalised."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.cases.findings import Findings
from experiments.common.cases.own_case import run_case
from experiments.common.cases.settings import ImagedSettings, PersonalSettings
from experiments.common.progress import PartBar
from experiments.common.records.record import Outcome
from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.cases.from_images.build import CaseTexts, case_of_sequence
from mvest.cases.from_images.errors_in_world import samples_in_world, without_expected_error
from mvest.cases.from_images.files import write_for_slicer, write_surfaces
from mvest.cases.from_images.frame_choice import CaseFrames, choose_frames
from mvest.cases.from_images.measure_bands import with_bands
from mvest.cases.from_images.measures import Row, closed_frame, measure_sequence, write_measures
from mvest.cases.pressure_curve import PressureCurve
from mvest.cases.tissue import GENERIC_THICKNESS
from mvest.cases.writer import write_case
from mvest.errors import ConfigurationError, InputError
from mvest.imaging.detection.tracking import NoValveError, TrackingSettings, detect_valve
from mvest.imaging.detection.trained_model import DetectionAccuracy, default_model, load_model
from mvest.imaging.landmarks import ANNULUS_LABELS, LANDMARKS
from mvest.imaging.learning.accuracy import unlike_share
from mvest.imaging.markups import read_markups
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.reading.reader import read_volume
from mvest.imaging.valve_sequence import ValveSequence
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.reading.table import read_numbers
from mvest.reporting.case.findings import ImageStep, Picture, VolumeAbout
from mvest.typing import FloatArray, IntArray

__all__ = ["DetectedValve", "detect_in_volume", "run_volume", "write_image_step"]

Values = Mapping[str, Any]

IMAGES, CASE = "images", "case"
"""Folders of what the image step writes, and of the case."""

STAND_IN_MMHG = 100.0
"""Of a case without a pressure, which is checked and neither written nor estimated."""

NO_PRESSURE = (
    "No pressure is given, so no case is written; an estimate will need imaged.pressure_mmHg or "
    "imaged.pressure_curve, the transmitral pressure on the closed valve."
)


@dataclass(frozen=True, slots=True, eq=False)
class DetectedValve:
    """The valve that the image step detected in a volume, with the measures of every frame.

    Of the detection model there is what is known of it, as plain data. Where no pressure is stated
    the case has a stand-in for it, and is there to be checked only. ``unlike`` says how the volume
    is unlike those of training, and is empty where it is not.
    """

    volume: VolumeSequence
    valve: ValveSequence
    rows: list[Row]
    frames: CaseFrames
    case: ValveCase
    model: dict[str, Any]
    pressure_stated: bool
    min_confidence: float
    unlike: str


def run_volume(
    values: Values,
    file: str | None,
    settings: ImagedSettings,
    personal: PersonalSettings,
    folder: Path,
) -> Outcome[Findings]:
    """Find the valve in the configured volume and personalise it."""
    step = write_image_step(detect_in_volume(file, settings, folder), folder)
    for sentence in step.sentences:
        print(sentence, file=sys.stderr)
    return run_case(values, personal, read_case(folder / CASE), folder, step)


def detect_in_volume(
    file: str | None, settings: ImagedSettings, folder: Path, *, estimate: bool = True
) -> DetectedValve:
    """The valve in the configured volume, and the case that it makes.

    Where no valve is accepted, the best candidate is drawn in the folder.

    Parameters
    ----------
    file, settings
    folder : Path
    estimate : bool
        Is the case to be estimated, so that a pressure must be given?

    Raises
    ------
    MvestError
        If the volume cannot be read, shows no valve, or the valve in it makes no case.
    """
    if file is None:
        raise ConfigurationError("volume is not given; expected volume=FILE, a volume over time")
    # What is asked for, before anything that takes long.
    by_hand = _landmarks(_pairs("landmarks", settings.landmarks, str))
    held = _pairs("held_out", settings.held_out, float)
    curve = _pressure_curve(settings, needed=estimate)
    thickness = _thickness(settings.thickness_mm)
    volume = read_volume(
        Path(file),
        modality=_modality(settings.modality),
        frame_interval_s=settings.frame_interval_s,
        time_unit=settings.time_unit,
    )
    if len(volume.times) < 2:
        raise InputError(
            f"{volume.source}: one frame, expected two or more: the valve open and closed"
        )
    if settings.model is None and volume.modality is not Modality.ULTRASOUND:
        raise ConfigurationError(
            f"imaged.model is not given; for {volume.modality.value} no model comes with the "
            "package: expected a detection model's file"
        )
    model = default_model() if settings.model is None else load_model(Path(settings.model))
    if model.accuracy is None:
        raise InputError(
            f"{settings.model or MODEL_FILE}: its accuracy was never measured, expected a model "
            "whose was"
        )
    if thickness is not None and set(thickness) != set(model.shape.layout.region_names):
        raise ConfigurationError(
            f"imaged.thickness_mm is of {', '.join(thickness)}; the model finds the leaflets "
            f"{', '.join(model.shape.layout.region_names)}"
        )
    tracking = TrackingSettings(min_confidence=settings.min_confidence)
    with PartBar("valve in the frames", len(volume.times), "frame") as bar:
        try:
            valve = detect_valve(
                volume,
                model,
                tracking,
                landmarks=by_hand,
                progress=lambda _done, _all: bar.step(),
            )
        except NoValveError as nothing:
            if nothing.candidate is None:
                raise
            drawn = _draw_candidate(volume, nothing.candidate, settings.min_confidence, folder)
            raise NoValveError(
                f"{nothing}; the best candidate, not accepted, is drawn in {drawn}",
                nothing.candidate,
            ) from nothing
    rows = measure_sequence(valve, float(np.mean(list((thickness or GENERIC_THICKNESS).values()))))
    frames = _frames(settings, curve, held, valve, rows)
    texts = CaseTexts(
        settings.name or _called(volume),
        settings.description,
        settings.source or _called(volume),
        settings.licence,
        settings.simulated,
    )
    accuracy = model.accuracy.at(valve.confidence)
    rows = with_bands(valve, rows, accuracy.samples, accuracy.tip_samples)
    corrected, errors, tip_errors = without_expected_error(valve, frames, model.accuracy)
    kept = _thinned(len(errors), settings.error_samples)
    case = case_of_sequence(
        corrected,
        frames,
        texts,
        thickness_mm=thickness,
        error_samples=samples_in_world(corrected, frames, errors[kept], tip_errors[kept]),
    )
    off = np.linalg.norm(corrected.vertices[frames.closed] - valve.vertices[frames.closed], axis=1)
    case = replace(
        case,
        derived=(
            *case.derived,
            "leaflets and tips: less the error that is expected of the detectors where they find "
            f"such a valve, by simulated volumes ({off.mean():.2f} mm in the closed frame)",
        ),
    )
    about = {"sha256": model.sha256, "trained_on": model.trained_on}
    stated = not (settings.pressure_mmHg is None and curve is None)
    return DetectedValve(
        volume,
        valve,
        rows,
        frames,
        case,
        about,
        stated,
        settings.min_confidence,
        _unlike(valve.confidence, accuracy),
    )


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


def write_image_step(detected: DetectedValve, folder: Path) -> ImageStep:
    """Write pictures, measures, surfaces, landmarks and the case.

    They are drawn here, where the volume is at hand.
    """
    from mvest.reporting.figures import save_figure_with
    from mvest.reporting.images.figures import measures_figure
    from mvest.reporting.images.montage import montage_figure

    images, case = folder / IMAGES, folder / CASE
    for place in (images, case):
        # Of an earlier run.
        shutil.rmtree(place, ignore_errors=True)
    images.mkdir(parents=True)
    name, line = detected.case.name, _called(detected.volume)
    drawn = {
        "montage": (
            montage_figure(
                detected.volume,
                detected.valve,
                title=name,
                closed=detected.frames.closed,
                low_confidence=detected.min_confidence,
            ),
            "The valve as it was detected, drawn on the volume.",
        ),
        "measures_over_time": (
            measures_figure(detected.rows, title=name, low_confidence=detected.min_confidence),
            "Measures of the valve over time. Hollow: frames of low confidence. Bands: where 95 % "
            "of true ones are expected, by the detectors' errors on simulated valves.",
        ),
    }
    pictures = {}
    for key, (figure, caption) in drawn.items():
        save_figure_with(folder / key, figure, line)
        pictures[key] = Picture(f"{key}.png", caption)
    write_measures(images, detected.rows)
    write_surfaces(images, detected.valve)
    write_for_slicer(
        images,
        detected.volume,
        detected.valve,
        float(detected.case.surface.thickness.mean()),
        [detected.frames.open, detected.frames.closed],
    )
    files = [f"{IMAGES}/measures.csv", f"{IMAGES}/valve.vtp.series"]
    if detected.pressure_stated:
        write_case(case, detected.case)
        files.append(f"{CASE}/case.yaml")
    volume, uncertainty = detected.volume, detected.case.uncertainty
    return ImageStep(
        pictures=pictures,
        sentences=_sentences(detected),
        frames=tuple(dict(row) for row in detected.rows),
        files=tuple(files),
        model=detected.model,
        volume=VolumeAbout(
            _called(volume),
            volume.sha256,
            volume.modality.value,
            volume.frames.shape,
            tuple(volume.spacing.tolist()),
        ),
        open_frame=detected.frames.open,
        closed_frame=detected.frames.closed,
        confidence=tuple(detected.valve.frame_confidence.tolist()),
        std_mm=uncertainty.typical_mm,
        correlation_length_mm=uncertainty.correlation_length_mm,
        unlike=detected.unlike,
    )


def _draw_candidate(
    volume: VolumeSequence, candidate: ValveSequence, min_confidence: float, folder: Path
) -> Path:
    """Draw what was not accepted, marked as such."""
    from mvest.reporting.figures import save_figure_with
    from mvest.reporting.images.montage import montage_figure

    folder.mkdir(parents=True, exist_ok=True)
    name = _called(volume)
    figure = montage_figure(
        volume, candidate, title=name, low_confidence=min_confidence, accepted=False
    )
    save_figure_with(folder / "candidate", figure, name)
    return folder / "candidate.png"


def _called(volume: VolumeSequence) -> str:
    """A volume by its content: files are often called after a patient."""
    return f"volume {volume.sha256[:12]}"


def _sentences(detected: DetectedValve) -> tuple[str, ...]:
    volume, valve = detected.volume, detected.valve
    confidence = valve.frame_confidence
    size = " x ".join(map(str, volume.frames.shape[1:]))
    return (
        f"{_called(volume)}: {len(volume.times)} frames of {size} voxels, {volume.modality.value}.",
        f"Valve detected with a confidence of {confidence.min():.2f} to {confidence.max():.2f} "
        f"(open frame {detected.frames.open}: {confidence[detected.frames.open]:.2f}, closed frame "
        f"{detected.frames.closed}: {confidence[detected.frames.closed]:.2f}).",
        "The detectors were trained and tested on simulated volumes only; their error there is "
        f"{detected.case.uncertainty.typical_mm:.2f} mm in each coordinate, alike over "
        f"{detected.case.uncertainty.correlation_length_mm:.0f} mm.",
        *([f"{detected.unlike[0].upper()}{detected.unlike[1:]}."] if detected.unlike else []),
        *(f"Derived: {sentence}." for sentence in detected.case.derived),
        *(() if detected.pressure_stated else (NO_PRESSURE,)),
    )


def _modality(name: str | None) -> Modality | None:
    known = [modality.value for modality in Modality]
    if name is not None and name not in known:
        raise ConfigurationError(f"imaged.modality = {name!r}, expected one of {', '.join(known)}")
    return None if name is None else Modality(name)


def _thickness(given: Sequence[float]) -> dict[str, float] | None:
    names = ("anterior", "posterior")
    if given and len(given) != len(names):
        raise ConfigurationError(
            f"imaged.thickness_mm = {list(given)}, expected one number for each of "
            f"{', '.join(names)}, or none"
        )
    return dict(zip(names, given, strict=True)) if given else None


def _pressure_curve(settings: ImagedSettings, *, needed: bool) -> PressureCurve | None:
    """The configured curve, or None where the pressure in the closed frame is given, or none."""
    given = (settings.pressure_mmHg is not None) + (settings.pressure_curve is not None)
    if given > 1 or (needed and not given):
        raise ConfigurationError(
            "imaged.pressure_mmHg or imaged.pressure_curve: expected one of them, the transmitral "
            "pressure on the closed valve"
        )
    if settings.pressure_curve is None:
        return None
    table = read_numbers(Path(settings.pressure_curve), ("time", "pressure"))
    return PressureCurve(table[:, 0], table[:, 1])


def _pairs(setting: str, given: Sequence[Any], kind: type) -> dict[int, Any]:
    """Frame -> value of a setting that is a list of pairs."""
    values: dict[int, Any] = {}
    for pair in given:
        whole = isinstance(pair, Sequence) and len(pair) == 2 and isinstance(pair[0], int)
        if not whole or not isinstance(pair[1], (kind, int) if kind is float else kind):
            raise ConfigurationError(
                f"imaged.{setting} has {pair!r}, expected [frame, "
                f"{'mmHg' if kind is float else 'FILE'}]"
            )
        values[pair[0]] = kind(pair[1])
    return values


def _landmarks(files: Mapping[int, str]) -> dict[int, dict[str, FloatArray]] | None:
    """Frame -> name -> position, of the files that a configuration names."""
    landmarks: dict[int, dict[str, FloatArray]] = {}
    for frame, file in files.items():
        points = {
            label: item.points[k]
            for name, item in read_markups(Path(file)).items()
            if item.kind == "Fiducial" and name != ANNULUS_LABELS
            for k, label in enumerate(item.labels)
        }
        strange = sorted(set(points) - set(LANDMARKS))
        if strange or not points:
            raise InputError(
                f"{file}: points {', '.join(strange) or 'none'}, expected some of "
                f"{', '.join(LANDMARKS)}"
            )
        landmarks[frame] = points
    return landmarks or None


def _frames(
    settings: ImagedSettings,
    curve: PressureCurve | None,
    held: Mapping[int, float],
    valve: ValveSequence,
    rows: list[Row],
) -> CaseFrames:
    pressure, closed, count = settings.pressure_mmHg, settings.closed_frame, len(valve.times)
    min_confidence = settings.min_confidence
    if curve is not None:
        if closed is None:
            sure = [row for row in rows if (row["confidence"] or 0.0) >= min_confidence]
            closed = closed_frame(sure)
        if closed is None or not 0 <= closed < count:
            raise InputError(f"closed frame {closed}, expected one of 0 to {count - 1}")
        pressure = curve(float(valve.times[closed]))
    return choose_frames(
        valve,
        rows,
        STAND_IN_MMHG if pressure is None else pressure,
        open_=settings.open_frame,
        closed=closed,
        held_out=held,
        min_confidence=min_confidence,
    )


def _thinned(count: int, wanted: int) -> IntArray:
    """Numbers of evenly spread samples of the errors, at most ``wanted``."""
    return np.unique(np.linspace(0, count - 1, wanted).round().astype(np.int64))
