"""Findings of the study of filters: what each makes of the same observations, and what it costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.records.findings import Vector

__all__ = ["Estimated", "Findings", "OwnCheck", "Problem", "Repeats", "SurrogateFit"]


@dataclass(frozen=True, slots=True)
class OwnCheck:
    """What a filter says of its own approximation (`mvest.estimation.check`).

    ``value`` is how far apart the two are that it ``compared``, and ``limit`` how far they may be
    where the intervals mean what they say; ``extra_runs`` of the model were made for it.
    """

    compared: str
    value: float
    limit: float
    extra_runs: int

    @property
    def holds(self) -> bool:
        """Whether the filter believes its own posterior."""
        return self.value <= self.limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimated:
    """What a filter says of unknowns ``(p,)`` from one observation, with the model itself.

    Estimate and the ends of its 95 % interval are in units of the parameters, ``log_mean`` and
    ``log_std`` of their logarithms, and so is the skewness of the draws, None without draws. CPU
    seconds are in all, and of the model. ``check`` is what the filter says of itself.
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
    check: OwnCheck | None = None

    def interval(self, k: int) -> tuple[float, float]:
        """Ends of the interval of one unknown."""
        return self.low[k], self.high[k]


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeats:
    """What a filter says of many observations, by the surrogate; None where it always failed.

    ``coverage (p,)`` is the share of 95 % intervals that hold the truth, where a failed run holds
    nothing, ``log_rms_error (p,)`` is of the logarithms, and ``width_ratio (p,)`` the median width
    of intervals over that of the reference.
    """

    runs: int
    failed: int
    coverage: Vector | None
    log_rms_error: Vector | None
    width_ratio: Vector | None


@dataclass(frozen=True, slots=True)
class SurrogateFit:
    """How far the surrogate is from the model: errors of a coordinate over the held-out runs."""

    runs: int
    held_out: int
    degree: int
    rms_mm: float
    largest_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One problem, and by name what all filters say of it.

    Truth and medians of the prior ``(p,)`` are in units of the parameters, ``log_std (p,)`` is of
    the prior's logarithms, and ``noise_mm`` of a coordinate.
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
    """All problems, and the CPU seconds of all estimates with the model itself."""

    problems: tuple[Problem, ...]
    seconds: float
