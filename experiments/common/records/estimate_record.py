"""From the result of an estimation to what records say of it."""

from __future__ import annotations

import numpy as np

from experiments.common.records.estimates import (
    Identified,
    Innovation,
    SeedRun,
    Spread,
)
from experiments.common.records.findings import Vector, finite, rows, vector
from mvest.estimation.estimate import Estimate
from mvest.problem.estimate import StudyResult
from mvest.reporting.expectation import alike
from mvest.reporting.findings import spread
from mvest.typing import FloatArray

__all__ = [
    "identified_of",
    "innovation_of",
    "moduli_error",
    "seed_run",
]


def seed_run(seed: int | None, result: StudyResult) -> SeedRun:
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


def moduli_error(result: StudyResult) -> Spread | None:
    """Errors of all moduli without sign, in percent of the truth."""
    errors = [m.relative_error for m in result.moduli if m.relative_error is not None]
    return spread(100.0 * np.abs(np.array(errors)))


def innovation_of(filtered: Estimate | None) -> Innovation | None:
    """What of the observation the prior leaves over, and what the estimate."""
    summary = None if filtered is None else filtered.innovation
    if summary is None:
        return None
    return Innovation(
        summary.size,
        summary.rms,
        summary.max_abs,
        summary.nis,
        summary.nis_band,
        summary.residual_rms,
    )


def identified_of(result: StudyResult) -> Identified | None:
    """What the data alone could tell."""
    known = result.identifiability
    if known is None:
        return None
    return Identified(
        tuple(map(finite, known.std)),
        finite(known.condition_number),
        tuple(known.flat()),
        alike(known),
    )
