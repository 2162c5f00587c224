"""Findings of the study of filters: what each makes of the same observations, and what it costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.findings import Vector

__all__ = ["Estimated", "Findings", "Problem", "Repeats", "SurrogateFit"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimated:
    """What a filter says of p unknowns from one observation, with the model itself.

    Attributes
    ----------
    converged : bool
    reason, detail : str
        Why it ended.
    forward_solves, iterations : int
    seconds, model_seconds : float
        CPU time, in all and of the model.
    estimate : (p,)
        In units of the parameters.
    log_mean, log_std : (p,)
        Of the logarithms.
    low, high : (p,)
        Ends of 95 % intervals.
    skewness : (p,) or None
        Of the draws of the logarithms; None without draws.
    """

    converged: bool
    reason: str
    detail: str
    forward_solves: int
    iterations: int
    seconds: float
    model_seconds: float
    estimate: Vector
    log_mean: Vector
    log_std: Vector
    low: Vector
    high: Vector
    skewness: Vector | None = None

    def interval(self, k: int) -> tuple[float, float]:
        """Ends of the interval of one unknown."""
        return self.low[k], self.high[k]


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeats:
    """What a filter says of many observations, by the surrogate; None where it always failed.

    Attributes
    ----------
    runs, failed : int
    coverage : (p,) or None
        Share of 95 % intervals that hold the truth; a failed run holds nothing.
    log_rms_error : (p,) or None
    width_ratio : (p,) or None
        Median width of intervals over that of the reference.
    """

    runs: int
    failed: int
    coverage: Vector | None
    log_rms_error: Vector | None
    width_ratio: Vector | None


@dataclass(frozen=True, slots=True)
class SurrogateFit:
    """How far the surrogate is from the model.

    Attributes
    ----------
    runs, held_out : int
        To which it was fitted, and further ones.
    degree : int
    rms_mm, largest_mm : float
        Error of a coordinate over the held-out runs.
    """

    runs: int
    held_out: int
    degree: int
    rms_mm: float
    largest_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One problem of p unknowns, and what all filters say of it.

    Attributes
    ----------
    name, title, about : str
    parameters : tuple of str, (p,)
    truth, initial : (p,)
        In units of the parameters; the latter are medians of the prior.
    log_std : (p,)
        Of the prior, of the logarithms.
    noise_mm : float
        Standard deviation of a coordinate.
    observations : int
    surrogate : SurrogateFit
    filters : mapping
        By name.
    repeats : mapping
        By name of the filter.
    """

    name: str
    title: str
    about: str
    parameters: tuple[str, ...]
    truth: Vector
    initial: Vector
    log_std: Vector
    noise_mm: float
    observations: int
    surrogate: SurrogateFit
    filters: Mapping[str, Estimated]
    repeats: Mapping[str, Repeats]


@dataclass(frozen=True, slots=True)
class Findings:
    """What follows for all problems.

    Attributes
    ----------
    problems : tuple of Problem
    seconds : float
        CPU time of all estimates with the model itself.
    """

    problems: tuple[Problem, ...]
    seconds: float
