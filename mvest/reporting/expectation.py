"""What data will tell, in words: expected intervals, and what parameters make up for each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mvest.problem.expectation import Expectation
from mvest.problem.record import Confounded, confounded
from mvest.problem.registration import unit_of
from mvest.reporting.markup import MISSING, listed, number

ALL_APART, UNTOLD = "The data tell all parameters apart.", "not determined"


def expectation_text(title: str, expected: Expectation, noise: str) -> str:
    """The answer of the Fisher information as text for a terminal.

    Parameters
    ----------
    title : str
    expected : Expectation
    noise : str
        How well coordinates are seen.
    """
    import pandas as pd

    data, informed = expected.data, expected.informed
    if data is None:
        return unknown_text(title, expected.reason)
    assumed, prior = expected.assumed, expected.problem.prior
    low, high = (None, None) if informed is None else expected.interval()
    sized = (assumed != 0.0) & np.isfinite(data.std)
    shares = np.divide(data.std, abs(assumed), out=np.full(len(sized), np.nan), where=sized)
    rows = [
        {
            "parameter": name,
            "unit": unit_of(name) or MISSING,
            "assumed": number(float(assumed[k])),
            "± beforehand": number(float(prior.std[k]), 2),
            "± from the data alone": _width(float(data.std[k])),
            "[%]": number(100.0 * float(shares[k]), 2),
            "± with both": MISSING if informed is None else _width(float(informed.std[k])),
            "95 % interval to expect": MISSING
            if low is None or high is None
            else f"{number(float(low[k]))} to {number(float(high[k]))}",
        }
        for k, name in enumerate(data.names)
    ]
    condition = data.condition_number
    lines = [
        f"{title}: what the data will tell (Cramér-Rao bound at the assumed values)",
        f"Observed: {expected.observations} numbers of {', '.join(expected.frames)}; {noise}",
        "",
        pd.DataFrame(rows).to_string(index=False),
        "",
        "Condition number of the information: "
        + (number(condition) if np.isfinite(condition) else "infinite")
        + " (1: all parameters, in parts of their size, are told equally well)",
        *([alike_words(group) for group in confounded(data)] or [ALL_APART]),
        *(f"Known badly from the data alone: {words}" for words in data.flat()),
        "No estimation was run.",
    ]
    return "\n".join(lines)


def unknown_text(title: str, reason: str) -> str:
    """The answer where the model has no prediction at the assumed parameters."""
    return (
        f"{title}: what the data will tell is not known, the model has no prediction at the "
        f"assumed parameters ({reason})"
    )


def alike_words(group: Confounded, labels: Mapping[str, str] | None = None) -> str:
    """``The data hardly tell apart A and B: +10 % of A with −5 % of B looks almost the same``.

    Parameters
    ----------
    group : Confounded
    labels : mapping, optional
        What parameters are called.
    """
    labelled = [(labels or {}).get(name, name) for name in group.parameters]
    moved = [
        f"{_change(name, change, relative)} of {label}"
        for name, label, change, relative in zip(
            group.parameters, labelled, group.changes, group.relative, strict=True
        )
    ]
    return (
        f"The data hardly tell apart {listed(labelled)} (correlations of at least "
        f"{np.floor(1000 * group.correlation) / 1000:.3g}): {moved[0]} with "
        f"{listed(moved[1:])} looks almost the same."
    )


def _change(name: str, change: float, relative: float) -> str:
    if unit_of(name) in ("mm", "degrees"):
        return f"{change:+.2g} {unit_of(name)}".replace("-", "−")
    return f"{100 * relative:+.2g} %".replace("-", "−")


def _width(std: float) -> str:
    return number(std, 2) if np.isfinite(std) else UNTOLD
