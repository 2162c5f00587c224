"""How far the detectors of valves in echo volumes are off, and how they are trained."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.common.records.record import Number, Record
from experiments.common.schema import Values, build
from experiments.common.study import Job, Result, Results, Study
from experiments.studies.imaging.detectors import ImagingSettings, ImagingStore, Seen
from mvest.cases.from_images.detector_errors import coverage
from mvest.errors import ConfigurationError, InputError
from mvest.files import sha256_of, write_atomically
from mvest.imaging.detection.pose_search import MODES
from mvest.imaging.detection.trained_model import (
    DetectionAccuracy,
    DetectionModel,
    load_model,
    save_model,
)
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import (
    Correlogram,
    best_threshold,
    measure_accuracy,
    unlike_share,
    widened,
)
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.valve_sequence import landmark_vertices
from mvest.provenance import provenance
from mvest.reading.npz import read_npz
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.trials import (
    SEQUENCES,
    VOLUMES,
    WITHOUT_VALVE,
    Trial,
    try_sequence,
    try_volume,
)
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Row = Mapping[str, Any]

MODEL = "tee.npz"
"""The trained detectors, in the folder of a run."""

POPULATIONS = ("train", "calibration", "test")

CALIBRATION, WIDE = "calibration", "wide calibration"
"""Volumes over time that measure the errors, and that say how these grow as confidence falls."""

SETTINGS = {"sequence": VOLUMES[0], "shifted sequence": VOLUMES[1]}
"""Kind of volumes over time -> how its acquisitions are drawn."""

STAGES = {"position": "mm", "pose": "°", "landmarks": "mm", "hinge": "mm", "surface": "mm"}
"""Stages of the detection in their order -> unit of their errors."""

LIMITS_MM = (0.5, 0.8, 1.5)
"""Surface distances marked in the figure. From the last one on a detected valve counts as wrong."""

SHARE, DISTANCE = Column("%", ".0f"), Column("mm", ".2f")
COLUMNS: Mapping[str, Column] = {
    **dict.fromkeys(("confidence", "lowest", "median", "highest"), Column("", ".2f")),
    **{name: Column(unit, ".2f") for name, unit in STAGES.items()},
    **dict.fromkeys(("called_a_valve", "wrongly_so"), SHARE),
    "below_limit": replace(SHARE, label=f"detected, surface below {LIMITS_MM[-1]:g} mm"),
    "wrong_yet_like": replace(SHARE, label="wrong, yet like those of training"),
    "state_right": replace(SHARE, label="orifice open or closed, right"),
    **{f"surface_{which}": DISTANCE for which in ("mean", "median", "open", "closed")},
    "surface_90": replace(DISTANCE, label="surface, 90th percentile"),
    "points": replace(DISTANCE, label="point to point"),
    "tips": replace(DISTANCE, label="papillary tips"),
    "annulus_area": Column("%", ".1f"),
    "annulus_area_bias": Column("%", ".1f"),
    "ap_diameter": replace(DISTANCE, label="AP diameter"),
    "ap_diameter_bias": replace(DISTANCE, label="AP diameter bias"),
    "within_95": replace(SHARE, label="within 1.96 SD"),
    "rms": DISTANCE,
    "stated": replace(DISTANCE, label="rms stated"),
    "within_95_handed_on": replace(SHARE, label="within 1.96 SD, handed on"),
    "rms_handed_on": replace(DISTANCE, label="rms, handed on"),
    "stated_handed_on": replace(DISTANCE, label="rms stated, handed on"),
}
"""Columns of all tables that have a unit. Errors of one frame have a sign, means have none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    imaging: ImagingSettings


