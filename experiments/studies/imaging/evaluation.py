"""What held-out volumes say of detectors: rows for tables, and what they rest on."""

from __future__ import annotations

import hashlib
import resource
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.studies.imaging import findings as record
from experiments.studies.imaging.findings import (
    Accuracy,
    Confidences,
    Correlations,
    Coverage,
    DetectedVolume,
    Evaluation,
    Findings,
    KindOfVolume,
    Learning,
    ModelFile,
    Spent,
)
from experiments.studies.imaging.held_out import HeldOut
from experiments.studies.imaging.store import ImagingStore
from experiments.studies.imaging.trials import SEQUENCES, VOLUMES, WITHOUT_VALVE
from mvest.cases.from_images.expected_error import expected_error
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import Correlogram, share_within
from mvest.typing import FloatArray

__all__ = ["detected_volume", "findings_of", "learning_rows", "tested_of"]

Row = Mapping[str, Any]
Volumes = Mapping[int, list[dict[str, Any]]]

LEARNING = (
    ("position", "mm", "position"),
    ("pose", "degrees", "turn"),
    ("landmarks", "mm", "landmarks"),
    ("hinge", "mm", "annulus"),
    ("surface", "mm", "surface"),
)
"""Stage, unit, and the name of its error in a row."""

SETTING = {"sequence": VOLUMES[0], "shifted sequence": VOLUMES[1]}
"""What tables call volumes over time."""


def findings_of(
    store: ImagingStore, tested: Evaluation | None, model_file: Path, trained_on: Row
) -> Findings:
    """What a finished study cost, and what came of it."""
    settings, raw = store.settings, model_file.read_bytes()
    spent = _spent(store)
    cpu_s = spent["training"].cpu_s
    trained = () if store.given else ("train",)
    which = trained if tested is None else (*trained, "calibration", "test")
    return Findings(
        seconds=cpu_s or 0.0,
        memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        detectors=store.model_key(store.training.volumes),
        layout=_layout(store),
        valves={
            name: record.Population(getattr(settings, name).count, dict(drawn.refused))
            for name in which
            for drawn in (store.population(name),)
        }
        | ({} if trained else {"train": record.Population(len(trained_on["valves"]), {})}),
        training_volumes=trained_on["volumes"],
        spent=spent,
        targets=settings.targets,
        tested=tested,
        measures=_measures(tested) | ({} if cpu_s is None else {"training_cpu_s": cpu_s}),
        model_file=ModelFile(hashlib.sha256(raw).hexdigest(), len(raw)),
    )


def tested_of(
    store: ImagingStore,
    held_out: HeldOut,
    accuracy: DetectionAccuracy,
    correlogram: Correlogram,
) -> Evaluation:
    """Rows of all held-out volumes."""
    threshold = store.settings.detection.min_confidence
    wrong = store.settings.held_out.wrong_mm
    own = held_out.volumes[store.training.volumes]
    sequences = {kind: [row for row, _ in held_out.sequences[kind]] for kind in SEQUENCES}
    return Evaluation(
        rows=tuple(detected_volume(row, threshold) for row in own if row["kind"] in VOLUMES),
        training=tuple(learning_rows(held_out.volumes)),
        confidence=confidences(own, sequences, threshold, wrong),
        sequences=tuple(
            _sequence(row, threshold, wrong) for kind in SETTING for row in sequences[kind]
        ),
        accuracy=Accuracy(
            std_mm=_rounded(accuracy.std_mm),
            median_std_mm=float(np.median(accuracy.std_mm)),
            correlation_length_mm=accuracy.correlation_length_mm,
            sequences=len(accuracy.samples),
            left_out=len(sequences["calibration"]) - len(accuracy.samples),
            mean_error_mm=float(np.linalg.norm(accuracy.samples.mean(axis=0), axis=2).mean()),
            widening=accuracy.widening,
            like_from=accuracy.like_from,
            unlike=_unlike(held_out, accuracy.like_from),
            correlogram=Correlations(
                **{key: _rounded(values) for key, values in asdict(correlogram).items()}
            ),
            within_95=tuple(
                row
                for kind, setting in SETTING.items()
                for row in _coverage(
                    held_out.detected(kind, threshold), kind, setting, accuracy, _layout(store)
                )
            ),
        ),
        volumes={str(size): tuple(rows) for size, rows in held_out.volumes.items()},
        sequence_frames={kind: tuple(rows) for kind, rows in sequences.items()},
    )


def _rounded(values: FloatArray) -> tuple[float, ...]:
    return tuple(round(float(v), 4) for v in values)


