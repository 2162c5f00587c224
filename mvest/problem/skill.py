"""How good estimates are beside what anyone could say without an estimation.

That is the generic guess, a value of the literature, and the prior alone, which is that value with
the interval that is believed before anything was seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import mean, median
from typing import Any

import numpy as np
from scipy.stats import beta, norm

from mvest.mechanics.parameters import is_positive
from mvest.problem.record import Unknown
from mvest.problem.registration import REGISTRATION

GENERIC, PRIOR = "generic guess", "prior alone"
"""What tables call the two."""

HALF = float(norm.ppf(0.975))
"""Standard deviations from the middle of a 95 % interval to its end."""


def generic_guess(unknown: Unknown) -> Unknown:
    """An unknown as the literature has it: the mean of the prior, without an interval."""
    return _with(unknown, unknown.prior_mean, None, None, None)


def prior_alone(unknown: Unknown) -> Unknown:
    """An unknown as it is believed before anything was seen; see `mvest.estimation.transform`."""
    mean, std = unknown.prior_mean, unknown.prior_std
    if mean is None or std is None:
        return _with(unknown, mean, std, None, None)
    if _is_log(unknown):
        factor = float(np.exp(HALF * std / mean))
        return _with(unknown, mean, std, mean / factor, mean * factor)
    return _with(unknown, mean, std, mean - HALF * std, mean + HALF * std)


def _with(
    unknown: Unknown,
    estimate: float | None,
    std: float | None,
    low: float | None,
    high: float | None,
) -> Unknown:
    values = {"estimate": estimate, "std": std, "low": low, "high": high}
    return unknown.model_copy(update=values)


def skill(unknowns: Sequence[Unknown]) -> dict[str, Any]:
    """Coverage and errors of estimates beside those of the generic guess and of the prior alone.

    Parameters
    ----------
    unknowns : sequence of Unknown
        At least one, of one kind, with their truths; of one valve or of many.

    Returns
    -------
    dict
        ``n`` unknowns, ``estimated`` of them, ``inside`` their 95 % intervals; ``coverage`` (%),
        the share of the intervals that hold the truth, with exact 95 % bounds. Errors (``mean
        error``, ``median error`` of their sizes, of the generic guess for the same and for all) and
        the ``mean width`` of intervals are in ``unit``: relative to the truth (%) for moduli and
        factors, otherwise as the unknown is. ``relative width`` is the median over the estimate,
        ``width over prior`` that of the logarithm's interval over the prior's. None: not known.
    """
    known = [own for own in unknowns if own.estimate is not None]
    judged = [own.inside for own in unknowns if own.inside is not None]
    inside, n = sum(judged), len(judged)
    bounds = share_bounds(inside, n)
    unit = "" if unknowns[0].is_modulus else unknowns[0].unit
    errors = _errors(known, unit)
    sizes = (
        [abs(error) for error in _errors(map(generic_guess, some), unit)]
        for some in (known, unknowns)
    )
    guess, guess_of_all = (median(each) if each else None for each in sizes)
    widths = [
        (own, own.high - own.low) for own in known if own.high is not None and own.low is not None
    ]
    ratios = [
        width / before
        for own in known
        if not unit
        and (width := log_width(own)) is not None
        and (before := log_width(prior_alone(own)))
    ]
    return {
        "n": len(unknowns),
        "estimated": len(known),
        "inside": inside,
        "coverage": 100 * inside / n if n else None,
        "coverage low": 100 * bounds[0] if n else None,
        "coverage high": 100 * bounds[1] if n else None,
        "unit": unit or "%",
        "mean error": mean(errors) if errors else None,
        "median error": median(map(abs, errors)) if errors else None,
        GENERIC: guess,
        f"{GENERIC}, all": guess_of_all,
        "inside prior": sum(prior_alone(own).inside is True for own in unknowns),
        "mean width": mean(width * _scale(own, unit) for own, width in widths) if widths else None,
        "relative width": None
        if unit or not widths
        else median(width / (own.estimate or 1.0) for own, width in widths),
        "width over prior": median(ratios) if ratios else None,
    }


def score(unknown: Unknown) -> float | None:
    """Truth minus estimate in posterior standard deviations, where the posterior is normal."""
    values = (unknown.truth, unknown.estimate, unknown.low, unknown.high)
    if any(value is None for value in values):
        return None
    known = np.array(values, dtype=np.float64)
    truth, estimate, low, high = np.log(known) if _is_log(unknown) else known
    return float(2 * HALF * (truth - estimate) / (high - low))


def log_width(unknown: Unknown) -> float | None:
    """Width of the interval of a modulus' logarithm."""
    if unknown.low is None or unknown.high is None:
        return None
    return float(np.log(unknown.high / unknown.low))


def share_bounds(inside: int, n: int) -> tuple[float, float]:
    """Exact 95 % interval of a share (Clopper and Pearson 1934, Biometrika 26:404)."""
    low = 0.0 if inside == 0 else float(beta.ppf(0.025, inside, n - inside + 1))
    high = 1.0 if inside == n else float(beta.ppf(0.975, inside + 1, n - inside))
    return low, high


def _errors(unknowns: Iterable[Unknown], unit: str) -> list[float]:
    return [
        (own.estimate - own.truth) * _scale(own, unit)
        for own in unknowns
        if own.estimate is not None and own.truth is not None
    ]


def _scale(unknown: Unknown, unit: str) -> float:
    """By which errors of an unknown are multiplied: to a share of the truth in %, or 1."""
    return 1.0 if unit or not unknown.truth else 100.0 / unknown.truth


def _is_log(unknown: Unknown) -> bool:
    return unknown.name not in REGISTRATION and is_positive(unknown.name)
