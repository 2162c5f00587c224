"""Identifiability in words: what data will tell, and which parameters they cannot tell apart."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import ndtri

from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.identifiability import Identifiability
from mvest.estimation.transform import Transform
from mvest.reporting.findings import Alike
from mvest.reporting.markup import MISSING, listed, number
from mvest.typing import FloatArray

__all__ = ["alike", "alike_words", "confounded_words", "expectation_text", "measurement_words"]

STEP = 0.1
"""Change by which it is shown how parameters make up for each other, in parts of a scale."""

MEASURED = {
    "pressure_scale": (0.02, "2 % (2.4 mmHg of 120)"),
    "chord_rest_length": (0.005, "0.5 %"),
    "chord_stiffness": (0.05, "5 %"),
    "shift": (0.2, "0.2 mm"),
    "turn": (0.5, "0.5 degrees"),
}
"""Kind of parameter -> how well it might be measured, in its unit and in words."""

GAIN = 0.1
"""Least part of a modulus' standard deviation that a measurement worth naming takes away."""

UNITS = {"E_f": "MPa", "G": "MPa", "shift": "mm", "turn": "degrees"}
"""Of parameters by the first part of their name; the others are factors."""


def expectation_text(
    title: str,
    assumed: FloatArray,
    prior: Gaussian,
    transform: Transform,
    data: Identifiability,
    informed: Identifiability | None,
    observed: str,
) -> str:
    """The answer of the Fisher information as text for a terminal.

    Parameters
    ----------
    title : str
    assumed : (p,) in the units of the parameters
    prior : Gaussian
        Of the parameters.
    transform : Transform
        Coordinates in which intervals are symmetric.
    data, informed : Identifiability
        Of the data alone, and with the prior (None where that holds a parameter fixed).
    observed : str
        What is observed, and how well.
    """
    import pandas as pd

    z = transform.forward(assumed)
    rows = []
    for k, name in enumerate(data.names):
        low = high = None
        if informed is not None:
            reach = np.zeros_like(z)
            reach[k] = ndtri(0.975) * informed.std[k] / transform.derivative(z)[k]
            low, high = (float(transform.inverse(z + s * reach)[k]) for s in (-1.0, 1.0))
        rows.append(
            {
                "parameter": name,
                "unit": _unit(name) or MISSING,
                "assumed": number(float(assumed[k])),
                "± beforehand": number(float(prior.std[k]), 2),
                "± from the data alone": _width(float(data.std[k])),
                "[%]": _percent(data, k, assumed),
                "± with both": MISSING if informed is None else _width(float(informed.std[k])),
                "95 % interval to expect": MISSING
                if low is None or high is None
                else f"{number(low)} to {number(high)}",
            }
        )
    condition = data.condition_number
    lines = [
        f"{title}: what the data will tell (Cramér-Rao bound at the assumed values)",
        f"Observed: {observed}",
        "",
        pd.DataFrame(rows).to_string(index=False),
        "",
        "Condition number of the information: "
        + (number(condition) if np.isfinite(condition) else "infinite")
        + " (1: all parameters, in parts of their size, are told equally well)",
        *(confounded_words(data) or ["The data tell all parameters apart."]),
        *(f"Known badly from the data alone: {words}" for words in data.flat()),
        *measurement_words(data if informed is None else informed),
        "No estimation was run.",
    ]
    return "\n".join(lines)


def measurement_words(data: Identifiability) -> list[str]:
    """What to measure besides, how well, and what that gains; the largest gain first."""
    moduli = [k for k, name in enumerate(data.names) if _unit(name) == "MPa"]
    found = []
    for name in data.names:
        accuracy, words = MEASURED.get(name.partition(".")[0], (0.0, ""))
        if not accuracy or not moduli:
            continue
        std = data.measured(name, accuracy)
        left = [std[k] / data.std[k] if np.isfinite(data.std[k]) else 0.0 for k in moduli]
        best = int(np.argmin(left))
        if left[best] <= 1 - GAIN and np.isfinite(std[moduli[best]]):
            k = moduli[best]
            now, then = (100 * float(value[k] / data.scale[k]) for value in (data.std, std))
            before = f"{number(now, 2)} %" if np.isfinite(now) else "not determined"
            found.append(
                (
                    left[best],
                    f"Measure {name} to {words}: {data.names[k]} would be known to "
                    f"{number(then, 2)} % (now {before}).",
                )
            )
    return [words for _, words in sorted(found)]


def confounded_words(data: Identifiability) -> list[str]:
    """One sentence for each group of parameters that the data hardly tell apart."""
    return [alike_words(group) for group in alike(data)]


def alike(data: Identifiability) -> tuple[Alike, ...]:
    """Parameters that the data hardly tell apart, and a change of each that hardly shows.

    For a change of the first by a tenth of its scale.
    """
    return tuple(
        Alike(
            group.names,
            tuple(
                STEP * exchange * float(data.scale[data.names.index(name)])
                for name, exchange in zip(group.names, group.exchange, strict=True)
            ),
            tuple(STEP * exchange for exchange in group.exchange),
            group.correlation,
        )
        for group in data.confounded()
    )


def alike_words(group: Alike, labels: Mapping[str, str] | None = None) -> str:
    """``The data hardly tell apart A and B: +10 % of A with −5 % of B looks almost the same``.

    Parameters
    ----------
    group : Alike
    labels : mapping, optional
        What parameters are called.
    """
    names = group.parameters
    labelled = [(labels or {}).get(name, name) for name in names]
    moved = [
        f"{_change(name, change, relative)} of {label}"
        for name, label, change, relative in zip(
            names, labelled, group.changes, group.relative, strict=True
        )
    ]
    return (
        f"The data hardly tell apart {listed(labelled)} (correlations of at least "
        f"{np.floor(1000 * group.correlation) / 1000:.3g}): {moved[0]} with "
        f"{listed(moved[1:])} looks almost the same."
    )


def _change(name: str, change: float, relative: float) -> str:
    if _unit(name) in ("mm", "degrees"):
        return f"{change:+.2g} {_unit(name)}".replace("-", "−")
    return f"{100 * relative:+.2g} %".replace("-", "−")


def _unit(name: str) -> str:
    return UNITS.get(name.partition(".")[0], "")


def _width(std: float) -> str:
    return number(std, 2) if np.isfinite(std) else "not determined"


def _percent(data: Identifiability, k: int, assumed: FloatArray) -> str:
    """Of the assumed value; a dash for a parameter without size."""
    std = float(data.std[k])
    if assumed[k] == 0.0 or not np.isfinite(std):
        return MISSING
    return number(100.0 * std / abs(float(assumed[k])), 2)
