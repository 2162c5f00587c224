"""Tables of a sweep in a paper's style: one row per setting, the paper's own row first.

Every table exists twice: plain numbers with units in the column names, for CSV, and the same
rounded and put together for readers, for Markdown, LaTeX and the report.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.common.records.report import bracketed_unit
from experiments.sweeps.collected import Sweep
from experiments.sweeps.families import SEED, noise_groups, setting_words, varied_names
from experiments.sweeps.rows import (
    Run,
    factor_label,
    factor_names,
    factor_text,
    kind_of,
    runs_of,
)
from experiments.sweeps.statistics import (
    BASIN_PERCENT,
    BOUND_FACTOR,
    COVERAGE_RANGE,
    LEVELS,
    Coverage,
    EstimateAccuracy,
    accuracy,
    converged,
    coverage,
    grouped,
    in_basin,
    spread_of,
    verdict,
)
from mvest.reporting.markup import MISSING, number, with_std

__all__ = ["failure_rows", "summary", "table_note"]

Row = dict[str, Any]
Reading = dict[str, str]
IN_RANGE = f"95 % interval covers {100 * COVERAGE_RANGE[0]:.0f}-{100 * COVERAGE_RANGE[1]:.0f} %"
WITHIN_BOUND = f"RMSE within {BOUND_FACTOR:g} x bound"


def summary(sweep: Sweep) -> tuple[list[Row], list[Reading]]:
    """Plain and readable rows of the sweep's table; both empty for a sweep without jobs."""
    by_kind: Mapping[str, Callable[[Sweep, list[Run]], tuple[list[Row], list[Reading]]]] = {
        "initial_guess": _starts,
        "noise": _noise,
    }
    runs = runs_of(sweep)
    if not runs:
        return [], []
    rows, reading = by_kind.get(kind_of(sweep), _settings)(sweep, runs)
    plain_paper, paper = _paper_rows(sweep, reading[0])
    columns = list(dict.fromkeys(name for row in [*rows, *plain_paper] for name in row))
    return [{name: row.get(name) for name in columns} for row in plain_paper + rows], (
        paper + reading
    )


def table_note(sweep: Sweep) -> str:
    """What the numbers of the table mean."""
    common = (
        "All observations are simulated. Runs that failed are counted and enter no other number. "
    )
    kind = kind_of(sweep)
    if kind == "initial_guess":
        return common + (
            f"Estimates are mean ± SD over the starts that converged; a start is within "
            f"{BASIN_PERCENT:g} % if every parameter is."
        )
    if kind == "noise":
        return common + (
            "RMSE: root mean square error over the seeds; bound: mean Cramér–Rao standard "
            "deviation; RMSE / bound ± its Monte-Carlo standard deviation; coverage: share of "
            "runs whose nominal 95 % interval contains the truth, with Wilson's 95 % interval."
        )
    return common + (
        "Estimates are given with the filter's standard deviation (mean over seeds where there are "
        "several), errors with sign (root mean square over several seeds)."
    )


def _paper_rows(sweep: Sweep, like: Reading) -> tuple[list[Row], list[Reading]]:
    """The paper's numbers in the columns that the sweep's own table has."""
    paper = sweep.paper
    if paper is None:
        return [], []
    label = f"paper, {paper.table}"
    names = sweep.parameters
    absent = [None] * len(names)
    estimate, error = paper.estimate or absent, paper.error_percent or absent
    if "parameter" in like:
        plain: list[Row] = [
            {
                "setting": label,
                "parameter": name,
                f"estimate mean{bracketed_unit(name)}": estimate[k],
                "largest error [%]": error[k],
            }
            for k, name in enumerate(names)
        ]
        words = [
            {"setting": label, "parameter": name,
             f"estimate{bracketed_unit(name)}": number(estimate[k]),
             "largest error [%]": number(error[k])}
            for k, name in enumerate(names)
        ]  # fmt: skip
    else:
        plain = [{"setting": label}]
        words = [{"setting": label}]
        for k, name in enumerate(names):
            plain[0][f"estimate {name}{bracketed_unit(name)}"] = estimate[k]
            plain[0][f"largest error {name} [%]"] = error[k]
            words[0][f"{name}{bracketed_unit(name)}"] = number(estimate[k])
            for column in (f"error {name} [%]", f"largest error {name} [%]"):
                words[0][column] = number(error[k])
    return plain, [{name: row.get(name, MISSING) for name in like} for row in words]


def _common(values: Sequence[Any]) -> Any:
    """The value that all share, or all of them in one text."""
    texts = list(dict.fromkeys(factor_text(value) for value in values))
    return values[0] if len(texts) == 1 else ", ".join(texts)


