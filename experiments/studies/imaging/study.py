"""Trains the detectors of valves in echo volumes and measures their errors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.common.records.record import Number
from experiments.common.schema import Values
from experiments.common.study import Figures, Job, Result, Results, Study
from experiments.studies.imaging.detectors import ImagingSettings, ImagingStore, Seen
from mvest.cases.from_images.detector_errors import coverage
from mvest.errors import ConfigurationError, InputError
from mvest.files import sha256_of
from mvest.imaging.detection.trained_model import (
    DetectionAccuracy,
    DetectionModel,
    load_model,
    save_model,
)
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import measure_accuracy, unlike_share, widened
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.valve_sequence import landmark_vertices
from mvest.provenance import provenance
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
    from pandas import DataFrame

Row = Mapping[str, Any]

MODEL, PACKAGED = "tee.npz", "package"
"""File of trained detectors in a run's folder, and name of the packaged detectors."""

POPULATIONS = ("train", "calibration", "test")

CALIBRATION, *TESTED, WIDE = SEQUENCES
"""Kinds of volumes over time: to measure errors, for tests, and to measure how errors grow as
confidence falls."""

LIMIT_MM = 1.5
"""A detected valve with a larger mean surface distance counts as wrong."""

ERRORS = {
    **dict.fromkeys(("surface", "surface_open", "surface_closed", "points", "tips"), "mm"),
    "annulus_area": "%",
    "ap_diameter": "mm",
}
"""Errors of a trial and their units: distances, and errors of clinical measurements."""

SHARE = Column("%", ".0f")
COLUMNS: Mapping[str, Column] = {
    **dict.fromkeys(("confidence", "lowest", "median", "highest"), Column("", ".2f")),
    **{name: Column(unit, ".2f") for name, unit in ERRORS.items()},
    **dict.fromkeys(("called_a_valve", "wrongly_so", "within_95", "state_right"), SHARE),
    "below_limit": replace(SHARE, label=f"detected, surface below {LIMIT_MM:g} mm"),
    "wrong_yet_like": replace(SHARE, label="wrong, yet like those of training"),
    "within_95_handed_on": replace(SHARE, label="within 95, handed on"),
    "percentile_90": Column(label="90th percentile"),
    **dict.fromkeys(("rms", "stated", "rms_handed_on", "stated_handed_on"), Column("mm", ".2f")),
}
"""Columns with a unit, in all tables."""


# -- run ------------------------------------------------------------------------------------------
def run_imaging(job: Job[ImagingSettings]) -> Result:
    """Train detectors, test them on other valves, and save them in the folder of the run."""
    require_imaging(job.values)
    settings = job.settings
    store = ImagingStore(job.values, settings)
    if settings.model is not None:
        file = MODEL_FILE if settings.model == PACKAGED else Path(settings.model)
        model = load_model(file)
        trained_on = dict(model.trained_on)
    else:
        file = store.model_entry().path
        trained_on = {
            "valves": [valve.name for valve in store.population("train")],
            "seed": store.seed,
            "settings": json.loads(json.dumps(asdict(settings.training))),
            "versions": {k: provenance()["versions"][k] for k in ("mvest", "numpy", "lightgbm")},
            "volumes": settings.training.volumes,
        }
        model = store.train(trained_on)
        trained_on["config_hash"] = job.config_hash
    tested, accuracy = Result(), None
    if settings.evaluate:
        held_out = chain(*(store.population(which) for which in POPULATIONS[1:]))
        if both := set(trained_on["valves"]) & {valve.name for valve in held_out}:
            raise ConfigurationError(
                f"valve {min(both)} was trained on, expected other valves to calibrate with and to "
                "test on: imaging.calibration.seed, imaging.test.seed"
            )
        limits = settings.min_confidence, settings.held_out.wrong_mm
        seen = _held_out(store, file)
        accuracy, trained_on["calibrated_on"] = calibrated(seen, *limits)
        tested = result_of(seen, accuracy, model.shape.layout, *limits)
    path = job.folder / MODEL
    save_model(path, DetectionModel(model.shape, model.boosters, trained_on, accuracy))
    about: dict[str, Number] = {
        "training_volumes": trained_on["volumes"],
        "training_valves": len(trained_on["valves"]),
        "model_sha256": sha256_of(path),
    }
    done = ["trained"] * (settings.model is None) + ["tested"] * settings.evaluate
    return tested.changed(numbers={**about, **tested.numbers}, reason=" and ".join(done))


def _held_out(store: ImagingStore, file: Path) -> list[Seen]:
    """Detections in volumes of one frame, and in volumes over time."""
    settings, counts = store.settings, store.settings.held_out
    tested = counts.sequences, counts.shifted_sequences, counts.wide_calibration
    numbers = dict(zip(SEQUENCES, (settings.calibration.count, *tested), strict=True))
    numbers |= dict(zip(VOLUMES, (counts.volumes, counts.shifted), strict=True))
    numbers |= dict.fromkeys(WITHOUT_VALVE, counts.without_valve)
    acquisition, closed = settings.training.acquisition, settings.motion.frames - 1
    seen = []
    for kinds, function in (((*VOLUMES, *WITHOUT_VALVE), try_volume), (SEQUENCES, try_sequence)):
        trials = [
            Trial(kind, k, store.seed, acquisition, closed)
            for kind in kinds
            for k in range(numbers[kind])
        ]
        seen += store.tried(function, trials, file)
    return seen


