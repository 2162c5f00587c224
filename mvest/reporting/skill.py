"""The skill of estimates compared with guesses: numbers, tables and a figure.

The generic guess is the literature's value; the prior is this value with its interval.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import binomtest, mannwhitneyu, norm

from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY
from mvest.reporting.tables import Column, Table, table
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GENERIC = "generic guess"
HALF = float(norm.ppf(0.975))
"""Standard deviations from the middle of a 95 % interval to its end."""


def prior_alone(unknown: Unknown) -> Unknown:
    """The unknown with the mean and 95 % interval of its prior, log-normal if it is positive."""
    mean, std = unknown.prior_mean, unknown.prior_std
    ends: tuple[float | None, float | None] = (None, None)
    if mean is not None and std is not None:
        factor, reach = (float(np.exp(HALF * std / mean)) if mean else 1.0), HALF * std
        positive = unknown.is_positive
        ends = (mean / factor, mean * factor) if positive else (mean - reach, mean + reach)
    low, high = ends
    prior = {"estimate": mean, "std": None if low is None else std, "low": low, "high": high}
    return unknown.model_copy(update=prior)


def skill(unknowns: Sequence[Unknown]) -> dict[str, Any]:
    """Coverage and errors of estimates, compared with the generic guess and the prior.

    Returns a dict: ``n`` unknowns, how many were ``estimated`` and how many have the truth
    ``inside`` their 95 % interval; ``coverage`` (%) with exact 95 % bounds; ``mean square`` of
    errors in posterior standard deviations, which is 1 for intervals of the right width. Errors and
    the ``mean width`` of intervals are in ``unit``: in % of the truth for moduli and factors, else
    in the unknown's unit. The generic guess has its median error for the same unknowns and for all.
    ``relative width`` is the median over the estimate, and ``width over prior`` the median ratio of
    logarithmic widths. None: not known.

    ``unknowns``: at least one, of one kind, with their truths; of one valve or of many.
    """
    unit = "" if unknowns[0].is_modulus else unknowns[0].unit
    prior = [prior_alone(own) for own in unknowns]
    truth, estimate, low, high, guess = (
        np.array([getattr(own, name) for own in unknowns], dtype=np.float64)
        for name in ("truth", "estimate", "low", "high", "prior_mean")
    )
    relative = np.isfinite(truth) & (truth != 0.0) & (not unit)
    scale = np.divide(100.0, truth, out=np.ones_like(truth), where=relative)
    error, guess_error = (estimate - truth) * scale, np.abs(guess - truth) * scale
    known, width = np.isfinite(estimate), high + 0.0 * estimate - low
    after, before = (
        np.array([np.nan if unit else log_width(own) for own in some]) for some in (unknowns, prior)
    )
    ratio = np.divide(after, before, out=np.full_like(after, np.nan), where=known & (before > 0.0))
    judged = [own.inside for own in unknowns if own.inside is not None]
    inside, n = sum(judged), len(judged)
    bounds = share_bounds(inside, n)
    scores = [z**2 for own in unknowns if (z := score(own)) is not None]

    def known_only(function: Callable[[FloatArray], Any], values: FloatArray) -> float | None:
        """A mean or median of the finite values; None if there are none."""
        finite = values[np.isfinite(values)]
        return float(function(finite)) if finite.size else None

    return {
        "n": len(unknowns),
        "estimated": int(known.sum()),
        "inside": inside,
        "coverage": 100 * inside / n if n else None,
        "coverage low": 100 * bounds[0] if n else None,
        "coverage high": 100 * bounds[1] if n else None,
        "mean square": known_only(np.mean, np.array(scores)),
        "unit": unit or "%",
        "mean error": known_only(np.mean, error),
        "median error": known_only(np.median, np.abs(error)),
        GENERIC: known_only(np.median, guess_error[known]),
        f"{GENERIC}, all": known_only(np.median, guess_error),
        "inside prior": sum(own.inside is True for own in prior),
        "mean width": known_only(np.mean, width * scale),
        "relative width": None if unit else known_only(np.median, width / estimate),
        "width over prior": known_only(np.median, ratio),
    }


def score(unknown: Unknown) -> float | None:
    """Truth minus estimate in posterior standard deviations, of the logarithm if positive."""
    values = (unknown.truth, unknown.estimate, unknown.low, unknown.high)
    if any(value is None for value in values):
        return None
    known = np.array(values, dtype=np.float64)
    truth, estimate, low, high = np.log(known) if unknown.is_positive else known
    return float(2 * HALF * (truth - estimate) / (high - low))


def log_width(unknown: Unknown) -> float:
    """Width of the interval of a modulus's logarithm; NaN without an interval."""
    if unknown.low is None or unknown.high is None:
        return np.nan
    return float(np.log(unknown.high / unknown.low))


