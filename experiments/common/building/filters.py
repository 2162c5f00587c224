"""The configured filter, its coordinates and its prior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.common.schema import build
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.estimate import Filter
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.extended import ExtendedFilter
from mvest.estimation.filters.importance import ImportanceFilter
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.monte_carlo import MonteCarloFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.filters.unscented import UnscentedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.transform import Identity, Log, Transform
from mvest.mechanics.parameters import is_positive
from mvest.typing import FloatArray

__all__ = ["as_numbers", "build_filter", "filter_of", "require_one_each"]

Values = Mapping[str, Any]


MODES = ("paper", "extended", "iterated", "unscented", "ensemble", "monte_carlo", "importance")
"""Filters that a configuration can name."""


def build_filter(
    settings: Values, parameters: tuple[str, ...], *, positive: bool = False
) -> tuple[Filter, Transform, Gaussian]:
    """The filter, its coordinates, and the prior of the parameters.

    Those of our mechanics are known to be positive or not; those of another model are ``positive``.
    """
    mean = np.array(settings["initial"], dtype=float)
    require_one_each("filter.initial", mean, parameters)
    prior = _gaussian("filter.P0", mean, settings["P0"])
    transforms: dict[str, Transform] = {
        "identity": Identity(),
        "log": Log(None if positive else tuple(map(is_positive, parameters))),
    }
    if settings["transform"] not in transforms:
        raise ConfigurationError(
            f"filter.transform = {settings['transform']!r}, expected identity or log"
        )
    transform = transforms[settings["transform"]]
    transform.forward(mean)
    return filter_of(settings, mean), transform, prior


def filter_of(settings: Values, mean: FloatArray) -> Filter:
    """The filter of the configured mode, for parameters with a prior mean ``(p,)``."""
    tolerance, most = settings["tolerance"], settings["max_iterations"]
    check = settings.get("check_runs", 0)
    Q = _gaussian("filter.Q", mean, settings["Q"]).covariance
    match settings["mode"]:
        case "paper":
            return PaperFilter(Q, tolerance, most, check_runs=check)
        case "extended":
            return ExtendedFilter(check_runs=check)
        case "iterated":
            return IteratedFilter(tolerance, max_iterations=most, check_runs=check)
        case "unscented":
            return UnscentedFilter(tolerance, most, settings["spread"], check_runs=check)
        case "ensemble":
            return build(EnsembleFilter, settings["ensemble"])
        case "monte_carlo":
            return build(MonteCarloFilter, settings["monte_carlo"])
        case "importance":
            return ImportanceFilter()
    raise ConfigurationError(
        f"filter.mode = {settings['mode']!r}, expected one of {', '.join(MODES)}"
    )


def require_one_each(name: str, values: FloatArray, parameters: tuple[str, ...]) -> None:
    """Refuse a setting that has not one value for each parameter."""
    if values.shape != (len(parameters),):
        raise ConfigurationError(
            f"{name} has {values.size} values; expected one for each of {', '.join(parameters)}"
        )


def _gaussian(name: str, mean: FloatArray, variance: Any) -> Gaussian:
    """Prior with one variance, one for each parameter, or a full covariance."""
    numbers = as_numbers(name, variance)
    try:
        return Gaussian.from_variance(mean, numbers)
    except InputError as error:
        raise ConfigurationError(f"{name} = {variance}: {error}") from error


def as_numbers(name: str, value: Any) -> float | FloatArray:
    """A setting that is a number, or an array of them."""
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} = {value!r}, expected a number or numbers") from None
    return float(numbers) if numbers.ndim == 0 else numbers
