"""Findings about chordae by family; errors are parts of the truth, deviations of logarithms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from experiments.common.building.whole_cycle import Bound
from experiments.common.records.findings import Rows, Vector, rows, vector
from experiments.common.records.record import Status
from mvest.estimation.estimate import Estimate
from mvest.estimation.information.consistency import nees
from mvest.typing import FloatArray

__all__ = ["Findings", "Fit"]


@dataclass(frozen=True, slots=True)
class Fit:
    """One estimate of p parameters from open and closed frame, or from the whole cycle.

    The seed is of the noise, from 0 on; the estimate is in units of the parameters, ``correlation
    (p, p)`` and the normalised squared error ``nees`` are in the filter's coordinates.
    """

    frames: str
    seed: int
    status: Status
    reason: str
    estimate: Vector
    error: Vector
    std: Vector
    correlation: Rows
    nees: float
    runs: int

    @classmethod
    def of(cls, frames: str, seed: int, found: Estimate, truth: FloatArray) -> Fit:
        """An estimate beside the truth ``(p,)``."""
        covariance = found.transformed.covariance
        std = np.sqrt(np.diag(covariance))
        # In filter coordinates, where the posterior is nearly normal.
        offset = found.transformed.mean - found.transform.forward(truth)
        return cls(
            frames,
            seed,
            "converged" if found.converged else "failed",
            found.reason.value,
            vector(found.mean),
            vector(found.mean / truth - 1),
            vector(std),
            rows(covariance / np.outer(std, std)),
            nees(offset, covariance),
            found.forward_solves,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p parameters: truth and start in their units, ``times`` in s.

    Results are from open and closed frame, from the whole cycle, and that with further seeds;
    bounds are of the first two. Runs are compared by ``measures``.
    """

    truth: Vector
    start: Vector
    prior_std: Vector
    noise_mm: float
    times: Vector
    vertices: int
    results: tuple[Fit, ...]
    bounds: tuple[Bound, ...]
    measures: Mapping[str, float]