def run_imaging(job: Job[Settings]) -> Result:
    """Train detectors and test them on valves that no training saw; the model is left beside."""
    require_imaging(job.values)
    settings = job.settings.imaging
    store = ImagingStore(job.values, settings)
    if store.given:
        model = load_model(store.given)
        trained_on = dict(model.trained_on)
    else:
        valves = store.population("train")
        trained_on = {
            "valves": [valve.name for valve in valves],
            "seed": store.seed,
            "settings": json.loads(json.dumps(asdict(settings.training))),
            "versions": {k: provenance()["versions"][k] for k in ("mvest", "numpy", "lightgbm")},
            "volumes": settings.training.volumes,
        }
        model = store.train(valves, trained_on)
        trained_on["config_hash"] = job.config_hash
    tested, accuracy = Result(), None
    if settings.evaluate:
        apart = [[valve.name for valve in store.population(which)] for which in POPULATIONS[1:]]
        require_apart(trained_on["valves"], *apart)
        volumes, sequences = _held_out(store)
        limits = settings.detection.min_confidence, settings.held_out.wrong_mm
        accuracy, correlogram, trained_on["calibrated_on"] = calibrated(sequences, *limits)
        tested = result_of(volumes, sequences, accuracy, correlogram, model.shape.layout, *limits)
    path = job.folder / MODEL
    save_model(path, DetectionModel(model.shape, model.boosters, trained_on, accuracy))
    about: dict[str, Number] = {
        "training_volumes": trained_on["volumes"],
        "training_valves": len(trained_on["valves"]),
        "model_sha256": sha256_of(path),
    }
    done = [*([] if store.given else ["trained"]), *(["tested"] if settings.evaluate else [])]
    return tested.changed(numbers={**about, **tested.numbers}, reason=" and ".join(done))


# -- what is found in held-out volumes ------------------------------------------------------------
def _held_out(store: ImagingStore) -> tuple[list[Row], dict[str, list[Seen]]]:
    """Rows of volumes of one frame, and what was found in volumes over time, by kind."""
    settings, counts = store.settings, store.settings.held_out
    acquisition, closed = settings.training.acquisition, settings.population.motion.frames - 1

    def trials(kinds: Iterable[str], numbers: Iterable[int]) -> list[Trial]:
        return [
            Trial(kind, k, store.seed, acquisition, closed)
            for kind, count in zip(kinds, numbers, strict=True)
            for k in range(count)
        ]

    without = [counts.without_valve] * len(WITHOUT_VALVE)
    kinds, numbers = (*VOLUMES, *WITHOUT_VALVE), (counts.volumes, counts.shifted, *without)
    volumes = store.tried(try_volume, trials(kinds, numbers))
    over_time = (counts.sequences, counts.shifted_sequences, counts.wide_calibration)
    asked = trials(SEQUENCES, (settings.calibration.count, *over_time))
    sequences: dict[str, list[Seen]] = {kind: [] for kind in SEQUENCES}
    for trial, seen in zip(asked, store.tried(try_sequence, asked), strict=True):
        sequences[trial.kind].append(seen)
    return [row for row, _ in volumes], sequences


def calibrated(
    sequences: Mapping[str, Sequence[Seen]], min_confidence: float, wrong_mm: float
) -> tuple[DetectionAccuracy, Correlogram, list[str]]:
    """Errors in the calibration volumes whose valve was detected, and the names of these valves.

    Where it was not, or where something else was taken for it, no standard deviation says how far.

    Parameters
    ----------
    sequences : mapping
        Kind of volumes over time -> rows and arrays of `try_sequence`.
    min_confidence : float
        From here on something is called a valve.
    wrong_mm : float
        What is found is not the valve if its points are on average this far off.

    Raises
    ------
    InputError
        If the valve was detected in fewer than two of them.
    """
    seen = _detected(sequences[CALIBRATION], min_confidence, wrong_mm)
    if len(seen) < 2:
        raise InputError(
            f"imaging.calibration: in {len(seen)} of {len(sequences[CALIBRATION])} volumes the "
            f"valve was detected (confidence at least {min_confidence:g}, points nearer than "
            f"{wrong_mm:g} mm), expected two or more: more volumes to train on"
        )
    errors, tips, rest, shapes, tip_shapes = (
        _stacked(seen, name) for name in ("errors", "tip_errors", "rest", "shapes", "tip_shapes")
    )
    accuracy, correlogram = measure_accuracy(errors, tips, rest.mean(axis=0))
    accuracy = replace(accuracy, shapes=shapes, tip_shapes=tip_shapes)
    if wide := _detected(sequences[WIDE], min_confidence, wrong_mm):
        own, others = _confidence(seen), _confidence(wide)
        accuracy = widened(accuracy, own, _stacked(wide, "errors"), others)
    return accuracy, correlogram, [row["valve"] for row, _ in seen]