def _setting(runs: list[Run], names: Sequence[str], group: list[Run]) -> tuple[Row, str]:
    """Factor columns of a group, and what in them is not the same throughout in a few words."""
    plain = {factor_label(name): group[0].factors.get(name) for name in names}
    return plain, setting_words(group[0], [n for n in names if n in varied_names(runs)])


def _starts(sweep: Sweep, runs: list[Run]) -> tuple[list[Row], list[Reading]]:
    """One row per filter mode and whatever else is varied besides the start."""
    names = [name for name in factor_names(sweep) if not name.startswith("start_") and name != SEED]
    rows, reading = [], []
    for group in grouped(runs, ["filter", *names]).values():
        plain, words = _setting(runs, names, group)
        if "filter" not in varied_names(runs):
            words = group[0].mode if words == "all runs" else f"{group[0].mode}, {words}"
        good, basin = converged(group), sum(in_basin(run) for run in group)
        row: Row = {"setting": words, **plain, "starts": len(group), "converged": len(good)}
        row[f"starts within {BASIN_PERCENT:g} %"] = basin
        text: Reading = {
            "setting": words,
            "starts": str(len(group)),
            "converged": str(len(good)),
            f"within {BASIN_PERCENT:g} %": f"{basin} of {len(group)}",
        }
        for k, name in enumerate(sweep.parameters):
            found = accuracy(group, k)
            row[f"estimate {name}{bracketed_unit(name)}"] = found.mean
            row[f"SD over starts {name}{bracketed_unit(name)}"] = found.spread
            row[f"largest error {name} [%]"] = found.worst_percent
            text[f"{name}{bracketed_unit(name)}"] = with_std(found.mean, found.spread)
            text[f"largest error {name} [%]"] = number(found.worst_percent)
        solves = spread_of([run.forward_solves for run in good])
        row["forward solves, median"], row["forward solves, max"] = solves["median"], solves["max"]
        text["forward solves, median (max)"] = (
            f"{number(solves['median'])} ({number(solves['max'])})"
        )
        rows.append(row)
        reading.append(text)
    return rows, reading


def _noise(sweep: Sweep, runs: list[Run]) -> tuple[list[Row], list[Reading]]:
    """One row per setting and parameter."""
    names = [name for name in factor_names(sweep) if name != SEED]
    units = {bracketed_unit(name) for name in sweep.parameters}
    mixed = len(units) > 1
    common = "" if mixed else units.pop()
    rows, reading = [], []
    for noise in noise_groups(runs):
        group, words = noise.runs, noise.label
        plain = {
            factor_label(name): _common([run.factors.get(name) for run in group]) for name in names
        }
        # Without noise every seed gives the same run, and there is nothing to cover.
        noisy = noise.level > 0
        for k, name in enumerate(sweep.parameters):
            found, levels = accuracy(group, k), [coverage(group, k, level) for level in LEVELS]
            verdicts = {
                WITHIN_BOUND: _within_bound(found) if noisy else "",
                IN_RANGE: verdict(levels[-1]) if noisy else "",
            }
            rows.append(
                {"setting": words, **plain, "parameter": name, **_accuracy_row(found, name)}
                | _coverage_row(levels)
                | verdicts
            )
            judged = [text or MISSING for text in verdicts.values()]
            reading.append(
                {
                    "setting": words,
                    "parameter": name,
                    "n": str(found.n) + (f" (+{found.failed} failed)" if found.failed else ""),
                    "RMSE / bound": with_std(found.ratio, found.ratio_std),
                    f"≤ {BOUND_FACTOR:g}": judged[0],
                    "95 % interval covers [%]": _share(levels[-1]),
                    f"{100 * COVERAGE_RANGE[0]:.0f}–{100 * COVERAGE_RANGE[1]:.0f} %": judged[1],
                }
                | _noise_reading(bracketed_unit(name) if mixed else "", common, found)
            )
    return rows, reading


def _accuracy_row(found: EstimateAccuracy, name: str) -> Row:
    unit = bracketed_unit(name)
    return {
        "runs": found.n,
        "failed": found.failed,
        f"estimate mean{unit}": found.mean,
        f"estimate SD{unit}": found.spread,
        f"bias{unit}": found.bias,
        f"RMSE{unit}": found.rmse,
        f"bound{unit}": found.bound,
        "bias [%]": found.bias_percent,
        "RMSE [%]": found.rmse_percent,
        "largest error [%]": found.worst_percent,
        "RMSE / bound": found.ratio,
        "SD of RMSE / bound": found.ratio_std,
    }


def _coverage_row(levels: Sequence[Coverage]) -> Row:
    row: Row = {}
    for level, found in zip(LEVELS, levels, strict=True):
        row[f"coverage of {100 * level:.0f} % [%]"] = 100 * found.share
        row[f"coverage of {100 * level:.0f} %, low [%]"] = 100 * found.low
        row[f"coverage of {100 * level:.0f} %, high [%]"] = 100 * found.high
    return row


