"""Findings about chordae by family; errors are parts of the truth, deviations of logarithms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from experiments.common.findings import Rows, Vector, rows, vector
from experiments.common.record import Status
from experiments.common.whole_cycle import Bound
from mvest.estimation.estimate import Estimate
from mvest.estimation.information.consistency import nees
from mvest.typing import FloatArray

__all__ = ["Findings", "Fit"]


@dataclass(frozen=True, slots=True)
class Fit:
    """One estimate of p parameters.

    Attributes
    ----------
    frames : str
        What it is from: "open and closed" or "whole cycle".
    seed : int
        Of the noise, from 0 on.
    status : {"converged", "failed"}
    reason : str
    estimate : (p,)
        In units of the parameters.
    error, std : (p,)
    correlation : (p, p)
    nees : float
        Normalised squared error.
    runs : int
        Of the model.
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
    """What follows for p parameters.

    Attributes
    ----------
    truth, start : (p,)
        In units of the parameters.
    prior_std : (p,)
    noise_mm : float
        Standard deviation of a coordinate.
    times : tuple of float
        s, of the frames.
    vertices : int
    results : tuple of Fit
        From open and closed frame, from the whole cycle, and that with further seeds.
    bounds : tuple of Bound
        Of the first two.
    measures : mapping
        What runs are compared by.
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
