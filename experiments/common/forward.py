"""What the studies of the forward model share: the configured model, and what its record says."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import build_mesh, mechanics_of, template_of
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import GateCase
from mvest.provenance import provenance
from mvest.typing import FloatArray

__all__ = ["forward_record", "model_of", "without_nan"]

Values = Mapping[str, Any]


def model_of(config: Values, case: GateCase) -> ClosureModel:
    """The configured model with one variation."""
    template = template_of(config)
    settings = mechanics_of(config)
    protocol = replace(settings.protocol, dt=settings.protocol.dt * case.dt)
    distance = settings.contact.activation_distance * case.activation
    settings = replace(
        settings,
        protocol=protocol,
        contact=replace(settings.contact, activation_distance=distance),
    )
    mesh = dict(config["mesh"])
    mesh["columns"] = 2 * round(0.5 * mesh["columns"] * case.mesh)
    mesh["rows"] = round(mesh["rows"] * case.mesh)
    points = config["mechanics"]["contact_points"]
    columns = 2 * round(0.5 * points["columns"] * case.sampling)
    observed = config["observation"]
    return ClosureModel(
        template.valve(observed["columns"], observed["rows"]),
        template.valve(columns, round(points["rows"] * case.sampling)),
        build_mesh(
            template,
            mesh,
            config["mechanics"]["element"],
            Path(config["paths"]["outputs"]) / "meshes",
        ),
        settings,
        tuple(config["parameters"]),
        dict(config["fixed"]),
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


def without_nan(row: dict[str, Any]) -> dict[str, Any]:
    """NaN, which JSON lacks, as None."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}
