"""The study of the image step: detectors are trained on simulated volumes and tested on others."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.schema import build
from experiments.common.study import Section, Study
from experiments.studies.imaging.held_out import HeldOut, hold_out
from experiments.studies.imaging.record import imaging_record
from experiments.studies.imaging.report import NOT_KEPT, imaging_text, write_imaging_study
from experiments.studies.imaging.settings import Settings
from experiments.studies.imaging.store import ImagingStore
from experiments.studies.imaging.tables import imaging_table, imaging_words
from mvest.errors import ConfigurationError, InputError, cannot_write
from mvest.files import write_atomically
from mvest.imaging.detection.shape_start import MODES
from mvest.imaging.detection.tracking import TrackingSettings
from mvest.imaging.detection.trained_model import (
    DetectionAccuracy,
    DetectionModel,
    load_model,
    save_model,
)
from mvest.imaging.landmarks import landmark_vertices
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import Correlogram, measure_accuracy
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.moving_valve import MovingValve
from mvest.provenance import provenance
from mvest.reporting.images.figures import SETTINGS

__all__ = ["MODEL", "STUDY", "publish_model", "require_imaging", "run_imaging"]

Values = Mapping[str, Any]

MODEL = "tee.npz"
"""The trained detectors, in the folder of a run."""

POPULATIONS = ("train", "calibration", "test")


def run_imaging(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Train detectors, and test them on valves that no training saw: the record, and the model."""
    require_imaging(config)
    store, imaging = ImagingStore(config), config["imaging"]
    valves = store.population("train").valves
    trained_on = {
        "valves": [valve.name for valve in valves],
        "seed": store.seed,
        "settings": json.loads(json.dumps(asdict(store.training))),
        "versions": _versions(),
    }

    def train(volumes: int) -> DetectionModel:
        return store.model(valves, volumes, {**trained_on, "volumes": volumes})[0]

    model = train(store.training.volumes)
    held_out: HeldOut | None = None
    accuracy: tuple[DetectionAccuracy, Correlogram] | None = None
    if imaging["evaluate"]:
        apart = [store.population(which).valves for which in POPULATIONS[1:]]
        require_apart(valves, *apart)
        for volumes in imaging["curve"]:
            train(volumes)
        held_out = hold_out(store, config, *apart)
        accuracy, trained_on["calibrated_on"] = _calibrated(config, held_out)
    final = DetectionModel(
        model.shape,
        model.boosters,
        {**trained_on, "volumes": store.training.volumes, "config_hash": config_hash},
        None if accuracy is None else accuracy[0],
    )
    save_model(folder / MODEL, final)
    record = imaging_record(config, config_hash, store, held_out, accuracy, started)
    raw = (folder / MODEL).read_bytes()
    record["model_file"] = {"sha256": hashlib.sha256(raw).hexdigest(), "bytes": len(raw)}
    return record, [folder / MODEL]


def _calibrated(
    config: Values, held_out: HeldOut
) -> tuple[tuple[DetectionAccuracy, Correlogram], list[str]]:
    """Errors in the volumes in which the valve was found, and the names of these valves.

    Where it was not, or where something else was taken for it, no standard deviation tells how far.
    """
    kind = "calibration"
    least, wrong = (
        config["imaging"]["detection"]["min_confidence"],
        config["imaging"]["held_out"]["wrong_mm"],
    )
    found = held_out.found(kind, least, wrong)
    rows = found.sequences[kind]
    if len(rows) < 2:
        raise InputError(
            f"imaging.calibration: in {len(rows)} of {len(held_out.sequences[kind])} volumes the "
            f"valve was found (confidence at least {least:g}, points nearer than {wrong:g} mm), "
            "expected two or more: more volumes to train on"
        )
    samples, tips, rest = (found.stacked(kind, name) for name in ("errors", "tip_errors", "rest"))
    return measure_accuracy(samples, tips, rest.mean(axis=0)), [row["valve"] for row, _ in rows]


def publish_model(config: Values, record: Values, folder: Path) -> None:
    """Make a finished run's detectors those that come with the package, if that is asked for.

    Raises
    ------
    InputError
        If they are not there any more, or cannot be written.
    """
    if not config["imaging"]["publish_model"]:
        return
    source = folder / MODEL
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


