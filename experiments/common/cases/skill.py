"""How good estimates are beside what anyone could say without an estimation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median

__all__ = ["Answered", "skill_words"]


@dataclass(frozen=True, slots=True)
class Answered:
    """One modulus of a simulated valve, MPa.

    Attributes
    ----------
    truth : float
    estimate, low, high : float or None
        With its 95 % interval; None where a run ended without an estimate.
    generic : float
        The value of the literature, which is what is said of a valve without an estimation.
    """

    truth: float
    estimate: float | None
    low: float | None
    high: float | None
    generic: float


def skill_words(moduli: Iterable[Answered]) -> str:
    """Coverage and median error, beside the error of the generic guess, runs lost included."""
    asked = list(moduli)
    estimated = [one for one in asked if one.estimate is not None]
    inside = sum(
        one.low is not None and one.high is not None and one.low <= one.truth <= one.high
        for one in estimated
    )
    text = f"{inside} of {len(asked)} moduli lie inside their 95 % intervals"
    if estimated:
        error = median(abs(one.estimate / one.truth - 1) for one in estimated if one.estimate)
        guess = median(abs(one.generic / one.truth - 1) for one in asked)
        text += f"; the median error is {100 * error:.1f} %, "
        text += f"that of the generic guess {100 * guess:.1f} %"
    lost = len(asked) - len(estimated)
    return f"{text}; {lost} without an estimate." if lost else f"{text}."