def _detected(seen: Sequence[Seen], min_confidence: float, wrong_mm: float = np.inf) -> list[Seen]:
    return [
        (row, arrays)
        for row, arrays in seen
        if row["confidence"] >= min_confidence and row["points"] < wrong_mm
    ]


def _confidence(seen: Sequence[Seen]) -> FloatArray:
    return np.array([row["median_confidence"] for row, _ in seen])


def _stacked(seen: Sequence[Seen], name: str) -> FloatArray:
    return np.stack([arrays[name] for _, arrays in seen])


# -- tables ---------------------------------------------------------------------------------------
def result_of(
    volumes: Sequence[Row],
    sequences: Mapping[str, Sequence[Seen]],
    accuracy: DetectionAccuracy,
    correlogram: Correlogram,
    layout: ValveLayout,
    min_confidence: float,
    wrong_mm: float,
) -> Result:
    """Tables, numbers and arrays of a test; see `calibrated`."""
    over_time = [row for seen in sequences.values() for row, _ in seen]
    judged = judge([*volumes, *over_time], min_confidence, wrong_mm, accuracy.like_from)
    right, other = (judged["confidence"][judged["right"] == is_right] for is_right in (True, False))
    without = judged["confidence"][judged["kind"].isin(list(WITHOUT_VALVE))]
    count = len(accuracy.samples)
    tables: dict[str, Sequence[Row] | DataFrame] = {
        "": accuracy_rows(judged),
        "over_time": over_time_rows(judged),
        "confidence": confidence_rows(judged),
        "coverage": coverage_rows(sequences, accuracy, layout, min_confidence),
        "stages": stage_rows(judged),
        "volumes": volumes,
        "sequences": over_time,
    }
    return Result(
        tables={name: table_of(rows) for name, rows in tables.items()},
        numbers={
            "calibration_sequences": count,
            "calibration_sequences_left_out": len(sequences[CALIBRATION]) - count,
            "median_std_mm": float(np.median(accuracy.std_mm)),
            "mean_error_mm": float(np.linalg.norm(accuracy.samples.mean(axis=0), axis=2).mean()),
            "correlation_length_mm": accuracy.correlation_length_mm,
            "widening_start": accuracy.widening[0],
            "widening_slope": accuracy.widening[1],
            "unlike_below_confidence": accuracy.like_from,
            "unlike_expected_percent": 100 * unlike_share(count),
            "called_a_valve_from_confidence": min_confidence,
            "not_the_valve_from_mm": wrong_mm,
            "highest_confidence_without_valve": float(without.max()),
            "highest_confidence_wrong": float(other.max()),
            "lowest_confidence_right": float(right.min()) if len(right) else None,
            "best_threshold": best_threshold(right.to_numpy(), other.to_numpy())
            if len(right)
            else None,
        },
        arrays={
            "std_mm": accuracy.std_mm.reshape(layout.rows, layout.columns),
            "distance_mm": correlogram.distance,
            "correlation": correlogram.correlation,
        },
    )


def table_of(rows: Sequence[Row] | DataFrame) -> Table:
    """Rows with the meaning of their columns (`COLUMNS`)."""
    names = rows.columns if hasattr(rows, "columns") else dict.fromkeys(n for r in rows for n in r)
    return table(rows, **{str(name): COLUMNS.get(str(name), Column()) for name in names})