def _within_bound(found: EstimateAccuracy) -> str:
    if np.isnan(found.ratio):
        return ""
    return "yes" if found.ratio <= BOUND_FACTOR else "no"


def _noise_reading(own: str, common: str, found: EstimateAccuracy) -> Reading:
    """Cells with a unit; it stands in the header if all parameters share it."""
    unit = own.strip().strip("[]")
    values = {
        "RMSE": number(found.rmse, 2),
        "bound": number(found.bound, 2),
        "bias": number(found.bias, 2),
        "estimate": with_std(found.mean, found.spread),
    }
    return {
        f"{name}{common}": text if text == MISSING else f"{text} {unit}".rstrip()
        for name, text in values.items()
    } | {"largest error [%]": number(found.worst_percent)}


def _share(found: Coverage) -> str:
    if found.n < 2:
        return MISSING
    return f"{100 * found.share:.0f} ({100 * found.low:.0f} to {100 * found.high:.0f})"


def _settings(sweep: Sweep, runs: list[Run]) -> tuple[list[Row], list[Reading]]:
    """One row per setting, whatever is varied."""
    names = [name for name in factor_names(sweep) if name != SEED]
    groups = grouped(runs, names)
    repeated = any(len(group) > 1 for group in groups.values())
    rows, reading = [], []
    for group in groups.values():
        plain, words = _setting(runs, names, group)
        good = converged(group)
        row: Row = {"setting": words, **plain, "runs": len(good), "failed": len(group) - len(good)}
        text: Reading = {"setting": words}
        if repeated:
            text["n"] = str(len(good))
        for k, name in enumerate(sweep.parameters):
            found, covered = accuracy(group, k), coverage(group, k)
            row[f"estimate {name}{bracketed_unit(name)}"] = found.mean
            row[f"SD over seeds {name}{bracketed_unit(name)}"] = found.spread
            row[f"std {name}{bracketed_unit(name)}"] = found.reported
            row[f"error {name} [%]"] = found.bias_percent
            row[f"RMSE {name} [%]"] = found.rmse_percent
            row[f"largest error {name} [%]"] = found.worst_percent
            text[f"{name}{bracketed_unit(name)}"] = with_std(found.mean, found.reported)
            error = found.rmse_percent if repeated else found.bias_percent
            text[f"{'RMSE' if repeated else 'error'} {name} [%]"] = number(error)
            if repeated:
                text[f"largest error {name} [%]"] = number(found.worst_percent)
                row[f"RMSE / bound {name}"] = found.ratio
                row[f"coverage of 95 % {name} [%]"] = 100 * covered.share
                row[f"coverage of 95 % {name}, low [%]"] = 100 * covered.low
                row[f"coverage of 95 % {name}, high [%]"] = 100 * covered.high
                text[f"coverage of 95 % {name} [%]"] = _share(covered)
            else:
                row[f"truth within 95 % interval {name}"] = _yes(covered)
                text[f"within 95 % {name}"] = _yes(covered) or MISSING
        known = [run.distance for run in good if run.distance is not None]
        distance = spread_of([d.mean for d in known])["mean"]
        spread = spread_of([d.std for d in known])["mean"]
        solves = spread_of([run.forward_solves for run in good])["mean"]
        reasons = _reasons(group)
        row |= {
            "distance mean [mm]": distance,
            "distance SD [mm]": spread,
            "forward solves": solves,
            "failures": reasons,
        }
        text |= {
            "distance [mm]": with_std(distance, spread),
            "forward solves": number(solves),
            "failures": reasons or MISSING,
        }
        rows.append(row)
        reading.append(text)
    if all(text["failures"] == MISSING for text in reading):
        for text in reading:
            del text["failures"]
    return rows, reading


def _yes(found: Coverage) -> str:
    return "" if not found.n else "yes" if found.inside == found.n else "no"


def _reasons(runs: Sequence[Run]) -> str:
    counts = Counter(run.ended for run in runs if not run.converged)
    return "; ".join(f"{n} x {reason}" if n > 1 else reason for reason, n in counts.items())


def failure_rows(sweep: Sweep) -> list[Reading]:
    """What failed and why, one row for all seeds of a job that failed for the same reason."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs_of(sweep):
        if not run.converged:
            groups.setdefault((run.job, run.ended), []).append(run)
    return [
        {"run": lost[0].row, "seed": _seeds(lost), "reason": reason, "job": job}
        for (job, reason), lost in groups.items()
    ]


def _seeds(runs: Sequence[Run]) -> str:
    """Seeds in a few characters: ``1 to 40``, ``13, 26, 39``."""
    seeds = [run.seed for run in runs if run.seed is not None]
    if not seeds:
        return "all (no result)"
    if len(seeds) > 2 and seeds == list(range(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(str(seed) for seed in seeds)