def calibrated(
    seen: Sequence[Seen], min_confidence: float, wrong_mm: float
) -> tuple[DetectionAccuracy, list[str]]:
    """Errors in the calibration volumes with a detected valve, and the names of these valves.

    InputError if fewer than two volumes have a detected valve.

    Parameters
    ----------
    seen : sequence
        Rows and arrays from `try_sequence`, of all kinds.
    min_confidence : float
        Lowest confidence of a detected valve.
    wrong_mm : float
        A detection with this mean point error is not the valve.
    """
    own = _detected(seen, CALIBRATION, min_confidence, wrong_mm)
    if len(own) < 2:
        count = sum(row["kind"] == CALIBRATION for row, _ in seen)
        raise InputError(
            f"imaging.calibration: in {len(own)} of {count} volumes the valve was detected "
            f"(confidence at least {min_confidence:g}, points nearer than {wrong_mm:g} mm), "
            "expected two or more: train on more volumes"
        )
    errors, tips, rest, shapes, tip_shapes = (
        _stacked(own, name) for name in ("errors", "tip_errors", "rest", "shapes", "tip_shapes")
    )
    accuracy = measure_accuracy(errors, tips, rest.mean(axis=0))
    accuracy = replace(accuracy, shapes=shapes, tip_shapes=tip_shapes)
    if wide := _detected(seen, WIDE, min_confidence, wrong_mm):
        errors = _stacked(wide, "errors")
        accuracy = widened(accuracy, _confidence(own), errors, _confidence(wide))
    return accuracy, [row["valve"] for row, _ in own]


def _detected(
    seen: Sequence[Seen], kind: str, min_confidence: float, wrong_mm: float = np.inf
) -> list[Seen]:
    return [
        (row, arrays)
        for row, arrays in seen
        if row["kind"] == kind and row["confidence"] >= min_confidence and row["points"] < wrong_mm
    ]


def _confidence(seen: Sequence[Seen]) -> FloatArray:
    return np.array([row["median_confidence"] for row, _ in seen])


def _stacked(seen: Sequence[Seen], name: str) -> FloatArray:
    return np.stack([arrays[name] for _, arrays in seen])


# -- tables and figure ----------------------------------------------------------------------------
def result_of(
    seen: Sequence[Seen],
    accuracy: DetectionAccuracy,
    layout: ValveLayout,
    min_confidence: float,
    wrong_mm: float,
) -> Result:
    """Tables and numbers of a test; see `calibrated`."""
    trials = judge([row for row, _ in seen], min_confidence, wrong_mm, accuracy.like_from)
    count, tried = len(accuracy.samples), int((trials["kind"] == CALIBRATION).sum())
    covered: list[Row] = []
    for kind in TESTED:
        if own := _detected(seen, kind, min_confidence):
            shapes = np.concatenate([_stacked(own, "shapes"), _stacked(own, "tip_shapes")], axis=2)
            rows = coverage(layout, accuracy, _stacked(own, "errors"), shapes, _confidence(own))
            covered += [
                {"kind": kind, "frame": frame, "volumes": len(own)} | row
                for frame, row in zip(("open", "closed"), rows, strict=True)
            ]
    return Result(
        tables=tables_of(trials, covered),
        numbers={
            "calibration_sequences": count,
            "calibration_sequences_left_out": tried - count,
            "median_std_mm": float(np.median(accuracy.std_mm)),
            "mean_error_mm": float(np.linalg.norm(accuracy.samples.mean(axis=0), axis=2).mean()),
            "correlation_length_mm": accuracy.correlation_length_mm,
            "widening_start": accuracy.widening[0],
            "widening_slope": accuracy.widening[1],
            "unlike_below_confidence": accuracy.like_from,
            "unlike_expected_percent": 100 * unlike_share(count),
            "called_a_valve_from_confidence": min_confidence,
            "not_the_valve_from_mm": wrong_mm,
        },
    )


def tables_of(trials: DataFrame, covered: Sequence[Row]) -> dict[str, Table]:
    """The tables of a test, with the meaning of their columns (`COLUMNS`)."""
    tables = {
        "": table(kind_rows(trials)),
        "errors": table(error_rows(trials)),
        "coverage": table(covered),
        "trials": table(trials),
    }
    return {
        part: replace(one, columns={name: COLUMNS.get(name, Column()) for name in one.values})
        for part, one in tables.items()
    }