def detected_volume(row: Row, min_confidence: float) -> DetectedVolume:
    """What a table of volumes needs of one; little where the valve is not believed in."""
    errors = row["errors"]
    shown = {
        "surface_mm": errors["surface"],
        "point_mm": errors["points"],
        "tips_mm": errors["tips"],
        "annulus_area_error_percent": _area_error(row),
        "ap_error_mm": _ap_error(row),
        "state_right": _state_right(row),
    }
    return DetectedVolume(
        setting=row["kind"],
        valve=row["valve"],
        frame=row["frame"],
        confidence=row["confidence"],
        seconds=row["cpu_s"],
        **(shown if row["confidence"] >= min_confidence else dict.fromkeys(shown)),
    )


def learning_rows(volumes: Volumes) -> Iterator[Learning]:
    """Errors of every stage by the number of training volumes, on the same held-out volumes.

    Parameters
    ----------
    volumes : mapping
        Volumes trained on -> rows of :func:`experiments.studies.imaging.trials.try_volume`.
    """
    common = set.intersection(
        *({(row["kind"], row["number"]) for row in rows} for rows in volumes.values())
    )
    for size, rows in sorted(volumes.items()):
        for setting in VOLUMES:
            own = [r for r in rows if r["kind"] == setting and (setting, r["number"]) in common]
            for stage, unit, name in LEARNING if own else ():
                values = [{**row["errors"], **row["errors"]["stages"]}[name] for row in own]
                median, p90 = float(np.median(values)), float(np.quantile(values, 0.9))
                yield Learning(stage, size, setting, median, p90, unit, len(own))


def _area_error(row: Row) -> float | None:
    """Percent, with sign."""
    true, own = row["true"]["annulus_area_mm2"], row["estimated"]["annulus_area_mm2"]
    return None if None in (true, own) else 100.0 * (own - true) / true


def _ap_error(row: Row) -> float | None:
    """mm, with sign."""
    true, own = row["true"]["ap_diameter_mm"], row["estimated"]["ap_diameter_mm"]
    return None if None in (true, own) else own - true


def _state_right(row: Row) -> bool | None:
    """Whether an open orifice is seen as open and a closed one as closed."""
    true, own = row["true"]["is_open"], row["estimated"]["is_open"]
    return None if None in (true, own) else bool(true == own)


def confidences(
    volumes: list[dict[str, Any]],
    sequences: Mapping[str, list[dict[str, Any]]],
    threshold: float,
    wrong_mm: float,
) -> Confidences:
    """Confidence of every volume and how far it is off, by kind; over time, of its best frame."""
    values: dict[str, tuple[float, ...]] = {}
    off: dict[str, tuple[float | None, ...]] = {}
    for kind in (*VOLUMES, *WITHOUT_VALVE):
        rows = [row for row in volumes if row["kind"] == kind]
        values[kind] = tuple(float(row["confidence"]) for row in rows)
        off[kind] = tuple(row["errors"]["points"] if "errors" in row else None for row in rows)
    for kind, over_time in sequences.items():
        frames = [row["frames"] for row in over_time]
        values[kind] = tuple(max(f["confidence"] for f in own) for own in frames)
        off[kind] = tuple(_mean([f["points"] for f in own]) for own in frames)
    right: list[float] = []
    other: list[float] = []
    kinds = []
    for kind, own in values.items():
        is_right = [distance is not None and distance < wrong_mm for distance in off[kind]]
        right += [v for v, good in zip(own, is_right, strict=True) if good]
        other += [v for v, good in zip(own, is_right, strict=True) if not good]
        if own:
            called = [v >= threshold for v in own]
            wrongly = [c and not good for c, good in zip(called, is_right, strict=True)]
            kinds.append(
                KindOfVolume(
                    kind,
                    len(own),
                    min(own),
                    float(np.median(own)),
                    max(own),
                    100.0 * _mean(called),
                    100.0 * _mean(wrongly),
                )
            )
    return Confidences(
        min_confidence=threshold,
        wrong_mm=wrong_mm,
        rows=tuple(kinds),
        values=values,
        off_mm=off,
        highest_without_valve=max(v for kind in WITHOUT_VALVE for v in values[kind]),
        highest_wrong=max(other),
        lowest_right=min(right) if right else None,
        best_threshold=_threshold(np.array(right), np.array(other)) if right else None,
    )