def require_imaging(config: Values) -> None:
    """Refuse settings that the study could not run with.

    Raises
    ------
    MvestError
        The message names the setting.
    """
    imaging = config["imaging"]
    if imaging is None:
        raise ConfigurationError("imaging is not given; expected one of conf/imaging")
    store = ImagingStore(config)
    _require_populations(imaging)
    volumes, held_out = store.training.volumes, imaging["held_out"]
    _at_least(1, "training.volumes", volumes)
    _at_least(1, "processes", imaging["processes"])
    for size in imaging["curve"]:
        if not 1 <= size < volumes:
            raise ConfigurationError(
                f"imaging.curve has {size} volumes, expected 1 to {volumes - 1}: fewer than "
                "imaging.training.volumes"
            )
    if len(set(imaging["curve"])) < len(imaging["curve"]):
        raise ConfigurationError(f"imaging.curve = {imaging['curve']}, expected other numbers")
    curve = 1 if imaging["curve"] else 0
    for name, least in {
        "volumes": 1, "shifted": 1, "sequences": 1, "shifted_sequences": 0, "without_valve": 1,
        "curve_volumes": curve,
    }.items():  # fmt: skip
        _at_least(least, f"held_out.{name}", held_out[name])
    most = min(held_out["volumes"], held_out["shifted"])
    if held_out["curve_volumes"] > most:
        raise ConfigurationError(
            f"imaging.held_out.curve_volumes = {held_out['curve_volumes']}, expected at most "
            f"{most}: all held-out volumes"
        )
    if not held_out["wrong_mm"] > 0:
        raise ConfigurationError(
            f"imaging.held_out.wrong_mm = {held_out['wrong_mm']}, expected a distance > 0"
        )
    settings = build(TrackingSettings, imaging["detection"])
    modes = max(MODES, *settings.fit.modes)
    if store.training.modes < modes:
        raise ConfigurationError(
            f"imaging.training.modes = {store.training.modes}, expected at least {modes}: as many "
            "as are read off and as imaging.detection.fit.modes has"
        )
    motion = store.population_settings.motion
    landmark_vertices(ValveLayout(motion.columns, motion.rows))
    _require_targets(imaging["targets"])


def _require_populations(imaging: Values) -> None:
    for which, least in zip(POPULATIONS, (1, 2, 1), strict=True):
        _at_least(least, f"{which}.count", imaging[which]["count"])
        _at_least(0, f"{which}.seed", imaging[which]["seed"])
    seeds = [imaging[which]["seed"] for which in POPULATIONS]
    if len(set(seeds)) < len(seeds):
        told = ", ".join(f"imaging.{which}.seed" for which in POPULATIONS)
        raise ConfigurationError(
            f"{told} = {', '.join(map(str, seeds))}, expected different seeds: a valve that was "
            "trained on tests nothing"
        )


def _at_least(least: int, name: str, value: Any) -> None:
    if not isinstance(value, int) or value < least:
        raise ConfigurationError(f"imaging.{name} = {value}, expected a number >= {least}")


def _require_targets(targets: Values) -> None:
    """Targets that no table has would only be noticed at the end."""
    names = ("surface_mm", "point_mm", "tips_mm", "annulus_area_error_percent", "ap_error_mm")
    blank = [{"setting": s, "seconds": 1.0, **dict.fromkeys(names, 1.0)} for s in SETTINGS]
    try:
        imaging_words(imaging_table(blank), targets)
    except (InputError, AttributeError, TypeError, ValueError) as error:
        raise ConfigurationError(f"imaging.targets: {error}") from error


def _versions() -> dict[str, Any]:
    found = provenance()["versions"]
    return {name: found[name] for name in ("mvest", "numpy", "lightgbm")}


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_imaging),
    words=lambda record: imaging_text(flat(record)),
    write=each(write_imaging_study),
    keep=lambda record: replace(
        record,
        findings={key: value for key, value in record.findings.items() if key not in NOT_KEPT},
    ),
    finish=lambda job, record: publish_model(job.values, flat(record), job.folder),
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
        ),
    ),
)
