"""How good estimates are beside what anyone could say without an estimation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from mvest.reporting.case.findings import UnknownRow

__all__ = ["Answered", "median_errors", "skill_words"]


@dataclass(frozen=True, slots=True)
class Answered:
    """One modulus of a simulated valve, MPa.

    Attributes
    ----------
    leaflet : str
    truth : float
    estimate, low, high : float or None
        With its 95 % interval; None where a run ended without an estimate.
    generic : float
        The value of the literature, which is what is said of a valve without an estimation.
    """

    leaflet: str
    truth: float
    estimate: float | None
    low: float | None
    high: float | None
    generic: float

    @classmethod
    def of(cls, row: UnknownRow) -> Answered:
        """A modulus whose truth was revealed."""
        assert row.truth is not None
        leaflet = row.name.partition(".")[2]
        return cls(leaflet, row.truth, row.estimate, row.low, row.high, row.prior_mean)


def median_errors(moduli: Sequence[Answered]) -> tuple[float, float] | None:
    """Median error of the estimates that there are, and of the generic guess for all, relative."""
    errors = [abs(one.estimate / one.truth - 1) for one in moduli if one.estimate is not None]
    guesses = [abs(one.generic / one.truth - 1) for one in moduli]
    return (median(errors), median(guesses)) if errors else None


def skill_words(moduli: Sequence[Answered]) -> str:
    """Coverage and median error, beside the error of the generic guess, runs lost included."""
    lost = sum(one.estimate is None for one in moduli)
    inside = sum(
        one.low is not None and one.high is not None and one.low <= one.truth <= one.high
        for one in moduli
    )
    text = f"{inside} of {len(moduli)} moduli lie inside their 95 % intervals"
    errors = median_errors(moduli)
    if errors:
        text += f"; the median error is {100 * errors[0]:.1f} %, "
        text += f"that of the generic guess {100 * errors[1]:.1f} %"
    return f"{text}; {lost} without an estimate." if lost else f"{text}."
