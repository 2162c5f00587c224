"""From the result of an estimation to what records say of it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from experiments.common.estimates import (
    Confounded,
    EstimatedModulus,
    Identified,
    Innovation,
    SeedRun,
    Spread,
)
from experiments.common.findings import Vector, finite, rows, vector
from mvest.estimation.estimate import Estimate
from mvest.problem.estimate import StudyResult
from mvest.provenance import provenance
from mvest.reporting.expectation import confounded_record
from mvest.typing import FloatArray

__all__ = [
    "identified_of",
    "innovation_of",
    "make_record",
    "moduli_error",
    "moduli_of",
    "seed_run",
    "spread",
]

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
    run = asdict(seed_run(config["seed"], result))
    innovation, identified = innovation_of(result.filtered), identified_of(result)
    error = moduli_error(result)
    kept = ("status", "reason", "detail", "estimate", "std", "relative_error", "distance_mm",
            "distance_to_truth_mm", "iterates", "iterate_std", "seconds")  # fmt: skip
    return {
        "schema": SCHEMA,
        "experiment": config["name"],
        "title": config["title"],
        "row": config["row"],
        "table": config["table"],
        "paper": config["paper"],
        "parameters": list(result.parameters),
        "truth": _known(truth_values),
        "initial": list(config["filter"]["initial"]),
        **{name: run[name] for name in kept},
        "moduli": [asdict(modulus) for modulus in moduli_of(result)],
        "moduli_error_percent": None if error is None else asdict(error),
        "closure": None if closure is None else dict(closure),
        "iterations": run["iterations"] or 0,
        "forward_solves": run["forward_solves"] or 0,
        "seconds_total": time.time() - started,
        "innovation": None if innovation is None else asdict(innovation),
        "identifiability": None if identified is None else asdict(identified),
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


def seed_run(seed: int, result: StudyResult) -> SeedRun:
    """The estimate from one seed."""
    filtered = result.filtered
    innovation, identified = innovation_of(result.filtered), identified_of(result)
    return SeedRun(
        seed=seed,
        status="converged" if result.converged else "failed",
        reason=result.reason,
        detail=result.detail,
        estimate=_known(result.estimate),
        std=_known(result.std),
        relative_error=_known(result.relative_error),
        bound=None if identified is None else identified.cramer_rao_std,
        distance_mm=spread(result.distance),
        distance_to_truth_mm=spread(result.distance_to_truth),
        nis=None if innovation is None else innovation.nis,
        nis_band=None if innovation is None else innovation.nis_band,
        iterations=None if filtered is None else filtered.iterations,
        forward_solves=None if filtered is None else filtered.forward_solves,
        iterates=None if filtered is None else rows(filtered.iterates),
        iterate_std=None if filtered is None else rows(filtered.iterate_std),
        seconds=result.seconds,
    )


def _known(values: FloatArray | None) -> Vector | None:
    return None if values is None else vector(values)


def spread(values: FloatArray | None) -> Spread | None:
    """Mean, standard deviation and largest of what is finite; None where nothing is."""
    if values is None:
        return None
    # A vertex that is not seen has no distance.
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    return Spread(float(values.mean()), float(values.std()), float(values.max()))


def moduli_of(result: StudyResult) -> tuple[EstimatedModulus, ...]:
    """All moduli that follow from the estimated ones."""
    return tuple(
        EstimatedModulus(m.region, m.name, m.estimate, m.std, m.truth, m.relative_error)
        for m in result.moduli
    )


def moduli_error(result: StudyResult) -> Spread | None:
    """Errors of all moduli without sign, in percent of the truth."""
    errors = [m.relative_error for m in result.moduli if m.relative_error is not None]
    return spread(100.0 * np.abs(np.array(errors)))


def innovation_of(filtered: Estimate | None) -> Innovation | None:
    """What of the observation the first prediction leaves over."""
    summary = None if filtered is None else filtered.innovation
    if summary is None:
        return None
    return Innovation(summary.size, summary.rms, summary.max_abs, summary.nis, summary.nis_band)


def identified_of(result: StudyResult) -> Identified | None:
    """What the data alone could tell."""
    known = result.identifiability
    if known is None:
        return None
    return Identified(
        tuple(map(finite, known.std)),
        finite(known.condition_number),
        tuple(known.flat()),
        tuple(
            Confounded(
                tuple(group["parameters"]),
                tuple(group["changes"]),
                tuple(group["relative"]),
                group["correlation"],
            )
            for group in confounded_record(known)
        ),
    )