def judge(
    rows: Sequence[Row], min_confidence: float, wrong_mm: float, like_from: float
) -> DataFrame:
    """Rows of trials, and for each whether it is called a valve, is right and is unlike.

    Right is a valve whose points are nearer than ``wrong_mm``; unlike the training's are volumes of
    a confidence below ``like_from``, over time that of the middle frame.
    """
    import pandas as pd

    frame = pd.DataFrame(rows)
    for name in ("points", "median_confidence"):
        frame[name] = frame[name].astype(float) if name in frame else np.nan
    middle = frame["median_confidence"].fillna(frame["confidence"])
    return frame.assign(
        called=frame["confidence"] >= min_confidence,
        right=frame["points"] < wrong_mm,
        unlike=middle < like_from,
    )


def accuracy_rows(judged: DataFrame) -> list[Row]:
    """A row for each setting: errors in volumes of one frame that are called a valve.

    Shares are of all its volumes.
    """
    out: list[Row] = []
    for setting in VOLUMES:
        own = judged[judged["kind"] == setting]
        found = own[own["called"]]
        surface, area, diameter = (
            found[name].astype(float) for name in ("surface", "annulus_area", "ap_diameter")
        )
        believed = (surface >= LIMITS_MM[-1]) & ~found["unlike"]
        out.append(
            {
                "setting": setting,
                "volumes": len(own),
                "called_a_valve": 100 * own["called"].mean(),
                "surface_mean": surface.mean(),
                "surface_median": surface.median(),
                "surface_90": surface.quantile(0.9),
                "below_limit": 100 * (surface < LIMITS_MM[-1]).sum() / len(own),
                "points": found["points"].mean(),
                "tips": found["tips"].mean(),
                "annulus_area": area.abs().mean(),
                "annulus_area_bias": area.mean(),
                "ap_diameter": diameter.abs().mean(),
                "ap_diameter_bias": diameter.mean(),
                "state_right": found["state_right"].astype(float).mean(),
                "wrong_yet_like": 100 * believed.sum() / len(own),
            }
        )
    return out


def over_time_rows(judged: DataFrame) -> DataFrame:
    """A row for each setting: means over the volumes over time that are called a valve."""
    names = ("surface", "surface_open", "surface_closed", "points", "tips", "annulus_area",
             "ap_diameter", "state_right")  # fmt: skip
    found = judged[judged["called"] & judged["kind"].isin(list(SETTINGS))]
    means = (
        found.astype(dict.fromkeys(names, float)).groupby("kind", sort=False)[list(names)].mean()
    )
    means.insert(0, "volumes", found.groupby("kind").size())
    return means.rename(index=SETTINGS).reset_index(names="setting")


def confidence_rows(judged: DataFrame) -> DataFrame:
    """A row for each kind of volumes: how sure the detectors are, and whether rightly.

    A valve is lost where it is not found or something else is; without a valve none is lost.
    """
    lost = ~(judged["called"] & judged["right"]) & ~judged["kind"].isin(list(WITHOUT_VALVE))
    judged = judged.assign(
        called_a_valve=100.0 * judged["called"],
        wrongly_so=100.0 * (judged["called"] & ~judged["right"]),
        lost=lost,
    )
    kinds = judged.groupby("kind", sort=False)
    rows = kinds["confidence"].agg(volumes="size", lowest="min", median="median", highest="max")
    shares, counts = ["called_a_valve", "wrongly_so"], ["lost", "unlike"]
    return rows.join(kinds[shares].mean()).join(kinds[counts].sum()).reset_index()


def stage_rows(judged: DataFrame) -> DataFrame:
    """A row for each stage and setting: median and 90th percentile of the error."""
    with_valve = judged[judged["kind"].isin(VOLUMES)]
    errors = with_valve.melt("kind", list(STAGES), "stage", "error").astype({"error": float})
    stages = errors.groupby(["stage", "kind"], sort=False)["error"]
    rows = stages.quantile(np.array([0.5, 0.9])).unstack()
    rows.columns = ["error", "error_90"]
    rows.insert(0, "volumes", stages.size())
    rows = rows.loc[list(STAGES)].reset_index().rename(columns={"kind": "setting"})
    return rows.assign(unit=rows["stage"].map(STAGES))