def share_bounds(inside: int, n: int) -> tuple[float, float]:
    """Exact 95 % interval of a share (Clopper and Pearson 1934, Biometrika 26:404)."""
    found = binomtest(inside, n).proportion_ci(method="exact") if n else (0.0, 1.0)
    return float(found[0]), float(found[1])


ACROSS = 4
"""Panels of `moduli_figure` side by side, at most."""

SAMPLES, SEED = 1000, 1
"""Number of samples of the cases in `warning_table`, and the seed of their generator."""

VERDICTS = (TRUSTWORTHY, DOUBTFUL, NONE)
COLOURS = {TRUSTWORTHY: "#2b6ca3", DOUBTFUL: "#d08a2e", NONE: "#a9a9a9", "": "0.2"}
"""Of verdicts in figures."""

COLUMNS = {
    "n": Column(),
    "estimated": Column(),
    "inside": Column(label="inside the interval"),
    "coverage": Column("%", ".0f", low="coverage low", high="coverage high"),
    "coverage low": Column("%"),
    "coverage high": Column("%"),
    "mean square": Column(digits=".2f", label="mean square of standardised errors"),
    "unit": Column(label="unit of errors"),
    "mean error": Column(digits=".2f"),
    "median error": Column(digits=".2f", label="median size of the error"),
    GENERIC: Column(digits=".2f", label="the same of the generic guess"),
    f"{GENERIC}, all": Column(digits=".2f", hidden=True),
    "inside prior": Column(label="inside the prior's interval"),
    "mean width": Column(digits=".2f", hidden=True),
    "relative width": Column(digits=".2f", label="interval / estimate"),
    "width over prior": Column(digits=".2f", label="interval / prior's"),
}


def trust_of(estimate: EstimateRecord) -> str:
    """The verdict in a word: ``none`` without an estimate, empty if it was not judged."""
    if not estimate.is_stated:
        return NONE
    return "" if estimate.verdict is None else estimate.verdict.trust


def stated(estimate: EstimateRecord) -> list[Unknown]:
    """The unknowns of the filter, without numbers if none may be stated."""
    if estimate.is_stated:
        return list(estimate.parameters)
    nothing: Mapping[str, None] = dict.fromkeys(("estimate", "std", "low", "high"))
    return [own.model_copy(update=nothing) for own in estimate.parameters]


def interval(label: str, unknown: Unknown | None) -> dict[str, Any]:
    """Cells of an estimate with its 95 % interval."""
    cells = {label: "estimate"} | {f"{label} {end}": end for end in ("low", "high", "inside")}
    return {cell: getattr(unknown, name, None) for cell, name in cells.items()}


def interval_columns(label: str, *, hidden: bool = False) -> dict[str, Column]:
    """Columns of `interval` in MPa; the column ``truth`` has the truth."""
    low, high, inside = (f"{label} {part}" for part in ("low", "high", "inside"))
    return {
        label: Column("MPa", low=low, high=high, truth="truth", hidden=hidden),
        **dict.fromkeys((low, high), Column("MPa", hidden=True)),
        inside: Column(hidden=True),
    }


def estimates_table(by: str, estimates: Sequence[EstimateRecord]) -> Table:
    """A row for each unknown of each estimate, with its truth.

    The first column is named ``by`` and has the case of an estimate, or its seed if it has none.
    """
    keys = ("parameter", "truth", "prior_mean", "estimate", "std", "bound", "relative_error")
    rows = [
        {by: one.case or one.seed}
        | {key: row.get(key) for key in (*keys, "distance_mean", "reason")}
        for one in estimates
        for row in one.rows()
        if row.get("kind") != "derived"
    ]
    mpa = "MPa" if all(u.unit == "MPa" for one in estimates for u in one.unknowns) else ""
    about = {
        by: Column(),
        "parameter": Column(),
        "truth": Column(mpa),
        "prior_mean": Column(mpa, hidden=True),
        "estimate": Column(mpa, std="std"),
        "bound": Column(mpa, ".2g", label="data alone leave"),
        "relative_error": Column(digits="+.2%", label="error"),
        "distance_mean": Column("mm"),
        "reason": Column(hidden=True),
    }
    return table(rows, **about)


def skill_table(by: str, groups: Mapping[str, Sequence[Unknown]]) -> Table:
    """The `skill` of each group that is not empty; the first column ``by`` names the group."""
    rows = [{by: name, **skill(unknowns)} for name, unknowns in groups.items() if unknowns]
    return table(rows, **{by: Column(), **COLUMNS})


def verdict_table(estimates: Sequence[EstimateRecord]) -> Table:
    """The skill of all moduli, stated or not, by verdict."""
    groups = {
        str(trust): [own for one in estimates if trust_of(one) == trust for own in one.moduli]
        for trust in VERDICTS
    }
    return skill_table("verdict", groups)


