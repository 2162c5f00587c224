"""How good estimates are beside what anyone could say without an estimation."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from mvest.reporting.case.findings import UnknownRow

__all__ = ["median_errors", "skill_words"]


def median_errors(moduli: Sequence[UnknownRow]) -> tuple[float, float] | None:
    """Median error of the estimates that there are, and of the generic guess for all, relative.

    The guess is the value of the literature, which is the mean of the prior. Truths are known.
    """
    known = [(row, row.truth) for row in moduli if row.truth is not None]
    errors = [abs(row.estimate / truth - 1) for row, truth in known if row.estimate is not None]
    guesses = [abs(row.prior_mean / truth - 1) for row, truth in known]
    return (median(errors), median(guesses)) if errors else None


def skill_words(moduli: Sequence[UnknownRow]) -> str:
    """Coverage and median error, beside the error of the generic guess, runs lost included."""
    lost = sum(row.estimate is None for row in moduli)
    inside = sum(row.inside is True for row in moduli)
    text = f"{inside} of {len(moduli)} moduli lie inside their 95 % intervals"
    errors = median_errors(moduli)
    if errors:
        text += f"; the median error is {100 * errors[0]:.1f} %, "
        text += f"that of the generic guess {100 * errors[1]:.1f} %"
    return f"{text}; {lost} without an estimate." if lost else f"{text}."
