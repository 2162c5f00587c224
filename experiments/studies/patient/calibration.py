"""What estimates are worth in worlds that are not as they assume: coverage, skill and verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binom, chi2, norm

from experiments.common.cases.findings import Findings
from experiments.common.cases.skill import (
    GENERIC,
    PRIOR,
    log_width,
    median_errors,
    prior_alone,
    score,
    share_bounds,
)
from experiments.common.records.record import Record
from experiments.common.records.report import provenance_of
from experiments.common.records.tables import write_table
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY
from mvest.reporting.case.findings import UnknownRow
from mvest.reporting.figures import save_figure_with
from mvest.reporting.markup import MISSING
from mvest.typing import FloatArray

__all__ = ["CALIBRATION", "calibration_answer", "calibration_frame", "write_calibration_tables"]

CALIBRATION = "calibration"
"""Folder of the kept records within the results."""

PLANNED = 20
"""Valves of each world that are to be estimated."""

WRONG = 3.0
"""Standard deviations off beyond which an interval is wrong."""

LEVEL = 0.95
DRAWS = 4000
"""Uniform samples from which a band for all of a curve is found."""

Worlds = Mapping[str, Sequence[Record[Findings]]]

Band = tuple[FloatArray, FloatArray, FloatArray]
"""Where, and what lies below and above."""


def worlds_of(records: Sequence[Record[Findings]]) -> dict[str, list[Record[Findings]]]:
    """The runs in each world, in the order in which worlds are listed by their names in a run."""
    worlds: dict[str, list[Record[Findings]]] = {}
    for record in records:
        worlds.setdefault(_world(record), []).append(record)
    first = dict.fromkeys((w for w in worlds if w == "reference"), 0)
    return {name: worlds[name] for name in sorted(worlds, key=lambda w: (first.get(w, 1), w))}


def calibration_frame(records: Sequence[Record[Findings]]) -> pd.DataFrame:
    """One row for each run and modulus: truth, estimate, verdict and how far it is off."""
    rows = []
    for record in records:
        case = record.findings.case
        for row in _moduli(record):
            z = score(row)
            rows.append(
                {
                    "world": _world(record),
                    "seed": record.provenance.seed,
                    "verdict": _trust(record),
                    "modulus": row.name,
                    "truth [MPa]": row.truth,
                    "estimate [MPa]": row.estimate,
                    "95 % low [MPa]": row.low,
                    "95 % high [MPa]": row.high,
                    "inside": row.inside,
                    "off by [SD]": z,
                    "truth in posterior": None if z is None else float(norm.cdf(z)),
                    f"inside, {PRIOR}": prior_alone(row).inside,
                    f"{GENERIC} [MPa]": row.prior_mean,
                    "NEES": _nees(record),
                    "NIS": case.innovation and case.innovation.nis / case.innovation.size,
                    "grounds": ""
                    if case.verdict is None
                    else "; ".join(f"{g.check}: {g.text}" for g in case.verdict.grounds),
                    "ended": record.reason,
                }
            )
    return pd.DataFrame(rows)


def write_calibration_tables(results: Path, records: Sequence[Record[Findings]]) -> list[Path]:
    """``calibration.*`` from kept runs in all worlds that there are."""
    worlds = worlds_of(records)
    readable = [_readable(name, runs) for name, runs in worlds.items()]
    readable += _without_data(list(records))
    base = results / CALIBRATION
    written = write_table(
        base, calibration_frame(records), readable, provenance_of(records), _notes(worlds)
    )
    return [*written, *save_figure_with(base, calibration_figure(worlds), records[0].line)]


def calibration_answer(records: Mapping[str, Record[Findings]]) -> str:
    """What a verdict is worth, in one line."""
    worlds = worlds_of(list(records.values()))
    trusted = [run for runs in worlds.values() for run in runs if _trust(run) == TRUSTWORTHY]
    inside, n = _inside(trusted)
    wrong = [row for run in records.values() for row in _moduli(run) if _is_wrong(row)]
    believed = sum(_is_wrong(row) for run in trusted for row in _moduli(run))
    return (
        f"{len(records)} simulated valves in {len(worlds)} worlds, of which all but one are not as "
        f"the estimator assumes: {len(trusted)} estimates are called trustworthy, and "
        f"{inside} of their {n} moduli lie inside their 95 % intervals; of {len(wrong)} moduli off "
        f"by more than {WRONG:g} standard deviations {believed} are called trustworthy."
    )


def _readable(world: str, runs: Sequence[Record[Findings]]) -> dict[str, str]:
    """What is said of one world."""
    row = {"world": world, "valves": f"{len(runs)} of {max(PLANNED, len(runs))}"}
    row["trustworthy / doubtful / none"] = " / ".join(
        str(sum(_trust(run) == trust for run in runs)) for trust in (TRUSTWORTHY, DOUBTFUL, NONE)
    )
    for name in _names(runs):
        row[f"{_short(name)} inside"] = _share_words(*_inside(runs, name))
    trusted = [run for run in runs if _trust(run) == TRUSTWORTHY]
    row["inside, trustworthy"] = _share_words(*_inside(trusted))
    wrong, believed = (
        sum(_is_wrong(one) for run in some for one in _moduli(run)) for some in (runs, trusted)
    )
    row[f"more than {WRONG:g} SD off (trustworthy)"] = f"{wrong} ({believed})"
    row["NEES"] = _nees_words(runs)
    errors = [median_errors(_all_moduli(some)) for some in (runs, trusted)]
    row["median error (trustworthy)"] = (
        f"{_percent(errors[0] and errors[0][0])} ({_percent(errors[1] and errors[1][0])})"
    )
    row[GENERIC] = _percent(errors[0] and errors[0][1])
    row["width / prior's"] = _width_words(runs)
    return row


def _without_data(records: Sequence[Record[Findings]]) -> list[dict[str, str]]:
    """What the generic guess and the prior alone are worth for the same valves."""
    first: dict[int, Record[Findings]] = {}
    for record in records:
        first.setdefault(record.provenance.seed, record)
    runs = list(first.values())
    errors = median_errors(list(map(prior_alone, _all_moduli(runs))))
    error = _percent(errors and errors[0])
    common = {"valves": str(len(runs)), "median error (trustworthy)": error, GENERIC: error}
    coverage = {
        f"{_short(name)} inside": _share_words(*_inside(runs, name, prior=True))
        for name in _names(runs)
    }
    columns = _readable("", runs)
    return [
        {key: values.get(key, MISSING) for key in columns}
        for values in (
            {"world": GENERIC, **common},
            {"world": PRIOR, **common, **coverage, "width / prior's": "1"},
        )
    ]


def _notes(worlds: Worlds) -> list[str]:
    runs = [run for some in worlds.values() for run in some]
    missing = {name: PLANNED - len(some) for name, some in worlds.items() if len(some) < PLANNED}
    notes = [
        "Simulated valves with anatomies and moduli drawn at random, the moduli from the priors. "
        "Each world breaks one assumption of the estimator, which is told of none of them; one "
        "seed is one valve, with one set of errors, in every world. The truth was revealed after "
        "the estimation. Shares of intervals (95 %) that contain the truth with exact binomial "
        "bounds; all estimates count, also those of which no number would be stated.",
        "NEES is the squared error in the posterior's covariance over the number of unknowns, on "
        "average over valves; in parentheses where 95 % of such means lie if intervals are right.",
    ]
    if missing:
        notes.insert(
            0,
            f"**Not complete: {sum(missing.values())} of {PLANNED * len(worlds)} runs are "
            "missing.** Numbers of a world are of as many valves as stand beside it.",
        )
    notes += _judged(worlds)
    grounds = pd.Series([g for run in runs for g in _grounds(run)]).value_counts()
    if len(grounds):
        listed = ", ".join(f"{check} ({n})" for check, n in grounds.items())
        notes.append(f"What spoke against estimates: {listed}.")
    return notes


def _judged(worlds: Worlds) -> list[str]:
    """Where verdicts do what is asked of them and where they do not."""
    low, wrong = [], []
    for name, runs in worlds.items():
        trusted = [run for run in runs if _trust(run) == TRUSTWORTHY]
        inside, n = _inside(trusted)
        if n and inside < 0.9 * n:
            low.append(f"{name} ({inside} of {n})")
        believed, off = (sum(map(_is_wrong, _all_moduli(some))) for some in (trusted, runs))
        if believed > 0.05 * off:
            wrong.append(f"{name} ({believed} of {off})")
    return [
        f"{what}: {'; '.join(names) or 'none'}."
        for what, names in (
            ("Worlds in which less than 90 % of the intervals called trustworthy hold", low),
            (f"In which more than 5 % of those more than {WRONG:g} SD off are trustworthy", wrong),
        )
    ]


# -- figure ---------------------------------------------------------------------------------------
def calibration_figure(worlds: Worlds) -> Figure:
    """Where the truth lies in the posterior, one panel for each world.

    Difference of the empirical distribution function of the truth's place from that of the uniform
    distribution, with a band that 95 % of samples do not leave anywhere (Säilynoja, Bürkner and
    Vehtari 2022, Stat. Comput. 32:32). Above zero on the left: truths lie too low in the posterior.
    """
    columns = min(5, len(worlds))
    lines = -(-len(worlds) // columns)
    figure = Figure(figsize=(2.6 * columns, 2.3 * lines + 0.6), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    bands: dict[int, Band] = {}
    for axes, (name, runs) in zip(grid.ravel(), worlds.items(), strict=False):
        _draw_world(axes, name, runs, bands)
    for axes in grid.ravel()[len(worlds) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("truth in posterior", fontsize=8)
    grid[0, 0].legend(fontsize=7, frameon=False, loc="upper right")
    figure.supylabel("empirical minus uniform distribution", fontsize=9)
    return figure


def _draw_world(
    axes: Axes,
    name: str,
    runs: Sequence[Record[Findings]],
    bands: dict[int, Band],
) -> None:
    trusted = sum(_trust(run) == TRUSTWORTHY for run in runs)
    axes.set_title(f"{name}\n{trusted} of {len(runs)} trustworthy", fontsize=8)
    axes.axhline(0.0, color="0.5", lw=0.6)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    for modulus, colour in zip(_names(runs), ("#2b6ca3", "#c8452f"), strict=False):
        scores = [score(row) for row in _all_moduli(runs) if row.name == modulus]
        places = np.sort(norm.cdf([z for z in scores if z is not None]))
        n = len(places)
        if not n:
            continue
        at, low, high = bands.setdefault(n, ecdf_band(n))
        axes.fill_between(at, low, high, color="0.9", lw=0, step="mid", zorder=0)
        empirical = np.searchsorted(places, at, side="right") / n
        axes.step(at, empirical - at, where="mid", color=colour, lw=1.2, label=_short(modulus))


def ecdf_band(n: int) -> Band:
    """Where, and between which differences, 95 % of ECDFs of n uniform numbers lie throughout."""
    at = np.linspace(0.0, 1.0, 101)[1:-1]
    rng = np.random.default_rng(0)
    counts = (rng.random((DRAWS, n, 1)) <= at).sum(axis=1)
    tails = np.minimum(binom.cdf(counts, n, at), binom.sf(counts - 1, n, at))
    tail = np.quantile(tails.min(axis=1), 1 - LEVEL)
    return at, binom.ppf(tail, n, at) / n - at, binom.isf(tail, n, at) / n - at


# -- numbers --------------------------------------------------------------------------------------
def _moduli(record: Record[Findings]) -> list[UnknownRow]:
    return [row for row in record.findings.case.unknowns if row.is_modulus]


def _all_moduli(runs: Sequence[Record[Findings]]) -> list[UnknownRow]:
    return [row for run in runs for row in _moduli(run)]


def _names(runs: Sequence[Record[Findings]]) -> list[str]:
    return list(dict.fromkeys(row.name for row in _all_moduli(runs)))


def _world(record: Record[Findings]) -> str:
    revealed = record.findings.revealed
    return (revealed.world if revealed else "") or "reference"


def _trust(record: Record[Findings]) -> str:
    verdict = record.findings.case.verdict
    return NONE if verdict is None else verdict.trust


def _grounds(record: Record[Findings]) -> list[str]:
    verdict = record.findings.case.verdict
    return [] if verdict is None else list(dict.fromkeys(g.check for g in verdict.grounds))


def _inside(
    runs: Sequence[Record[Findings]], name: str | None = None, *, prior: bool = False
) -> tuple[int, int]:
    """How many intervals contain the truth, and of how many."""
    rows = [row for row in _all_moduli(runs) if name in (None, row.name)]
    known = [(prior_alone(row) if prior else row).inside for row in rows]
    return sum(one is True for one in known), sum(one is not None for one in known)


def _is_wrong(row: UnknownRow) -> bool:
    z = score(row)
    return z is not None and abs(z) > WRONG


def _nees(record: Record[Findings]) -> float | None:
    """Squared error in the posterior's covariance, over the number of unknowns."""
    case = record.findings.case
    z = np.array([score(row) for row in case.unknowns], dtype=np.float64)
    if not case.correlation or not np.isfinite(z).all():
        return None
    return float(z @ np.linalg.solve(np.array(case.correlation), z)) / len(z)


def _nees_words(runs: Sequence[Record[Findings]]) -> str:
    known = [value for run in runs if (value := _nees(run)) is not None]
    if not known:
        return MISSING
    freedom = len(runs[0].findings.case.unknowns) * len(known)
    low, high = (float(chi2.ppf(q, freedom)) / freedom for q in (0.025, 0.975))
    return f"{np.mean(known):.2f} ({low:.2f} to {high:.2f})"


def _width_words(runs: Sequence[Record[Findings]]) -> str:
    ratios = [
        width / before
        for row in _all_moduli(runs)
        if (width := log_width(row)) is not None and (before := log_width(prior_alone(row)))
    ]
    return f"{median(ratios):.2f}" if ratios else MISSING


def _share_words(inside: int, n: int) -> str:
    if not n:
        return MISSING
    low, high = share_bounds(inside, n)
    return f"{inside} of {n} ({100 * low:.0f} to {100 * high:.0f} %)"


def _percent(value: Any) -> str:
    return MISSING if value is None else f"{100 * value:.1f} %"


def _short(name: str) -> str:
    return name.replace("E_f.", "E_f ")
