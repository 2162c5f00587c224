"""Intervals to expect from an estimation before any data are taken.

The Fisher information needs a model, a parameter set and the errors of the observations, but no
observed value. One run of the model therefore says which intervals to expect.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from mvest.estimation.information.identifiability import TradeOff, identifiability
from mvest.estimation.noise import observation_noise
from mvest.estimation.prediction import predict
from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.problem.estimate import Observed, Problem, expected_intervals
from mvest.problem.registration import label_of, unit_of
from mvest.reporting.tables import Column, Table, table


def expectation_text(title: str, problem: Problem, observation: Observed, noise: str) -> str:
    """The expected 95 % intervals of an estimation, which is not run, as text for a terminal.

    Parameters
    ----------
    title : str
    problem : Problem
        The model is run once, at the mean of the prior.
    observation : Observed
        Which points are observed, and their errors. Observed values are not used where points
        correspond.
    noise : str
        The errors of the coordinates in words.
    """
    prior, assumed, R = problem.prior, problem.start, observation.R
    seen = predict(observation.of(problem.model), assumed, derivatives=True)
    if not seen.converged:
        return unknown_text(title, seen.reason)
    scale = np.where(assumed != 0.0, np.abs(assumed), prior.std)
    data = identifiability(seen.jacobian, R, scale, names=problem.parameters)
    transform, n = problem.transform, len(seen.y)
    before = to_filter(transform, prior)
    H = seen.jacobian * transform.derivative(transform.forward(assumed))
    after = kalman_update(before, np.zeros(n), H, observation_noise(R, n)).posterior
    rows = expected_intervals(problem.parameters, transform, assumed, before.std, after.std)
    own = [row | {"alone": std} for row, std in zip(rows, data.std, strict=True)]
    lines = [
        f"{title}: expected intervals of 95 %, to first order",
        f"Observed: {n} numbers of {', '.join(observation.frames)}; {noise}",
        expected_table(own, alone=":.2g:± from the data alone").text(),
        *map(trade_off_text, data.confounded()),
        *(f"Poorly determined by the data alone: {words}" for words in data.flat()),
        "No estimation was run.",
    ]
    return "\n".join(lines)


def expected_table(rows: Iterable[Mapping[str, Any]], **more: Column | str) -> Table:
    """The table of `mvest.problem.estimate.expected_intervals`, with further columns."""
    return table(
        ({**row, "name": label_of(row["name"])} for row in rows),
        name="::unknown",
        unit="",
        generic=Column(low="low_before", high="high_before", label="generic (beforehand)"),
        low="::from",
        high="::to",
        width=":.2f:width left",
        **more,
    )


def unknown_text(title: str, reason: str) -> str:
    """The text where the model has no prediction at the assumed parameters."""
    return (
        f"{title}: the intervals to expect are not known, since the model has no prediction at the "
        f"assumed parameters ({reason})"
    )


def trade_off_text(group: TradeOff, labels: Mapping[str, str] | None = None) -> str:
    """One sentence about parameters that the data hardly distinguish.

    ``labels``: labels of the parameters.
    """
    labelled = [(labels or {}).get(name, name) for name in group.parameters]
    moved = []
    for name, label, change, relative in zip(
        group.parameters, labelled, group.changes, group.relative, strict=True
    ):
        unit = unit_of(name)
        own = f"{change:+.2g} {unit}" if unit in ("mm", "degrees") else f"{100 * relative:+.2g} %"
        moved.append(f"{own.replace('-', '−')} of {label}")
    return (
        f"The data hardly distinguish {' and '.join(labelled)} (correlation at least "
        f"{np.floor(1000 * group.correlation) / 1000:.3g}): {moved[0]} with "
        f"{' and '.join(moved[1:])} looks almost the same."
    )
