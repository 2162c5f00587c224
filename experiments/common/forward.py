"""What the studies of the forward model share: what their records say."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from experiments.common.record import Mesh, Outcome
from mvest.closure.model import ClosureModel
from mvest.provenance import provenance
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

__all__ = ["forward_record", "outcome_of"]

Values = Mapping[str, Any]
F = TypeVar("F")


def outcome_of(
    findings: F, mesh: SolidMesh, forward_solves: int, failures: Iterable[str] = ()
) -> Outcome[F]:
    """The outcome of a study, which failed for the first of the reasons given, if any."""
    reason = next(iter(failures), None)
    return Outcome(
        findings=findings,
        status="converged" if reason is None else "failed",
        reason="completed" if reason is None else reason,
        mesh=Mesh(mesh.sha256, len(mesh.nodes)),
        forward_solves=forward_solves,
    )


def forward_record(
    config: Values,
    config_hash: str,
    model: ClosureModel,
    values: FloatArray,
    started: float,
    solves: int,
) -> dict[str, Any]:
    """What every record of a study says that estimates nothing in the usual way."""
    return {
        "schema": 1,
        "experiment": config["name"],
        "title": config["title"],
        "row": config["row"],
        "table": config["table"],
        "status": "converged",
        "reason": "completed",
        "detail": "",
        "parameters": list(config["parameters"]),
        "truth": values.tolist(),
        "estimate": None,
        "std": None,
        "relative_error": None,
        "iterates": None,
        "iterate_std": None,
        "distance_mm": None,
        "distance_to_truth_mm": None,
        "moduli_error_percent": None,
        "iterations": 0,
        "forward_solves": solves,
        "seconds": time.time() - started,
        "seconds_total": time.time() - started,
        "mesh": {"sha256": model.mesh.sha256, "nodes": len(model.mesh.nodes)},
        "model": {
            "element": config["mechanics"]["element"],
            "cells": [config["mesh"][key] for key in ("columns", "rows", "layers")],
        },
        "provenance": {
            **provenance(),
            "config_hash": config_hash,
            "mesh_hash": model.mesh.sha256,
            "seed": config["seed"],
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    }