def _threshold(with_valve: FloatArray, without: FloatArray) -> float:
    """The threshold that parts both kinds best, of equally good ones the middle one."""
    edges = np.unique(np.concatenate([with_valve, without]))
    tried = np.concatenate([edges[:1] - 1e-3, 0.5 * (edges[1:] + edges[:-1]), edges[-1:] + 1e-3])
    right = [(with_valve >= t).mean() + (without < t).mean() for t in tried]
    best = tried[np.isclose(right, max(right))]
    return float(best[len(best) // 2])


def _sequence(row: Row, threshold: float, wrong: float) -> record.Sequence:
    frames = row["frames"]
    area = [v for frame in frames if (v := _area_error(frame)) is not None]
    ap = [v for frame in frames if (v := _ap_error(frame)) is not None]
    state = [v for frame in frames if (v := _state_right(frame)) is not None]
    confidence = max(frame["confidence"] for frame in frames)
    surface, points, tips = (_mean([f[n] for f in frames]) for n in ("surface", "points", "tips"))
    return record.Sequence(
        setting=SETTING[row["kind"]],
        valve=row["valve"],
        frames=len(frames),
        confidence=confidence,
        detected=bool(confidence >= threshold),
        wrong=bool(confidence >= threshold and points >= wrong),
        surface_mm=surface,
        points_mm=points,
        tips_mm=tips,
        surface_open_mm=frames[0]["surface"],
        surface_closed_mm=frames[row["closed"]]["surface"],
        annulus_area_error_percent=_mean(np.abs(area)) if area else None,
        ap_error_mm=_mean(np.abs(ap)) if ap else None,
        state_right_percent=100.0 * _mean(state) if state else None,
        seconds=row["cpu_s"],
    )


def _layout(store: ImagingStore) -> ValveLayout:
    motion = store.settings.population.motion
    return ValveLayout(motion.columns, motion.rows)


def _coverage(
    held_out: HeldOut, kind: str, setting: str, accuracy: DetectionAccuracy, layout: ValveLayout
) -> Iterator[Coverage]:
    """How many coordinates lie within 1.96 of the stated deviations, wrong ones and all.

    As they are found, and as they are handed on with a case: less the error that is expected of
    such a shape, and with the deviations of the samples about it.
    """
    if not held_out.sequences[kind]:
        return
    errors, factors = held_out.stacked(kind, "errors"), held_out.confidence(kind)
    factors = np.array([accuracy.factor(one) for one in factors])[:, None, None, None]
    shapes = [held_out.stacked(kind, name) for name in ("shapes", "tip_shapes")]
    expected, samples = zip(
        *(expected_error(layout, accuracy, one) for one in np.concatenate(shapes, axis=2)),
        strict=True,
    )
    n = layout.size
    left = (errors - np.stack(expected)[:, :, :n]) / factors
    spread = np.stack([np.sqrt((one[:, :, :n] ** 2).mean(axis=(0, 3))) for one in samples])
    for k, frame in enumerate(("open", "closed")):
        own = errors[:, k : k + 1]
        yield Coverage(
            setting=setting,
            frame=frame,
            sequences=len(errors),
            share=share_within(own / factors, accuracy.std_mm),
            share_handed_on=share_within(left[:, k] / spread[:, k, :, None], np.ones(n)),
            rms_mm=_rms(own),
            stated_rms_mm=float(np.sqrt((accuracy.std_mm**2).mean() * (factors**2).mean())),
            rms_handed_on_mm=_rms(factors[:, 0] * left[:, k]),
            stated_handed_on_mm=_rms(factors[:, 0, 0] * spread[:, k]),
        )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def _unlike(held_out: HeldOut, like_from: float) -> dict[str, tuple[int, int]]:
    """How many volumes over time count as unlike those of training, of how many; by setting."""
    return {
        setting: (int((confidence < like_from).sum()), len(confidence))
        for kind, setting in (SETTING | {"calibration": "in distribution, other valves"}).items()
        if held_out.sequences[kind]
        for confidence in (held_out.confidence(kind),)
    }


def _mean(values: Any) -> float:
    return float(np.mean(values))


def _spent(store: ImagingStore) -> dict[str, Spent]:
    """CPU and wall-clock seconds of every part; None where it was not measured."""
    settings = store.settings
    parts = dict.fromkeys(("valves", "volumes", "draft", "trees"), Spent(None))
    if store.given is None:
        volumes = store.samples(store.population("train").valves, store.training.volumes)
        parts = {
            "valves": store.population_spent("train"),
            "volumes": Spent(sum(one.cpu_s for one in volumes)),
            "draft": store.draft_spent(),
            "trees": store.model_spent(store.training.volumes),
        }
    known = [spent.cpu_s for spent in parts.values() if spent.cpu_s is not None]
    parts["training"] = Spent(sum(known) if len(known) == len(parts) else None)
    if settings.evaluate:
        for size in store.curve:
            parts[f"trees of {size} volumes"] = store.model_spent(size)
        for which in ("calibration", "test"):
            parts[f"valves of {which}"] = store.population_spent(which)
    return parts


def _measures(tested: Evaluation | None) -> dict[str, float]:
    """Numbers that runs are compared by."""
    measures: dict[str, float] = {}
    if tested is None:
        return measures
    for setting in VOLUMES:
        own = [row.surface_mm for row in tested.rows if row.setting == setting]
        surface = [value for value in own if value is not None]
        if own:
            name = setting.replace(" ", "_")
            measures[f"detected.{name}"] = len(surface) / len(own)
            measures |= {f"surface_mm.{name}": float(np.median(surface))} if surface else {}
    return measures | {
        "std_mm": tested.accuracy.median_std_mm,
        "correlation_length_mm": tested.accuracy.correlation_length_mm,
    }
