"""The record of the study of the image step: rows for tables, and what they rest on."""

from __future__ import annotations

import resource
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from experiments.studies.imaging.held_out import HeldOut
from experiments.studies.imaging.store import ImagingStore, Spent
from experiments.studies.imaging.trials import SEQUENCES, VOLUMES, WITHOUT_VALVE
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.learning.accuracy import Correlogram, share_within
from mvest.provenance import provenance
from mvest.typing import FloatArray

__all__ = ["imaging_record", "learning_rows", "table_row"]

Values = Mapping[str, Any]
Row = Mapping[str, Any]

LEARNING = (
    ("position", "mm", "position"),
    ("pose", "degrees", "turn"),
    ("landmarks", "mm", "landmarks"),
    ("hinge", "mm", "annulus"),
    ("surface", "mm", "surface"),
)
"""Stage, unit, and the name of its error in a row."""

SIZES = ("surface", "points", "tips")

SETTING = {"sequence": VOLUMES[0], "shifted sequence": VOLUMES[1]}
"""What tables call volumes over time."""


def imaging_record(
    config: Values,
    config_hash: str,
    store: ImagingStore,
    held_out: HeldOut | None,
    accuracy: tuple[DetectionAccuracy, Correlogram] | None,
    started: float,
) -> dict[str, Any]:
    """Everything of a finished study in plain values, with the keys that every record has."""
    spent = _spent(config, store)
    motion = store.population_settings.motion
    trained = spent["training"]
    record: dict[str, Any] = {
        **{key: config[key] for key in ("title", "row", "table", "parameters")},
        "schema": 1,
        "experiment": config["name"],
        "status": "converged",
        "reason": "trained" if held_out is None else "trained and tested",
        "detail": "",
        "truth": None,
        "estimate": None,
        "std": None,
        "relative_error": None,
        "iterates": None,
        "iterate_std": None,
        "distance_mm": None,
        "distance_to_truth_mm": None,
        "moduli_error_percent": None,
        "iterations": 0,
        "forward_solves": 0,
        "seconds": trained["cpu_s"] or 0.0,
        "seconds_total": time.time() - started,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "mesh": {},
        "detectors": store.model_key(store.training.volumes),
        "layout": {"columns": motion.columns, "rows": motion.rows},
        "valves": {
            which: {"count": config["imaging"][which]["count"], "refused": dict(found.refused)}
            for which in (("train",) if held_out is None else ("train", "calibration", "test"))
            for found in (store.population(which),)
        },
        "training_volumes": store.training.volumes,
        "spent": spent,
        "rows": [],
        "training": [],
        "targets": config["imaging"]["targets"],
        "provenance": {
            **provenance(),
            "config_hash": config_hash,
            "mesh_hash": "none",
            "seed": config["seed"],
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    }
    if held_out is not None and accuracy is not None:
        record |= _tested(config, store, held_out, *accuracy)
    record["measures"] = _measures(record)
    return record


def _tested(
    config: Values,
    store: ImagingStore,
    held_out: HeldOut,
    accuracy: DetectionAccuracy,
    correlogram: Correlogram,
) -> dict[str, Any]:
    least = float(config["imaging"]["detection"]["min_confidence"])
    wrong = float(config["imaging"]["held_out"]["wrong_mm"])
    own = held_out.volumes[store.training.volumes]
    sequences = {kind: [row for row, _ in held_out.sequences[kind]] for kind in SEQUENCES}
    return {
        "rows": [table_row(row, least) for row in own if row["kind"] in VOLUMES],
        "training": learning_rows(held_out.volumes),
        "confidence": _confidences(own, sequences, least, wrong),
        "sequences": [
            _sequence_row(row, least, wrong) for kind in SETTING for row in sequences[kind]
        ],
        "accuracy": {
            "std_mm": [round(float(v), 4) for v in accuracy.std_mm],
            "median_std_mm": float(np.median(accuracy.std_mm)),
            "correlation_length_mm": accuracy.correlation_length_mm,
            "sequences": len(accuracy.samples),
            "left_out": len(sequences["calibration"]) - len(accuracy.samples),
            "mean_error_mm": float(np.linalg.norm(accuracy.samples.mean(axis=0), axis=2).mean()),
            "correlogram": {
                key: [round(float(v), 4) for v in values]
                for key, values in asdict(correlogram).items()
            },
            "within_95": [
                row
                for kind, setting in SETTING.items()
                for row in _coverage(held_out.found(kind, least), kind, setting, accuracy)
            ],
        },
        "volumes": {str(size): rows for size, rows in held_out.volumes.items()},
        "sequence_frames": sequences,
    }


def table_row(row: Row, min_confidence: float) -> dict[str, Any]:
    """What a table of volumes needs of one; little where the valve is not believed in."""
    found = row["confidence"] >= min_confidence
    errors = row["errors"]
    return {
        "setting": row["kind"],
        "valve": row["valve"],
        "frame": row["frame"],
        "confidence": row["confidence"],
        "surface_mm": errors["surface"] if found else None,
        "point_mm": errors["points"] if found else None,
        "tips_mm": errors["tips"] if found else None,
        "annulus_area_error_percent": _area_error(row) if found else None,
        "ap_error_mm": _ap_error(row) if found else None,
        "state_right": _state_right(row) if found else None,
        "seconds": row["cpu_s"],
    }


def learning_rows(volumes: Mapping[int, Sequence[Row]]) -> list[dict[str, Any]]:
    """Errors of every stage by the number of training volumes, on the same held-out volumes.

    Parameters
    ----------
    volumes : mapping
        Volumes trained on -> rows of :func:`experiments.studies.imaging.trials.try_volume`.
    """
    common = set.intersection(
        *({(row["kind"], row["number"]) for row in rows} for rows in volumes.values())
    )
    out = []
    for size, rows in sorted(volumes.items()):
        for setting in VOLUMES:
            own = [r for r in rows if r["kind"] == setting and (setting, r["number"]) in common]
            for stage, unit, name in LEARNING if own else ():
                values = [{**row["errors"], **row["errors"]["stages"]}[name] for row in own]
                out.append(
                    {
                        "stage": stage,
                        "training_volumes": size,
                        "setting": setting,
                        "median": float(np.median(values)),
                        "p90": float(np.quantile(values, 0.9)),
                        "unit": unit,
                        "volumes": len(own),
                    }
                )
    return out


def _area_error(row: Row) -> float | None:
    """Percent, with sign."""
    true, found = row["true"]["annulus_area_mm2"], row["found"]["annulus_area_mm2"]
    return None if None in (true, found) else 100.0 * (found - true) / true


def _ap_error(row: Row) -> float | None:
    """mm, with sign."""
    true, found = row["true"]["ap_diameter_mm"], row["found"]["ap_diameter_mm"]
    return None if None in (true, found) else found - true


def _state_right(row: Row) -> bool | None:
    """Whether an open orifice is found open and a closed one closed."""
    true, found = row["true"]["is_open"], row["found"]["is_open"]
    return None if None in (true, found) else bool(true == found)


def _confidences(
    volumes: Sequence[Row], sequences: Mapping[str, Sequence[Row]], least: float, wrong_mm: float
) -> dict[str, Any]:
    """Confidence of every volume and how far it is off, by kind; over time, of its best frame."""
    values: dict[str, list[float]] = {}
    off: dict[str, list[float | None]] = {}
    for kind in (*VOLUMES, *WITHOUT_VALVE):
        rows = [row for row in volumes if row["kind"] == kind]
        values[kind] = [float(row["confidence"]) for row in rows]
        off[kind] = [row["errors"]["points"] if "errors" in row else None for row in rows]
    for kind in SEQUENCES:
        values[kind] = [max(f["confidence"] for f in row["frames"]) for row in sequences[kind]]
        off[kind] = [_mean([f["points"] for f in row["frames"]]) for row in sequences[kind]]
    right: list[float] = []
    other: list[float] = []
    told = []
    for kind, own in values.items():
        is_right = [distance is not None and distance < wrong_mm for distance in off[kind]]
        right += [v for v, good in zip(own, is_right, strict=True) if good]
        other += [v for v, good in zip(own, is_right, strict=True) if not good]
        if own:
            called = [v >= least for v in own]
            told.append(
                {
                    "kind": kind,
                    "volumes": len(own),
                    "lowest": min(own),
                    "median": float(np.median(own)),
                    "highest": max(own),
                    "called a valve [%]": 100.0 * _mean(called),
                    "wrongly called so [%]": 100.0
                    * _mean([c and not good for c, good in zip(called, is_right, strict=True)]),
                }
            )
    return {
        "least_confidence": least,
        "wrong_mm": wrong_mm,
        "rows": told,
        "values": values,
        "off_mm": off,
        "highest_without_valve": max(v for kind in WITHOUT_VALVE for v in values[kind]),
        "highest_wrong": max(other),
        "lowest_right": min(right) if right else None,
        "best_threshold": _threshold(np.array(right), np.array(other)) if right else None,
    }


def _threshold(with_valve: FloatArray, without: FloatArray) -> float:
    """The threshold that tells both kinds apart best, of equally good ones the middle one."""
    edges = np.unique(np.concatenate([with_valve, without]))
    tried = np.concatenate([edges[:1] - 1e-3, 0.5 * (edges[1:] + edges[:-1]), edges[-1:] + 1e-3])
    right = [(with_valve >= t).mean() + (without < t).mean() for t in tried]
    best = tried[np.isclose(right, max(right))]
    return float(best[len(best) // 2])


def _sequence_row(row: Row, least: float, wrong: float) -> dict[str, Any]:
    frames = row["frames"]
    area = [v for frame in frames if (v := _area_error(frame)) is not None]
    ap = [v for frame in frames if (v := _ap_error(frame)) is not None]
    state = [v for frame in frames if (v := _state_right(frame)) is not None]
    confidence = max(frame["confidence"] for frame in frames)
    points = _mean([frame["points"] for frame in frames])
    return {
        "setting": SETTING[row["kind"]],
        "valve": row["valve"],
        "frames": len(frames),
        "confidence": confidence,
        "found": bool(confidence >= least),
        "wrong": bool(confidence >= least and points >= wrong),
        **{
            f"{name}_mm": _mean([f[name] for f in frames]) for name in ("surface", "points", "tips")
        },
        "surface_open_mm": frames[0]["surface"],
        "surface_closed_mm": frames[row["closed"]]["surface"],
        "annulus_area_error_percent": _mean(np.abs(area)) if area else None,
        "ap_error_mm": _mean(np.abs(ap)) if ap else None,
        "state_right_percent": 100.0 * _mean(state) if state else None,
        "seconds": row["cpu_s"],
    }


def _coverage(
    held_out: HeldOut, kind: str, setting: str, accuracy: DetectionAccuracy
) -> list[dict[str, Any]]:
    """How many coordinates lie within 1.96 of the standard deviations told, wrong ones and all."""
    if not held_out.sequences[kind]:
        return []
    errors, mean = held_out.stacked(kind, "errors"), accuracy.samples.mean(axis=0)
    out = []
    for k, frame in enumerate(("open", "closed")):
        own, about = errors[:, k : k + 1], mean[k : k + 1]
        out.append(
            {
                "setting": setting,
                "frame": frame,
                "sequences": len(errors),
                "share": share_within(own, accuracy.std_mm),
                "share_about_mean": share_within(own, accuracy.std_mm, about),
                "rms_mm": float(np.sqrt((own**2).mean())),
                "told_rms_mm": float(np.sqrt((accuracy.std_mm**2).mean())),
            }
        )
    return out


def _mean(values: Any) -> float:
    return float(np.mean(values))


def _spent(config: Values, store: ImagingStore) -> dict[str, Any]:
    """CPU and wall-clock seconds of every part; None where it was not measured."""
    valves = store.population("train").valves
    volumes = store.samples(valves, store.training.volumes)
    parts: dict[str, Spent] = {
        "valves": store.population_spent("train"),
        "volumes": Spent(sum(one.cpu_s for one in volumes), None),
        "draft": store.draft_spent(),
        "trees": store.model_spent(store.training.volumes),
    }
    cpu = [spent.cpu_s for spent in parts.values()]
    found: dict[str, Any] = {name: asdict(spent) for name, spent in parts.items()}
    found["training"] = {"cpu_s": None if None in cpu else sum(v for v in cpu if v is not None)}
    if config["imaging"]["evaluate"]:
        for size in config["imaging"]["curve"]:
            found[f"trees of {size} volumes"] = asdict(store.model_spent(size))
        for which in ("calibration", "test"):
            found[f"valves of {which}"] = asdict(store.population_spent(which))
    return found


def _measures(record: Row) -> dict[str, float]:
    """Numbers that runs are compared by."""
    found: dict[str, float] = {}
    for setting in VOLUMES:
        own = [row for row in record["rows"] if row["setting"] == setting]
        surface = [row["surface_mm"] for row in own if row["surface_mm"] is not None]
        if own:
            name = setting.replace(" ", "_")
            found[f"found.{name}"] = len(surface) / len(own)
            found |= {f"surface_mm.{name}": float(np.median(surface))} if surface else {}
    if "accuracy" in record:
        found["std_mm"] = record["accuracy"]["median_std_mm"]
        found["correlation_length_mm"] = record["accuracy"]["correlation_length_mm"]
    cpu = record["spent"]["training"]["cpu_s"]
    return found | ({} if cpu is None else {"training_cpu_s": cpu})
