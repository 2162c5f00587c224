"""What a run writes down: ``result.json`` and the fields of its figures."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import MvestError
from mvest.files import write_atomically
from mvest.observation.vertices import Observation
from mvest.problem.estimate import StudyResult
from mvest.provenance import provenance
from mvest.reporting.expectation import confounded_record
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface, Valve
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.measurements import measure_closure

__all__ = ["make_record", "measure_frames", "repeat_entry", "write_fields"]

SCHEMA = 1
"""Version of the layout of ``result.json``."""

Values = Mapping[str, Any]


def make_record(
    result: StudyResult,
    config: Values,
    *,
    config_hash: str,
    meshes: Mapping[str, Any],
    closure: Mapping[str, Any] | None,
    truth_values: FloatArray | None,
    started: float,
) -> dict[str, Any]:
    """Plain data of a finished run, failed or not.

    Values that do not exist are None. Lists of parameters are in the order of ``parameters``;
    relative errors are signed parts of the truth.
    """
    filtered = result.filtered
    return {
        "schema": SCHEMA,
        "experiment": config["name"],
        "title": config["title"],
        "row": config["row"],
        "table": config["table"],
        "paper": config["paper"],
        "status": "converged" if result.converged else "failed",
        "reason": result.reason,
        "detail": result.detail,
        "parameters": list(result.parameters),
        "truth": _list(truth_values),
        "initial": list(config["filter"]["initial"]),
        "estimate": _list(result.estimate),
        "std": _list(result.std),
        "relative_error": _list(result.relative_error),
        "moduli": [
            {
                "region": m.region,
                "name": m.name,
                "truth": m.truth,
                "estimate": m.estimate,
                "std": m.std,
                "relative_error": m.relative_error,
            }
            for m in result.moduli
        ],
        "moduli_error_percent": _moduli_error(result),
        "distance_mm": _spread(result.distance),
        "distance_to_truth_mm": _spread(result.distance_to_truth),
        "closure": None if closure is None else dict(closure),
        "iterations": 0 if filtered is None else filtered.iterations,
        "forward_solves": 0 if filtered is None else filtered.forward_solves,
        "seconds": result.seconds,
        "seconds_total": time.time() - started,
        "iterates": None if filtered is None else _list(filtered.iterates),
        "iterate_std": None if filtered is None else _list(filtered.iterate_std),
        "innovation": _innovation(result),
        "identifiability": _identifiability(result),
        "mesh": dict(meshes),
        "model": {
            "element": config["mechanics"]["element"],
            "cells": [config["mesh"][key] for key in ("columns", "rows", "layers")],
            "source": config["mesh"]["source"],
            "filter": config["filter"]["mode"],
            "noise_mm": config["observation"]["noise_mm"],
        },
        "provenance": {
            **provenance(),
            "config_hash": config_hash,
            "mesh_hash": meshes["sha256"],
            "seed": config["seed"],
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    }


def repeat_entry(seed: int, result: StudyResult) -> dict[str, Any]:
    """Plain data of the estimate from one seed; lists are in the order of the parameters."""
    filtered = result.filtered
    innovation, bound = _innovation(result), _identifiability(result)
    return {
        "seed": seed,
        "status": "converged" if result.converged else "failed",
        "reason": result.reason,
        "detail": result.detail,
        "estimate": _list(result.estimate),
        "std": _list(result.std),
        "relative_error": _list(result.relative_error),
        "bound": None if bound is None else bound["cramer_rao_std"],
        "distance_mm": _spread(result.distance),
        "distance_to_truth_mm": _spread(result.distance_to_truth),
        "nis": None if innovation is None else innovation["nis"],
        "nis_band": None if innovation is None else innovation["nis_band"],
        "iterations": None if filtered is None else filtered.iterations,
        "forward_solves": None if filtered is None else filtered.forward_solves,
        "iterates": [] if filtered is None else _list(filtered.iterates),
        "iterate_std": [] if filtered is None else _list(filtered.iterate_std),
        "seconds": result.seconds,
    }


def measure_frames(valve: Valve, result: StudyResult, contact_distance: float) -> dict[str, Any]:
    """Orifice, passing ball, coaptation and intersections of each fitted frame.

    Parameters
    ----------
    valve : Valve
        The observed surface; its first two regions face each other.
    result : StudyResult
        With fitted frames.
    contact_distance : float
        mm between midsurfaces, up to which they count as touching.

    Returns
    -------
    dict
        Frame -> measurements in mm and mm², or the reason why they could not be taken.
    """
    assert result.observation is not None
    assert result.fitted is not None
    surface = valve.surface
    first = np.unique(surface.triangles[surface.region == 0])
    measured: dict[str, Any] = {}
    for frame, points in zip(result.observation.frames, result.fitted, strict=True):
        annulus = points[valve.annulus]
        anterior = points[np.intersect1d(valve.annulus, first)].mean(axis=0)
        try:
            plane = annulus_plane(annulus, valve.papillary_tips.mean(axis=0), anterior)
            found = measure_closure(
                points,
                surface.triangles,
                surface.region,
                surface.thickness,
                annulus,
                plane,
                contact_distance,
            )
        except MvestError as error:
            # An estimate is not lost because the valve's shape defies a measurement.
            measured[frame] = {"reason": str(error)}
        else:
            measured[frame] = asdict(found)
    return measured


def write_fields(path: Path, surface: LeafletSurface, result: StudyResult) -> None:
    """Write the observed and the fitted frames as compressed arrays, whole or not at all.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    assert isinstance(result.observation, Observation)
    assert result.fitted is not None
    arrays: dict[str, Any] = {
        "triangles": surface.triangles.astype(np.int32),
        "region": surface.region.astype(np.int8),
        "rest": surface.vertices.astype(np.float32),
        "observed": result.observation.positions.astype(np.float32),
        "fitted": result.fitted.astype(np.float32),
        "distance": np.asarray(result.distance, dtype=np.float64),
    }
    write_atomically(path, partial(np.savez_compressed, **arrays))


def _list(values: FloatArray | None) -> list[Any] | None:
    return None if values is None else np.asarray(values).tolist()


def _spread(values: FloatArray | None) -> dict[str, float] | None:
    if values is None:
        return None
    # A vertex that is not seen has no distance.
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    return {"mean": float(values.mean()), "std": float(values.std()), "max": float(values.max())}


def _moduli_error(result: StudyResult) -> dict[str, float] | None:
    errors = [m.relative_error for m in result.moduli if m.relative_error is not None]
    return _spread(100.0 * np.abs(np.array(errors))) if errors else None


def _innovation(result: StudyResult) -> dict[str, Any] | None:
    summary = None if result.filtered is None else result.filtered.innovation
    if summary is None:
        return None
    return {
        "size": summary.size,
        "rms": summary.rms,
        "max_abs": summary.max_abs,
        "nis": summary.nis,
        "nis_band": list(summary.nis_band),
    }


def _identifiability(result: StudyResult) -> dict[str, Any] | None:
    found = result.identifiability
    if found is None:
        return None
    bound = [float(v) if np.isfinite(v) else None for v in found.std]
    condition = found.condition_number
    return {
        "cramer_rao_std": bound,
        "condition_number": condition if np.isfinite(condition) else None,
        "flat": list(found.flat()),
        "confounded": confounded_record(found),
    }
