"""How good estimates are beside what anyone could say without an estimation.

That is the generic guess, a value of the literature, and the prior alone, which is that value with
the interval that is believed before anything was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np
from scipy.stats import beta, norm

from mvest.mechanics.parameters import is_positive
from mvest.problem.record import Unknown
from mvest.problem.registration import REGISTRATION

__all__ = [
    "GENERIC",
    "HALF",
    "PRIOR",
    "PRIOR_STD",
    "baselines",
    "generic_guess",
    "log_width",
    "prior_alone",
    "score",
    "share_bounds",
    "skill",
]

GENERIC, PRIOR = "generic guess", "prior alone"
"""What tables call the two."""

PRIOR_STD = 0.5
"""Standard deviation of a modulus relative to its mean in the prior of a case."""

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


def baselines(moduli: Sequence[Unknown]) -> list[dict[str, Any]]:
    """What generic guess and prior alone are worth: rows that stand below a table of estimates.

    Parameters
    ----------
    moduli : sequence of Unknown
        The estimates, of several leaflets and valves, with their truths; priors are the same for
        all valves.

    Returns
    -------
    list of dict
        For each leaflet ``what`` (`GENERIC` or `PRIOR`), ``parameter``, ``estimate``, ``low``,
        ``high``, ``inside`` of ``n`` truths (0 where there is no interval), and ``median_error``
        (relative).
    """
    rows = []
    for what, guess in ((GENERIC, generic_guess), (PRIOR, prior_alone)):
        for name in dict.fromkeys(one.name for one in moduli):
            own = [guess(one) for one in moduli if one.name == name and one.truth is not None]
            known = [one.inside for one in own if one.inside is not None]
            if own:
                rows.append(
                    {
                        "what": what,
                        "parameter": name,
                        "estimate": own[0].estimate,
                        "low": own[0].low,
                        "high": own[0].high,
                        "inside": sum(known),
                        "n": len(known),
                        "median_error": median(_errors(own)),
                    }
                )
    return rows


def skill(moduli: Sequence[Unknown]) -> dict[str, Any]:
    """Coverage and median error of estimates beside those of generic guess and prior alone.

    Parameters
    ----------
    moduli : sequence of Unknown
        With their truths; those without an estimate count as misses.

    Returns
    -------
    dict
        ``n`` moduli, ``without_estimate`` of them, ``inside`` their 95 % intervals,
        ``inside_prior_alone``, and the relative ``median_error`` of the estimates that there are
        and of the generic guess for all (``median_error_generic_guess``); errors are None without
        any estimate.
    """
    errors = _errors(moduli)
    return {
        "n": len(moduli),
        "without_estimate": sum(one.estimate is None for one in moduli),
        "inside": sum(one.inside is True for one in moduli),
        "inside_prior_alone": sum(prior_alone(one).inside is True for one in moduli),
        "median_error": median(errors) if errors else None,
        "median_error_generic_guess": median(_errors([generic_guess(one) for one in moduli]))
        if errors
        else None,
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


def _errors(unknowns: Sequence[Unknown]) -> list[float]:
    return [
        abs(one.estimate / one.truth - 1)
        for one in unknowns
        if one.truth is not None and one.estimate is not None
    ]


def _is_log(unknown: Unknown) -> bool:
    return unknown.name not in REGISTRATION and is_positive(unknown.name)
