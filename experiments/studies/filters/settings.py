"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from experiments.common.config import FilterConfig
from mvest.estimation.filters.sampler import SamplerSettings

__all__ = ["FilterMethod", "FilterProblem", "FilterStudySettings", "Settings", "SurrogateDesign"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterProblem:
    """One problem on which filters are compared; unknowns are normal in their logarithms."""

    title: str
    about: str = ""
    parameters: tuple[str, ...]
    truth: tuple[float, ...]
    initial: tuple[float, ...]  # prior median
    log_std: tuple[float, ...]  # prior standard deviation of the logarithms
    fixed: dict[str, float] = field(default_factory=dict)  # what is known
    columns: int = 28
    rows: int = 8
    every: int = 1  # of the vertices, every so many is seen, in the closed frame
    noise_mm: float  # of each coordinate


@dataclass
class FilterMethod(FilterConfig):
    """A filter whose prior is that of each problem."""

    initial: list[float] = field(default_factory=list)
    P0: Any = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SurrogateDesign:
    """Runs of the model to which the surrogate for repeats is fitted."""

    surrogate_runs: int = 32
    held_out: int = 8
    reach: float = 3.2  # standard deviations of the prior
    degree: int = 5  # at most
    surrogate_seed: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterStudySettings:
    """All filters on the same problems."""

    problems: dict[str, FilterProblem] = field(default_factory=dict)
    methods: dict[str, FilterMethod] = field(default_factory=dict)
    design: SurrogateDesign = field(default_factory=SurrogateDesign)
    repeats: int = 100  # observations, each of a truth drawn from the prior
    sampler: SamplerSettings = field(default_factory=SamplerSettings)  # of repeats


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    filters: FilterStudySettings