def warning_table(estimates: Sequence[EstimateRecord]) -> Table:
    """How well verdicts warn of intervals of moduli that miss the truth.

    The area under the receiver operating characteristic is the probability that a missed interval
    has a worse verdict than one that holds, where equal verdicts count half (Hanley and McNeil
    1982, Radiology 143:29): 1 if verdicts always warn, 0.5 if they say nothing. Its 95 % interval
    comes from samples of the cases with replacement, because scenarios share their cases. It is
    None if no interval, or every interval, misses.
    """
    cases = sorted({one.case for one in estimates})
    numbers = np.array(
        [
            (cases.index(one.case), VERDICTS.index(trust_of(one)), not own.inside)
            for one in estimates
            for own in one.moduli
            if own.inside is not None and trust_of(one) in VERDICTS
        ]
    ).reshape(-1, 3)
    of_case = [numbers[numbers[:, 0] == k] for k in range(len(cases))]

    def area(chosen: Iterable[int]) -> float:
        _, verdict, missed = np.concatenate([of_case[k] for k in chosen]).T
        one, other = verdict[missed == 1], verdict[missed == 0]
        if not one.size or not other.size:
            return np.nan
        return float(mannwhitneyu(one, other).statistic) / (one.size * other.size)

    n, missed = len(numbers), int(numbers[:, 2].sum())
    found, low, high = None, None, None
    if 0 < missed < n:
        picks = np.random.default_rng(SEED).integers(len(cases), size=(SAMPLES, len(cases)))
        low, high = np.nanpercentile([area(chosen) for chosen in picks], (2.5, 97.5))
        found = area(range(len(cases)))
    row = {"of": "moduli", "intervals": n, "missed": missed}
    row |= {"area": found, "low": low, "high": high}
    about = {"of": Column(), "intervals": Column(), "missed": Column()}
    about["area"] = Column(digits=".2f", low="low", high="high", label="area under the curve")
    return table([row], **about | dict.fromkeys(("low", "high"), Column(hidden=True)))


def moduli_figure(groups: Mapping[str, Sequence[tuple[Unknown, str]]]) -> Figure:
    """Estimates over their truths with 95 % intervals, in the colour of their verdicts.

    A panel for each group and modulus, with the line of equality and the generic guess. Estimates
    whose verdict is ``none`` are hollow; a panel's title counts those without a number.

    ``groups``: name -> moduli with known truths, each with its verdict in a word.
    """
    from mvest.reporting.figures import panels

    names = list(dict.fromkeys(own.name for each in groups.values() for own, _ in each))
    bands = [list(groups)[k : k + ACROSS] for k in range(0, len(groups), ACROSS)]
    rows, columns = max(len(bands) * len(names), 1), max(map(len, bands), default=1)
    drawn, grid = panels(rows, columns, 2.3 * rows + 0.4, sharex="row", sharey="row")
    for axes in grid.flat:
        axes.set_visible(False)
    for j, (band, name) in enumerate(itertools.product(bands, names)):
        for axes, group in zip(grid[j], band, strict=False):
            axes.set_visible(True)
            _draw_moduli(axes, [row for row in groups[group] if row[0].name == name])
            lost = sum(own.name == name and own.estimate is None for own, _ in groups[group])
            lines = [textwrap.fill(group, 26), *([f"{lost} without"] if lost else [])]
            axes.set_title("\n".join(lines), fontsize=8)
        grid[j, 0].set_ylabel(f"{name.replace('.', ' ')} [MPa]")
    for axes in grid[-1]:
        axes.set_xlabel("truth [MPa]")
    for trust in VERDICTS:
        face = "white" if trust == NONE else COLOURS[trust]
        grid[0, 0].plot([], [], "o-", color=COLOURS[trust], mfc=face, ms=4, lw=1.0, label=trust)
    grid[0, 0].plot([], [], "--", color="0.5", lw=0.9, label=GENERIC)
    drawn.legend(fontsize=8, loc="outside upper center", ncols=len(VERDICTS) + 1, frameon=False)
    return drawn


def _draw_moduli(axes: Any, moduli: Sequence[tuple[Unknown, str]]) -> None:
    """Draw one modulus of several valves over its truth, on logarithmic axes."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for own, trust in moduli:
        if own.estimate is None:
            continue
        colour, face = COLOURS[trust], "white" if trust == NONE else COLOURS[trust]
        axes.plot([own.truth, own.truth], [own.low, own.high], color=colour, lw=0.8, alpha=0.6)
        axes.plot(own.truth, own.estimate, "o", color=colour, mfc=face, ms=3.0)
    for guess in {own.prior_mean for own, _ in moduli} - {None}:
        axes.axhline(guess, color="0.5", lw=0.9, ls="--", zorder=0)
    axes.set_xscale("log")
    axes.set_yscale("log")
    ends = [own.truth for own, _ in moduli if own.truth]
    if ends:
        whole = [min(ends) / 1.15, max(ends) * 1.15]
        axes.plot(whole, whole, color="0.3", lw=0.8, zorder=0)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