def judge(
    rows: Sequence[Row], min_confidence: float, wrong_mm: float, like_from: float
) -> DataFrame:
    """Rows of trials; whether each is detected as a valve, correct, and unlike the training data.

    A valve is correct if its mean point error is below ``wrong_mm``. A volume is unlike the
    training data if its confidence (of the median frame over time) is below ``like_from``.
    """
    import pandas as pd

    frame = pd.DataFrame(rows)
    names = ["points", "median_confidence", "state_right", *ERRORS]
    frame = frame.reindex(columns=list(dict.fromkeys([*frame, *names])))
    frame = frame.astype(dict.fromkeys(names, float))
    middle = frame["median_confidence"].fillna(frame["confidence"])
    return frame.assign(
        called=frame["confidence"] >= min_confidence,
        right=frame["points"] < wrong_mm,
        unlike=middle < like_from,
    )


def kind_rows(trials: DataFrame) -> DataFrame:
    """A row for each kind of volume: detector confidence and fractions of correct detections.

    A valve is lost if nothing or something else is detected.
    """
    found, wrong = trials["called"], trials["surface"] >= LIMIT_MM
    judged = trials.assign(
        lost=~(found & trials["right"]) & ~trials["kind"].isin(list(WITHOUT_VALVE)),
        called_a_valve=100.0 * found,
        wrongly_so=100.0 * (found & ~trials["right"]),
        below_limit=(100.0 * (found & ~wrong)).where(trials["kind"].isin([*VOLUMES, *TESTED])),
        wrong_yet_like=100.0 * (found & wrong & ~trials["unlike"]),
        state_right=trials["state_right"].where(found),
    )
    kinds = judged.groupby("kind", sort=False)
    rows = kinds["confidence"].agg(volumes="size", lowest="min", median="median", highest="max")
    shares = ["called_a_valve", "wrongly_so", "below_limit", "wrong_yet_like", "state_right"]
    return rows.join(kinds[["lost", "unlike"]].sum()).join(kinds[shares].mean()).reset_index()


def error_rows(trials: DataFrame) -> DataFrame:
    """Mean, median and 90th percentile of absolute errors of detected valves, by kind."""
    found = trials[trials["called"] & trials["kind"].isin([*VOLUMES, *TESTED])]
    errors = found.melt("kind", list(ERRORS), "error", "size").dropna(subset="size")
    sizes = errors.assign(size=errors["size"].abs()).groupby(["error", "kind"], sort=False)["size"]
    rows = sizes.agg(volumes="size", mean="mean", median="median")
    rows["percentile_90"] = sizes.quantile(0.9)
    plain = rows.reset_index()
    return plain.assign(unit=plain["error"].map(ERRORS))


def figure(results: Results) -> Figures:
    """Confidence and surface distance in every volume; None if the run only trained."""
    from mvest.reporting.figures import COLOURS, SMALL, headline, log_axis, panels

    record = results.first
    if not record.tables:
        return None
    trials, random = record.table_of("trials").frame, np.random.default_rng(0)
    kinds = list(trials["kind"].unique())
    drawn, grid = panels(1, 2, 0.42 * len(kinds) + 1.6, sharey=True)
    called: Any = record.numbers["called_a_valve_from_confidence"]
    limits = {"confidence": called, "surface": LIMIT_MM}
    for axes, (name, limit) in zip(grid[0], limits.items(), strict=True):
        axes.axvline(limit, color="0.25", lw=1.0, ls="--", zorder=0)
        for k, kind in enumerate(kinds):
            own, colour = trials[trials["kind"] == kind], COLOURS[kind in WITHOUT_VALVE]
            places = k + random.uniform(-0.2, 0.2, len(own))
            for right, face in ((own["right"], colour), (~own["right"], "white")):
                axes.plot(own[name][right], places[right], "o", ms=4, mec=colour, mfc=face)
    grid[0, 0].set_xlabel("confidence; over time of the best frame")
    grid[0, 1].set_xlabel("mean distance from the true surface [mm]")
    grid[0, 1].set_xscale("log")
    log_axis(grid[0, 1].xaxis)
    grid[0, 0].set_yticks(range(len(kinds)), kinds, fontsize=SMALL)
    grid[0, 0].set_ylim(len(kinds) - 0.5, -0.5)
    headline(
        drawn,
        "Detectors in simulated volumes that were not trained on",
        "Hollow: no valve, or not the valve. Dashed: least confidence of a valve, "
        f"and {LIMIT_MM:g} mm.",
    )
    return drawn


# -- settings -------------------------------------------------------------------------------------
def require_imaging(config: Values) -> None:
    """Raise a MvestError that names an inadmissible setting."""
    settings = STUDY.settings_of(config)
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
    motion = settings.motion
    landmark_vertices(ValveLayout(motion.columns, motion.rows))


STUDY = Study(
    settings=ImagingSettings,
    part="imaging",
    run=run_imaging,
    figure=figure,
    captions={
        "": "Confidence, and distance of detected leaflets from the true ones, in volumes with and "
        "without a valve. Simulated."
    },
    require=require_imaging,
    golden=("patient", "volume"),
)
