"""The study of the image step: detectors are trained on simulated volumes and tested on others."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from experiments.common.records.record import Outcome, Record
from experiments.common.records.report import answer_of_main
from experiments.common.schema import build
from experiments.common.study import Job, Section, Study
from experiments.studies.imaging.evaluation import findings_of, tested_of
from experiments.studies.imaging.findings import DetectedVolume, Evaluation, Findings
from experiments.studies.imaging.held_out import HeldOut, hold_out
from experiments.studies.imaging.report import imaging_answer, imaging_text, write_imaging
from experiments.studies.imaging.settings import ImagingSettings, Settings
from experiments.studies.imaging.store import ImagingStore
from experiments.studies.imaging.tables import imaging_table, imaging_words
from mvest.errors import ConfigurationError, InputError, cannot_write
from mvest.files import write_atomically
from mvest.imaging.detection.shape_start import MODES
from mvest.imaging.detection.trained_model import (
    DetectionAccuracy,
    DetectionModel,
    load_model,
    save_model,
)
from mvest.imaging.landmarks import landmark_vertices
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import Correlogram, measure_accuracy, widened
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.moving_valve import MovingValve
from mvest.provenance import provenance
from mvest.reporting.images.figures import SETTINGS

__all__ = ["MODEL", "STUDY", "publish_model", "require_imaging", "run_imaging"]

Values = Mapping[str, Any]

MODEL = "tee.npz"
"""The trained detectors, in the folder of a run."""

POPULATIONS = ("train", "calibration", "test")

WIDE = "wide calibration"
"""Volumes of the valves of calibration by which errors are stated wider where one is less sure."""


def run_imaging(job: Job[Settings]) -> Outcome[Findings]:
    """Train detectors, and test them on valves that no training saw; the model is left beside.

    Raises
    ------
    MvestError
        If a setting is inadmissible; the message names it.
    """
    require_imaging(job.values)
    settings = job.settings.imaging
    store = ImagingStore(job.values, settings)
    valves = () if store.given else store.population("train").valves
    trained_on = {
        "valves": [valve.name for valve in valves],
        "seed": store.seed,
        "settings": json.loads(json.dumps(asdict(store.training))),
        "versions": _versions(),
    }

    def train(volumes: int) -> DetectionModel:
        return store.model(valves, volumes, {**trained_on, "volumes": volumes})[0]

    if store.given:
        model = load_model(store.given)
        trained_on = dict(model.trained_on)
    else:
        model = train(store.training.volumes)
        trained_on |= {"volumes": store.training.volumes, "config_hash": job.config_hash}
    tested: Evaluation | None = None
    accuracy: DetectionAccuracy | None = None
    if settings.evaluate:
        apart = [store.population(which).valves for which in POPULATIONS[1:]]
        require_apart(valves, *apart)
        _require_unseen(trained_on, *apart)
        for volumes in store.curve:
            train(volumes)
        held_out = hold_out(store, *apart)
        (accuracy, correlogram), trained_on["calibrated_on"] = _calibrated(settings, held_out)
        tested = tested_of(store, held_out, accuracy, correlogram)
    save_model(
        job.folder / MODEL, DetectionModel(model.shape, model.boosters, trained_on, accuracy)
    )
    done = [] if store.given else ["trained"]
    return Outcome(
        findings=findings_of(store, tested, job.folder / MODEL, trained_on),
        reason=" and ".join([*done, *([] if tested is None else ["tested"])]),
    )


def _calibrated(
    settings: ImagingSettings, held_out: HeldOut
) -> tuple[tuple[DetectionAccuracy, Correlogram], list[str]]:
    """Errors in the volumes in which the valve was detected, and the names of these valves.

    Where it was not, or where something else was taken for it, no standard deviation says how far.
    """
    kind = "calibration"
    threshold, wrong = settings.detection.min_confidence, settings.held_out.wrong_mm
    detected = held_out.detected(kind, threshold, wrong)
    rows = detected.sequences[kind]
    if len(rows) < 2:
        raise InputError(
            f"imaging.calibration: in {len(rows)} of {len(held_out.sequences[kind])} volumes the "
            f"valve was detected (confidence at least {threshold:g}, points nearer than "
            f"{wrong:g} mm), expected two or more: more volumes to train on"
        )
    samples, tips, rest = (
        detected.stacked(kind, name) for name in ("errors", "tip_errors", "rest")
    )
    accuracy, correlogram = measure_accuracy(samples, tips, rest.mean(axis=0))
    accuracy = replace(
        accuracy,
        shapes=detected.stacked(kind, "shapes"),
        tip_shapes=detected.stacked(kind, "tip_shapes"),
    )
    valves = [row["valve"] for row, _ in rows]
    wide = held_out.detected(WIDE, threshold, wrong)
    if wide.sequences[WIDE]:
        accuracy = widened(
            accuracy,
            detected.confidence(kind),
            wide.stacked(WIDE, "errors"),
            wide.confidence(WIDE),
        )
    return (accuracy, correlogram), valves


def publish_model(job: Job[Settings], _record: Record[Findings]) -> None:
    """Make a finished run's detectors those that come with the package, if that is asked for.

    Raises
    ------
    InputError
        If they are not there any more, or cannot be written.
    """
    if not job.settings.imaging.publish_model:
        return
    source = job.folder / MODEL
    if not source.is_file():
        raise InputError(f"{source}: no such file; force=true trains again")
    # What cannot be read is not handed on.
    if load_model(source).accuracy is None:
        print(
            f"note: the errors of {source} were never measured (imaging.evaluate=false)",
            file=sys.stderr,
        )
    try:
        MODEL_FILE.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(MODEL_FILE, error) from error
    write_atomically(MODEL_FILE, source.read_bytes())
    print(f"Detectors in {MODEL_FILE}")


def require_apart(*populations: tuple[MovingValve, ...]) -> None:
    """Refuse populations that have a valve in common, by its name or by its shape.

    Raises
    ------
    ConfigurationError
    """
    seen: dict[str, str] = {}
    for valves in populations:
        own: dict[str, str] = {}
        for valve in valves:
            shape = hashlib.sha256(np.ascontiguousarray(valve.vertices).tobytes()).hexdigest()
            own |= {valve.name: valve.name, shape: valve.name}
        for key, name in own.items():
            if key in seen:
                raise ConfigurationError(
                    f"valve {name} is in two populations; expected other valves to train on, to "
                    "calibrate with and to test on"
                )
        seen |= own


def _require_unseen(trained_on: Values, *populations: tuple[MovingValve, ...]) -> None:
    """Refuse valves that detectors from a file were trained on."""
    known = set(trained_on.get("valves", ()))
    for valve in (valve for valves in populations for valve in valves):
        if valve.name in known:
            raise ConfigurationError(
                f"valve {valve.name} was trained on, expected other valves to calibrate with and "
                "to test on: imaging.calibration.seed, imaging.test.seed"
            )


def require_imaging(config: Values) -> None:
    """Refuse settings that the study could not run with.

    Raises
    ------
    MvestError
        The message names the setting.
    """
    settings = build(Settings, config).imaging
    training, held_out = settings.training, settings.held_out
    _require_populations(settings)
    if settings.model and not settings.evaluate:
        raise ConfigurationError(
            "imaging.model is given and imaging.evaluate=false: nothing would be done"
        )
    _require_min(1, "training.volumes", training.volumes)
    _require_min(1, "processes", settings.processes)
    for size in settings.curve:
        if not 1 <= size < training.volumes:
            raise ConfigurationError(
                f"imaging.curve has {size} volumes, expected 1 to {training.volumes - 1}: fewer "
                "than imaging.training.volumes"
            )
    if len(set(settings.curve)) < len(settings.curve):
        raise ConfigurationError(f"imaging.curve = {list(settings.curve)}, expected other numbers")
    for name, minimum in {
        "volumes": 1, "shifted": 1, "sequences": 1, "shifted_sequences": 0, "without_valve": 1,
        "wide_calibration": 0,
        "curve_volumes": 1 if settings.curve else 0,
    }.items():  # fmt: skip
        _require_min(minimum, f"held_out.{name}", getattr(held_out, name))
    maximum = min(held_out.volumes, held_out.shifted)
    if held_out.curve_volumes > maximum:
        raise ConfigurationError(
            f"imaging.held_out.curve_volumes = {held_out.curve_volumes}, expected at most "
            f"{maximum}: all held-out volumes"
        )
    if not held_out.wrong_mm > 0:
        raise ConfigurationError(
            f"imaging.held_out.wrong_mm = {held_out.wrong_mm}, expected a distance > 0"
        )
    modes = max(MODES, *settings.detection.fit.modes)
    if training.modes < modes:
        raise ConfigurationError(
            f"imaging.training.modes = {training.modes}, expected at least {modes}: as many "
            "as are read off and as imaging.detection.fit.modes has"
        )
    motion = settings.population.motion
    landmark_vertices(ValveLayout(motion.columns, motion.rows))
    _require_targets(settings.targets)


def _require_populations(settings: ImagingSettings) -> None:
    drawn = {which: getattr(settings, which) for which in POPULATIONS}
    for (which, population), minimum in zip(drawn.items(), (1, 2, 1), strict=True):
        _require_min(minimum, f"{which}.count", population.count)
        _require_min(0, f"{which}.seed", population.seed)
    seeds = [population.seed for population in drawn.values()]
    if len(set(seeds)) < len(seeds):
        names = ", ".join(f"imaging.{which}.seed" for which in drawn)
        raise ConfigurationError(
            f"{names} = {', '.join(map(str, seeds))}, expected different seeds: a valve that was "
            "trained on tests nothing"
        )


def _require_min(minimum: int, name: str, value: int) -> None:
    if value < minimum:
        raise ConfigurationError(f"imaging.{name} = {value}, expected a number >= {minimum}")


def _require_targets(targets: Mapping[str, Any]) -> None:
    """Targets that no table has would only be noticed at the end."""
    blank = DetectedVolume("", "", 0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, state_right=True, seconds=1.0)
    try:
        imaging_words(imaging_table([replace(blank, setting=s) for s in SETTINGS]), targets)
    except (InputError, AttributeError, TypeError, ValueError) as error:
        raise ConfigurationError(f"imaging.targets: {error}") from error


def _without_volumes(record: Record[Findings]) -> Record[Findings]:
    """The record without what no table needs."""
    if record.findings.tested is None:
        return record
    tested = replace(record.findings.tested, volumes={}, sequence_frames={})
    return replace(record, findings=replace(record.findings, tested=tested))


def _versions() -> dict[str, Any]:
    versions = provenance()["versions"]
    return {name: versions[name] for name in ("mvest", "numpy", "lightgbm")}


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_imaging,
    words=imaging_text,
    write=write_imaging,
    keep=_without_volumes,
    finish=publish_model,
    require=require_imaging,
    sections=(
        Section(
            "imaging",
            {
                "imaging_distance": "Distance of estimated leaflets from true ones, volume by"
                " volume. Simulated.",
                "imaging_training": "Errors of each stage against the number of training "
                "volumes. Simulated.",
                "imaging_confidence": "Confidence in volumes with and without a valve. Simulated.",
                "imaging_std": "Standard deviation that the image step states of each point. "
                "Simulated.",
            },
            "Valves detected in simulated volumes",
            answer=answer_of_main(imaging_answer),
        ),
    ),
)
