"""Records as runs write them, made up."""

import copy
from typing import Any

from experiments.studies.twin.findings import Findings

from experiments.common.records.record import Record, record_from

RECORD: dict[str, Any] = {
    "schema": 1,
    "experiment": "table1",
    "title": "Moduli of a synthetic valve",
    "row": "same model",
    "table": "table1",
    "paper": {
        "table": "Table 1",
        "estimate": [6.02, 2.13],
        "error_percent": [3.37, 1.91],
        "moduli_error_percent": [2.84, 0.67],
        "distance_mm": [0.06, 0.07],
    },
    "status": "converged",
    "reason": "converged: the change of every parameter is below the tolerance",
    "detail": "3 rounds, tolerance 0.0001",
    "parameters": ["E_f.anterior", "E_f.posterior"],
    "truth": [6.23, 2.09],
    "initial": [5.0, 3.0],
    "estimate": [6.2296, 2.0901],
    "std": [0.02, 0.011],
    "relative_error": [-6.4e-5, 4.8e-5],
    "moduli": [],
    "moduli_error_percent": {"mean": 0.0056, "std": 0.0008, "max": 0.0064},
    "distance_mm": {"mean": 0.0004, "std": 0.0003, "max": 0.002},
    "distance_to_truth_mm": {"mean": 0.0004, "std": 0.0003, "max": 0.002},
    "closure": {
        "open": {
            "orifice_area": 310.0,
            "passing_ball_diameter": 16.0,
            "coaptation_length": 0.0,
            "coaptation_area": 0.0,
            "contact_distance": 2.4,
            "intersections": 0,
        },
        "closed": {
            "orifice_area": 1.2,
            "passing_ball_diameter": 0.5,
            "coaptation_length": 6.0,
            "coaptation_area": 229.0,
            "contact_distance": 2.4,
            "intersections": 0,
        },
    },
    "iterations": 3,
    "forward_solves": 4,
    "seconds": 61.2,
    "seconds_total": 80.0,
    "iterates": [[5.0, 3.0], [6.1, 1.8], [6.22, 2.08], [6.2296, 2.0901]],
    "iterate_std": [[0.1, 0.1], [0.03, 0.02], [0.02, 0.011], [0.02, 0.011]],
    "innovation": None,
    "identifiability": None,
    "confirmed_mm": None,
    "seconds_computing": 62.0,
    "truth_store": "miss",
    "mesh": {"sha256": "ab" * 32, "nodes": 1296, "elements": 144, "truth_sha256": "ab" * 32},
    "model": {
        "element": "hex18",
        "cells": [36, 4, 1],
        "source": "structured",
        "filter": "paper",
        "noise_mm": 0.0,
    },
    "provenance": {
        "git": {"sha": "0123456789abcdef" * 2 + "01234567", "dirty": True},
        "versions": {"mvest": "0.1.0"},
        "config_hash": "cd" * 32,
        "mesh_hash": "ab" * 32,
        "seed": 1,
    },
}


OF_A_SEED = ("status", "reason", "detail", "estimate", "std", "relative_error", "distance_mm",
             "distance_to_truth_mm", "iterations", "forward_solves", "seconds", "iterates",
             "iterate_std")  # fmt: skip
"""What an estimate from one seed says."""


def record(**changes: Any) -> dict[str, Any]:
    """A record of its own, with changes."""
    made = {**copy.deepcopy(RECORD), **changes}
    made["repeats"] = [{"seed": 1, **{key: made[key] for key in OF_A_SEED}}]
    return made


def failed_record(**changes: Any) -> dict[str, Any]:
    """The record of a run whose model gave up."""
    nothing = dict.fromkeys(
        (
            "estimate",
            "std",
            "relative_error",
            "moduli_error_percent",
            "distance_mm",
            "iterates",
            "closure",
        )
    )
    return record(
        **nothing,
        status="failed",
        reason="not converged: the model gives no prediction where the filter needs one",
        **changes,
    )


def stored(record: dict[str, Any], study: str = "twin") -> dict[str, Any]:
    """The same as ``result.json`` holds it: what is stamped, and the findings apart."""
    stamped = {
        "schema", "experiment", "title", "row", "table", "status", "reason", "detail", "parameters",
        "factors", "seconds_total", "forward_solves", "model", "mesh", "provenance",
    }  # fmt: skip
    source = {
        "threads": {}, "python": "3.12", "platform": "Linux", "machine": "x86_64", "cpu_count": 2,
        "finished": "2024-01-01T00:00:00Z", **record["provenance"],
    }  # fmt: skip
    return {
        "factors": {},
        **{key: value for key, value in record.items() if key in stamped},
        "study": study,
        "provenance": source,
        "findings": {key: value for key, value in record.items() if key not in stamped},
    }


def twin(data: dict[str, Any]) -> Record[Findings]:
    """The record of a synthetic study."""
    return record_from(stored(data), Findings, "made up")
