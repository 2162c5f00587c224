"""How good estimates are beside what anyone could say without an estimation.

That is the generic guess, a value of the literature, and the prior alone, which is that value with
the interval that is believed before anything was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from scipy.stats import beta, norm

from mvest.mechanics.parameters import is_positive
from mvest.problem.registration import REGISTRATION
from mvest.reporting.case.findings import UnknownRow
from mvest.reporting.markup import number

__all__ = [
    "GENERIC",
    "HALF",
    "PRIOR",
    "PRIOR_STD",
    "Baseline",
    "baselines",
    "generic_guess",
    "log_width",
    "median_errors",
    "prior_alone",
    "score",
    "share_bounds",
    "skill_words",
]

GENERIC, PRIOR = "generic guess", "prior alone"
"""What tables call the two."""

PRIOR_STD = 0.5
"""Standard deviation of a modulus relative to its mean in the prior of ``conf/personal``."""

HALF = float(norm.ppf(0.975))
"""Standard deviations from the middle of a 95 % interval to its end."""


def generic_guess(row: UnknownRow) -> UnknownRow:
    """An unknown as the literature has it: the mean of the prior, without an interval."""
    return replace(row, estimate=row.prior_mean, std=None, low=None, high=None)


def prior_alone(row: UnknownRow) -> UnknownRow:
    """An unknown as it is believed before anything was seen; see `mvest.estimation.transform`."""
    mean, std = row.prior_mean, row.prior_std
    if _is_log(row):
        factor = float(np.exp(HALF * std / mean))
        return replace(row, estimate=mean, std=std, low=mean / factor, high=mean * factor)
    return replace(row, estimate=mean, std=std, low=mean - HALF * std, high=mean + HALF * std)


@dataclass(frozen=True, slots=True)
class Baseline:
    """What the generic guess or the prior alone is worth for the modulus of a leaflet.

    Attributes
    ----------
    what : str
        ``GENERIC`` or ``PRIOR``.
    row : UnknownRow
        Its value, and its interval where it has one.
    inside, n : int
        Of so many truths so many lie in the interval; n is 0 where there is none.
    error : float
        Median error, relative.
    """

    what: str
    row: UnknownRow
    inside: int
    n: int
    error: float

    @property
    def words(self) -> str:
        """Value, interval and what they are worth, for a cell of a table."""
        row, error = self.row, f"median error {100 * self.error:.1f} %"
        if row.low is None:
            return f"{number(row.estimate)}; {error}"
        interval = f"{number(row.low)} to {number(row.high)}"
        return f"{number(row.estimate)} ({interval}); {error}, {self.inside} of {self.n} inside"


def baselines(moduli: Sequence[UnknownRow]) -> list[Baseline]:
    """What stands below every table of estimates; truths are known.

    Parameters
    ----------
    moduli : sequence of UnknownRow
        The estimates, of several leaflets and valves; priors are the same for all valves.
    """
    rows = []
    for what, guess in ((GENERIC, generic_guess), (PRIOR, prior_alone)):
        for name in dict.fromkeys(row.name for row in moduli):
            own = [guess(row) for row in moduli if row.name == name and row.truth is not None]
            known = [row.inside for row in own if row.inside is not None]
            if own:
                rows.append(Baseline(what, own[0], sum(known), len(known), median(_errors(own))))
    return rows


def score(row: UnknownRow) -> float | None:
    """Truth minus estimate in posterior standard deviations, where the posterior is normal."""
    if row.truth is None or row.estimate is None or row.low is None or row.high is None:
        return None
    values = np.array([row.truth, row.estimate, row.low, row.high])
    truth, estimate, low, high = np.log(values) if _is_log(row) else values
    return float(2 * HALF * (truth - estimate) / (high - low))


def log_width(row: UnknownRow) -> float | None:
    """Width of the interval of a modulus' logarithm."""
    return None if row.low is None or row.high is None else float(np.log(row.high / row.low))


def share_bounds(inside: int, n: int) -> tuple[float, float]:
    """Exact 95 % interval of a share (Clopper and Pearson 1934, Biometrika 26:404)."""
    low = 0.0 if inside == 0 else float(beta.ppf(0.025, inside, n - inside + 1))
    high = 1.0 if inside == n else float(beta.ppf(0.975, inside + 1, n - inside))
    return low, high


def median_errors(moduli: Sequence[UnknownRow]) -> tuple[float, float] | None:
    """Median error of the estimates that there are, and of the generic guess for all, relative.

    Truths are known.
    """
    errors = _errors(moduli)
    return (median(errors), median(_errors(list(map(generic_guess, moduli))))) if errors else None


def skill_words(moduli: Sequence[UnknownRow]) -> str:
    """Coverage and median error beside those of generic guess and prior alone, lost runs included.

    Truths are known.
    """
    lost = sum(row.estimate is None for row in moduli)
    inside, before = (
        sum(row.inside is True for row in rows) for rows in (moduli, map(prior_alone, moduli))
    )
    text = (
        f"{inside} of {len(moduli)} moduli lie inside their 95 % intervals ({before} inside those "
        f"of the {PRIOR})"
    )
    errors = median_errors(moduli)
    if errors:
        text += f"; the median error is {100 * errors[0]:.1f} %, "
        text += f"that of the {GENERIC} {100 * errors[1]:.1f} %"
    return f"{text}; {lost} without an estimate." if lost else f"{text}."


def _errors(rows: Sequence[UnknownRow]) -> list[float]:
    return [
        abs(row.estimate / row.truth - 1)
        for row in rows
        if row.truth is not None and row.estimate is not None
    ]


def _is_log(row: UnknownRow) -> bool:
    return row.name not in REGISTRATION and is_positive(row.name)
