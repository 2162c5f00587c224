"""Samples of an estimate, and what is said of a number that was computed at each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.estimate import Estimate
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True)
class SampleSummary:
    """Mean, standard deviation and central 95 % interval of a sampled number.

    Attributes
    ----------
    mean, std : float
        NaN where there are too few samples.
    low, high : float
        2.5 and 97.5 % quantiles, unbiased for the median (Hyndman and Fan 1996, Am. Stat. 50:361,
        type 8); with fewer than 40 samples they lie close to the extremes.
    count : int
        Samples that gave a number.
    """

    mean: float
    std: float
    low: float
    high: float
    count: int


def posterior_samples(estimate: Estimate, count: int, seed: int) -> FloatArray:
    """Parameter vectors ``(count, p)`` that are spread as the posterior is.

    A scrambled Sobol sequence (Owen 1998, J. Complexity 14:466) taken through the normal
    distribution in filter coordinates, so that parameters estimated by their logarithm stay
    positive.

    Parameters
    ----------
    estimate : Estimate
        Converged.
    count : int
        A power of two balances the sequence.
    seed : int

    Raises
    ------
    InputError
        If the estimate has not converged or the count is not a power of two.
    """
    if not estimate.converged:
        raise InputError(f"no samples of an estimate that is none: {estimate.reason.value}")
    if count < 2 or count & (count - 1):
        raise InputError(f"samples = {count}, expected a power of two > 1")
    posterior = estimate.transformed
    points = scipy.stats.qmc.Sobol(posterior.size, scramble=True, seed=seed).random(count)
    z = posterior.mean + scipy.special.ndtri(points) @ posterior.factor.T
    return np.array([estimate.transform.inverse(row) for row in z])


def summary_of(values: Sequence[float]) -> SampleSummary:
    """What samples say of a number; those that are NaN gave none."""
    known = np.array([v for v in values if np.isfinite(v)])
    if len(known) < 2:
        mean = float(known[0]) if len(known) else float("nan")
        return SampleSummary(mean, float("nan"), float("nan"), float("nan"), len(known))
    low, high = np.quantile(known, [0.025, 0.975], method="median_unbiased")
    return SampleSummary(
        float(known.mean()), float(known.std(ddof=1)), float(low), float(high), len(known)
    )
