"""The studies of the forward model alone: how the valve closes, and whether its state is one."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.build import build_mesh, mechanics_of, template_of
from mvest.closure import measure_steps
from mvest.gate import MAX_LIMIT, MEAN_LIMIT, SLOPE_LIMIT, GateCase, GateRow, run_gate
from mvest.model import ClosureModel
from mvest.provenance import provenance
from mvest.typing import FloatArray
from mvest.valve.embedding import embed
from mvest.valve.surfaces import thicken

__all__ = ["forward_record", "model_of", "run_closure_study", "run_gate_study"]

Values = Mapping[str, Any]
Outcome = tuple[dict[str, Any], list[Path]]


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


def run_gate_study(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Close the valve under every variation of the gate."""

    def tell(row: GateRow) -> None:
        print(
            f"{row.case}: mean {row.mean_mm:.3g} mm, max {row.max_mm:.3g} mm, "
            f"{row.seconds:.0f} s, {row.reason}",
            file=sys.stderr,
            flush=True,
        )

    values = np.array(config["truth"]["values"], dtype=float)
    reference = model_of(config, GateCase("reference"))
    report = run_gate(lambda case: model_of(config, case), values, on_case=tell)
    rows = [_plain(asdict(row)) for row in report.rows]
    record = forward_record(config, config_hash, reference, values, started, len(rows))
    record |= {
        "passed": report.passed,
        "rows": rows,
        "slopes": {str(step): value for step, value in report.slopes.items()},
        "limits": {"mean_mm": MEAN_LIMIT, "max_mm": MAX_LIMIT, "slope": SLOPE_LIMIT},
    }
    if not rows[0]["passed"]:
        record |= {"status": "failed", "reason": rows[0]["reason"]}
    return record, []


def run_closure_study(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Close the valve once and measure every stored step."""
    from mvest.reporting.closure import closure_figure
    from mvest.reporting.figures import save_figure

    values = np.array(config["truth"]["values"], dtype=float)
    model = model_of(config, GateCase("reference"))
    result = model.close(values, sensitivities=False, every_frame=True)
    thickness = float(model.valve.surface.thickness.mean())
    distance = (
        0.5
        * thickness
        * (model.settings.contact.reference_distance + model.settings.contact.activation_distance)
    )
    observed = config["observation"]
    normals = _normals(config, observed["columns"], observed["rows"])
    steps = measure_steps(model, result, distance, normals)
    record = forward_record(config, config_hash, model, values, started, 1)
    record |= {"rows": [_plain(asdict(s)) for s in steps], "contact_distance_mm": distance}
    if not result.simulation.converged:
        record |= {"status": "failed", "reason": result.simulation.reason.value}
    surface = thicken(model.valve.surface, normals)
    faces = embed(model.mesh, surface.vertices)
    frames = np.stack([faces(x) for x in result.simulation.frames])
    fields = folder / "fields.npz"
    np.savez_compressed(
        fields,
        frames=frames.astype(np.float32),
        times=result.simulation.times,
        triangles=surface.triangles.astype(np.int32),
        region=surface.region.astype(np.int8),
    )
    return record, save_figure(folder / "closure", closure_figure(record, fields), record)


def _normals(config: Values, columns: int, rows: int) -> FloatArray:
    j, i = (v.ravel() for v in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    return template_of(config).normal(360.0 * i / columns, j / (rows - 1))


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """NaN, which JSON lacks, as None."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


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