def coverage_rows(
    sequences: Mapping[str, Sequence[Seen]],
    accuracy: DetectionAccuracy,
    layout: ValveLayout,
    min_confidence: float,
) -> list[Row]:
    """A row for each setting and frame: see `mvest.cases.from_images.detector_errors.coverage`."""
    rows: list[Row] = []
    for kind, setting in SETTINGS.items():
        if seen := _detected(sequences[kind], min_confidence):
            errors, leaflets, tips = (
                _stacked(seen, name) for name in ("errors", "shapes", "tip_shapes")
            )
            shapes = np.concatenate([leaflets, tips], axis=2)
            covered = coverage(layout, accuracy, errors, shapes, _confidence(seen))
            rows += [
                {"setting": setting, "frame": frame, "volumes": len(seen)} | row
                for frame, row in zip(("open", "closed"), covered, strict=True)
            ]
    return rows


# -- figures --------------------------------------------------------------------------------------
def figure(results: Results) -> dict[str, Figure]:
    """Errors of the detectors, and their confidence; nothing of a run that only trained."""
    from mvest.reporting.images.figures import confidence_figure, errors_figure

    name, record = next(iter(results.records.items()))
    if not record.tables:
        return {}
    threshold, wrong, length = (
        float(record.numbers[key])  # type: ignore[arg-type]
        for key in (
            "called_a_valve_from_confidence",
            "not_the_valve_from_mm",
            "correlation_length_mm",
        )
    )
    volumes, stages = (record.table_of(part).rows for part in ("volumes", "stages"))
    every = [*volumes, *record.table_of("sequences").rows]
    distances = {
        setting: [
            row["surface"]
            for row in volumes
            if row["kind"] == setting and row["confidence"] >= threshold
        ]
        for setting in VOLUMES
    }
    arrays = read_npz(results.arrays[name])
    return {
        "": errors_figure(distances, LIMITS_MM, stages, length_mm=length, **arrays),
        "confidence": confidence_figure(every, threshold, wrong),
    }


# -- settings and the package's model -------------------------------------------------------------
def require_imaging(config: Values) -> None:
    """Refuse settings that the study could not run with.

    Raises
    ------
    MvestError
        The message names the setting.
    """
    settings = build(Settings, config).imaging
    seeds = [getattr(settings, which).seed for which in POPULATIONS]
    if len(set(seeds)) < len(seeds):
        names = ", ".join(f"imaging.{which}.seed" for which in POPULATIONS)
        raise ConfigurationError(
            f"{names} = {', '.join(map(str, seeds))}, expected different seeds: a valve that was "
            "trained on tests nothing"
        )
    if settings.model and not settings.evaluate:
        raise ConfigurationError(
            "imaging.model is given and imaging.evaluate=false: nothing would be done"
        )
    modes = max(MODES, *settings.detection.fit.modes)
    if settings.training.modes < modes:
        raise ConfigurationError(
            f"imaging.training.modes = {settings.training.modes}, expected at least {modes}: as "
            "many as are read off and as imaging.detection.fit.modes has"
        )
    motion = settings.population.motion
    landmark_vertices(ValveLayout(motion.columns, motion.rows))


def require_apart(*populations: Iterable[str]) -> None:
    """Refuse populations that have a valve of the same name.

    Raises
    ------
    ConfigurationError
    """
    seen: set[str] = set()
    for names in map(set, populations):
        if both := seen & names:
            raise ConfigurationError(
                f"valve {min(both)} is in two populations, expected other valves to train on, to "
                "calibrate with and to test on: imaging.calibration.seed, imaging.test.seed"
            )
        seen |= names


def publish_model(job: Job[Settings], _record: Record) -> None:
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
    write_atomically(MODEL_FILE, source.read_bytes())
    print(f"Detectors in {MODEL_FILE}")


STUDY = Study(
    settings=Settings,
    run=run_imaging,
    figure=figure,
    captions={
        "": "Distance of detected leaflets from the true ones, errors of each stage, and size and "
        "correlation of the errors that are stated. Simulated.",
        "confidence": "Confidence in volumes with and without a valve. Simulated.",
    },
    keep_arrays=lambda record, path: read_npz(path),
    finish=publish_model,
    require=require_imaging,
)
