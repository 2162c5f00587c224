"""What a group of runs says: bias, root mean square error against its bound, coverage.

Only converged runs enter; how many failed is always counted beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest, norm

from experiments.sweeps.rows import Run

__all__ = [
    "BASIN_PERCENT",
    "BOUND_FACTOR",
    "COVERAGE_RANGE",
    "LEVELS",
    "Coverage",
    "EstimateAccuracy",
    "accuracy",
    "converged",
    "coverage",
    "grouped",
    "in_basin",
    "spread_of",
    "verdict",
]

BASIN_PERCENT = 0.1
"""A start belongs to the basin of convergence if every parameter ends within this of the truth."""

BOUND_FACTOR = 1.5
"""A root mean square error up to this many Cramér–Rao bounds counts as near the bound."""

COVERAGE_RANGE = (0.90, 0.98)
"""Share of runs whose nominal 95 % interval may contain the truth."""

LEVELS = (0.50, 0.80, 0.95)
"""Nominal levels at which intervals are checked."""


@dataclass(frozen=True, slots=True)
class EstimateAccuracy:
    """Errors of one parameter over a group of runs; NaN where there is nothing to take it from.

    Attributes
    ----------
    n, failed : int
        Converged and failed runs.
    mean, spread : float
        Mean and standard deviation (n - 1) of the estimates, in the parameter's unit.
    reported : float
        Mean of the standard deviations that the filter reports.
    bias, rmse, bound : float
        Of estimate minus truth, and the mean Cramér–Rao standard deviation; in the parameter's
        unit.
    bias_percent, rmse_percent, worst_percent : float
        The same in percent of the truth, and the largest error without sign.
    ratio, ratio_std : float
        ``rmse / bound`` and its standard deviation from finitely many normal errors,
        ``ratio / sqrt(2 n)``.
    """

    n: int
    failed: int
    mean: float
    spread: float
    reported: float
    bias: float
    rmse: float
    bound: float
    bias_percent: float
    rmse_percent: float
    worst_percent: float
    ratio: float
    ratio_std: float


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often an interval contains the truth, with Wilson's 95 % interval of that share."""

    inside: int
    n: int
    share: float
    low: float
    high: float


def grouped(runs: Sequence[Run], names: Sequence[str]) -> dict[tuple[Any, ...], list[Run]]:
    """Runs that agree in the named factors, groups in order of first appearance."""
    groups: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        # Every run has a filter, also where it is not varied.
        values = (run.mode if name == "filter" else run.factors.get(name) for name in names)
        groups.setdefault(tuple(values), []).append(run)
    return groups


def converged(runs: Sequence[Run]) -> list[Run]:
    """Those that converged to finite estimates."""
    return [run for run in runs if run.converged and bool(np.isfinite(run.estimate).all())]


def in_basin(run: Run) -> bool:
    """Whether a run converged with every parameter within `BASIN_PERCENT` of the truth."""
    return run.converged and run.largest_error <= BASIN_PERCENT


def accuracy(runs: Sequence[Run], k: int) -> EstimateAccuracy:
    """Errors of parameter k over all runs of a group."""
    good = converged(runs)
    n = len(good)
    estimate = np.array([run.estimate[k] for run in good])
    error = estimate - np.array([run.truth[k] for run in good])
    percent = np.array([run.error[k] for run in good])
    bound = _mean(np.array([run.bound[k] for run in good]))
    rmse = float(np.sqrt(_mean(error**2)))
    ratio = rmse / bound if bound > 0 else np.nan
    return EstimateAccuracy(
        n=n,
        failed=len(runs) - n,
        mean=_mean(estimate),
        spread=float(np.std(estimate, ddof=1)) if n > 1 else np.nan,
        reported=_mean(np.array([run.std[k] for run in good])),
        bias=_mean(error),
        rmse=rmse,
        bound=bound,
        bias_percent=_mean(percent),
        rmse_percent=float(np.sqrt(_mean(percent**2))),
        worst_percent=float(np.max(np.abs(percent))) if n else np.nan,
        ratio=ratio,
        ratio_std=ratio / np.sqrt(2 * n) if n else np.nan,
    )


def coverage(runs: Sequence[Run], k: int, level: float = 0.95) -> Coverage:
    """Share of converged runs with the truth in ``estimate ± z std``, normal quantile z.

    Runs without a standard deviation or a truth are left out of ``n``.
    """
    z = float(norm.ppf(0.5 * (1 + level)))
    usable = [
        run
        for run in converged(runs)
        if np.isfinite([run.std[k], run.truth[k], run.estimate[k]]).all()
    ]
    n = len(usable)
    inside = sum(bool(abs(run.estimate[k] - run.truth[k]) <= z * run.std[k]) for run in usable)
    if not n:
        return Coverage(0, 0, np.nan, np.nan, np.nan)
    interval = binomtest(inside, n).proportion_ci(confidence_level=0.95, method="wilson")
    return Coverage(inside, n, inside / n, float(interval.low), float(interval.high))


def verdict(found: Coverage) -> str:
    """Whether the coverage is within `COVERAGE_RANGE`: yes, no, or too few runs to tell."""
    low, high = COVERAGE_RANGE
    if not found.n:
        return ""
    if low <= found.share <= high:
        return "yes"
    return "no" if found.high < low or found.low > high else "too few runs to tell"


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def spread_of(values: Sequence[float | None]) -> Mapping[str, float]:
    """Mean, median and largest of the values that exist."""
    found = np.array([value for value in values if value is not None], dtype=np.float64)
    if not len(found):
        return {"mean": np.nan, "median": np.nan, "max": np.nan}
    return {
        "mean": float(found.mean()),
        "median": float(np.median(found)),
        "max": float(found.max()),
    }
