"""Files of a sweep: its runs as a tidy table, statistics by setting, figures, a page.

They follow from the collected sweep alone, not from when or where a run was made. So equal results
give equal files.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.common.progress import WIDTH
from experiments.common.records.writer import LONGEST, write_page
from experiments.sweeps.collected import Sweep
from mvest.errors import InputError
from mvest.estimation.estimate import NOT_THE_POSTERIOR
from mvest.problem.registration import unit_of
from mvest.reporting.tables import Column, Table, table

if TYPE_CHECKING:
    from pandas import DataFrame, Series

CONVERGED = "converged"

SEED = "seed"  # a factor of this name is a repetition and no setting
# With more settings of a single run each, different numbers count as repetitions.
MOST_SETTINGS = 150
Z95 = 1.959963984540054  # 97.5 % quantile of the normal distribution
# Endings of factor names that state a unit.
ENDINGS = {"mm": "mm", "mpa": "MPa", "mmhg": "mmHg", "s": "s", "percent": "%"}
# Filter coordinates are MPa, or logarithms where the filter works in them.
COVARIANCE = "filter coordinates²"
# A unit that may differ from row to row, and two columns.
UNIT, BOUND, ERROR = "unit of the parameter", "Cramér–Rao bound", "signed error"
# Units of factors without such an ending.
COVARIANCES = {"P0": COVARIANCE, "Q": COVARIANCE, "R": "mm²"}

COLUMNS = {
    **dict.fromkeys(("job", "seed", "status", "parameter"), ""), "true value": UNIT, "start": UNIT,
    "estimate": UNIT, "std": UNIT, "low": UNIT, "high": UNIT, BOUND: UNIT, ERROR: "%",
    "distance mean": "mm", "distance SD": "mm", "distance max": "mm", "iterations": "",
    "forward solves": "", "reason": "",
}  # fmt: skip
"""Columns of the tidy table after the factors, and their units."""

RENAMED = {
    "truth": "true value", "prior_mean": "start", "bound": BOUND, "relative_error": ERROR,
    "distance_mean": "distance mean", "distance_std": "distance SD",
    "distance_max": "distance max", "forward_solves": "forward solves",
}  # fmt: skip
"""Columns of `EstimateRecord.rows` -> their names here."""

STATISTICS: dict[str, tuple[Column, Callable[[DataFrame], Any]]] = {
    "estimate": (
        Column(UNIT, std="SD over runs", label="mean estimate ± SD over runs"),
        lambda good: good["estimate"].mean(),
    ),
    "SD over runs": (Column(UNIT), lambda good: good["estimate"].std()),
    "std": (Column(UNIT, label="SD stated by the filter"), lambda good: good["std"].mean()),
    "error": (Column("%", label="mean error", hidden=True), lambda good: good[ERROR].mean()),
    "median error": (Column("%"), lambda good: good[ERROR].median()),
    "RMSE": (Column("%"), lambda good: np.sqrt((good[ERROR] ** 2).mean())),
    "largest error": (Column("%"), lambda good: good[ERROR].abs().max()),
    "RMSE / bound": (
        Column(),
        lambda good: (
            np.sqrt(((good["estimate"] - good["true value"]) ** 2).mean())
            / (good[BOUND].mean() or np.nan)
        ),
    ),
    "coverage": (
        Column("%", ".0f", low="coverage, low", high="coverage, high",
               label="95 % intervals that hold"),
        lambda good: _coverage(good)[0],
    ),
    "coverage, low": (Column("%"), lambda good: _coverage(good)[1]),
    "coverage, high": (Column("%"), lambda good: _coverage(good)[2]),
    "distance mean": (Column("mm", hidden=True), lambda good: good["distance mean"].mean()),
    "distance SD": (Column("mm", hidden=True), lambda good: good["distance SD"].mean()),
    "forward solves": (Column(), lambda good: good["forward solves"].mean()),
    "forward solves, median": (Column(hidden=True), lambda good: good["forward solves"].median()),
    "forward solves, max": (Column(hidden=True), lambda good: good["forward solves"].max()),
}  # fmt: skip
"""Column -> its meaning, and its value for the converged runs of a setting."""

CAPTIONS = {"": "Errors and intervals along each factor.", "matrix": "Errors over two factors."}
"""End of the file name of a figure -> its caption."""


SHOWN = ("setting", "parameter", "runs", "failed", "estimate", "median error", "largest error")
"""Columns of the table by settings for a terminal."""


def factors_of(sweep: Sweep) -> dict[str, tuple[str, str]]:
    """Factor -> its column and unit: ``noise_mm`` -> ``noise`` and mm."""
    found = {}
    for name in sweep.factors:
        stem, _, ending = name.rpartition("_")
        unit = ENDINGS.get(ending.lower(), "") if stem else ""
        label = (stem if unit else name).replace("_", " ")
        unit = "MPa" if name.startswith("start_") else unit
        if label in COLUMNS and name != SEED:
            label = f"{label} (factor)"
        found[name] = (label, COVARIANCES.get(name, unit))
    return found


def runs_of(sweep: Sweep) -> Table:
    """A row for each parameter of each run (job and seed), failed ones included, factors first.

    Errors are signed, in percent of the truth. An interval that the record does not state is the
    estimate ± 1.96 standard deviations. Of a lost run only its factors are known.
    """
    factors = factors_of(sweep)
    units = {**dict(factors.values()), **COLUMNS}
    rows = []
    for job in sweep.jobs:
        varied = {column: job.record.factors.get(name) for name, (column, _) in factors.items()}
        rows += [
            {"job": job.hash, **_cells(row), **varied} for run in job.runs for row in run.rows()
        ]
    return _table(sweep, rows, {name: Column(unit) for name, unit in units.items()})


def _table(sweep: Sweep, rows: list[dict[str, Any]], about: dict[str, Column]) -> Table:
    """A table of these columns, with the unit of the parameters if they have only one."""
    units = {unit_of(name) for name in sweep.parameters}
    if len(units) == 1:
        unit = units.pop()
        about = {k: replace(c, unit=unit) if c.unit == UNIT else c for k, c in about.items()}
    return table([{name: row.get(name) for name in about} for row in rows], **about)


def _cells(row: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of a parameter from its row of a record."""
    cells = {RENAMED.get(name, name): value for name, value in row.items()}
    estimate, std, error = (cells.get(name) for name in ("estimate", "std", ERROR))
    if cells.get("low") is None and estimate is not None and std is not None:
        cells |= {"low": estimate - Z95 * std, "high": estimate + Z95 * std}
    cells[ERROR] = None if error is None else 100.0 * error
    cells["reason"] = "" if row["status"] == CONVERGED else row["reason"]
    return cells


def shortened(whole: Table) -> Table:
    """The table with ten significant digits of every number, and each text in one line."""

    def short(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.10g}")
        return " ".join(value.split()) if isinstance(value, str) else value

    values = {name: list(map(short, column)) for name, column in whole.values.items()}
    return Table(values, whole.columns)


def good_of(runs: DataFrame) -> DataFrame:
    """The rows of converged runs, with numbers as floats."""
    numbers = [name for name in runs if COLUMNS.get(str(name)) in (UNIT, "%", "mm")]
    good = runs[(runs["status"] == CONVERGED) & runs["estimate"].notna()]
    return good.astype(dict.fromkeys([*numbers, "forward solves"], float))


def values_of(sweep: Sweep, runs: DataFrame) -> dict[str, list[Any]]:
    """Column of each varied factor -> its values, numbers in increasing order."""
    found = {}
    for name, (column, _) in factors_of(sweep).items():
        values = list(dict.fromkeys(runs[column].dropna()))
        if name != SEED and len(values) > 1:
            found[column] = sorted(values) if is_number(values) else values
    return found


def is_number(values: Sequence[Any]) -> bool:
    """Whether all values are numbers."""
    return all(isinstance(v, int | float | np.number) and not isinstance(v, bool) for v in values)


def by_setting(sweep: Sweep) -> Table:
    """Statistics of each parameter in each setting, below the paper's numbers if there are any.

    Failed runs are counted and enter no other number. If there are very many settings with a single
    run each, runs that differ only in numbers count as repetitions of a setting.
    """
    runs = runs_of(sweep).frame
    units = {column: unit for name, (column, unit) in factors_of(sweep).items() if name != SEED}
    # Jobs that differ in their seeds are repetitions of one setting.
    names = list(units) or ([] if sweep.factors else ["job"])
    single = runs.groupby([*names, "parameter"], sort=False, dropna=False).size().max() == 1
    if single and len(runs) > MOST_SETTINGS * len(sweep.parameters):
        names = [name for name in names if not is_number(list(runs[name].dropna()))]
    varied = [name for name in names if runs[name].nunique(dropna=False) > 1]
    rows: list[dict[str, Any]] = []
    if sweep.paper is not None:
        none = [None] * len(sweep.parameters)
        found = (sweep.paper.get(key) or none for key in ("estimate", "error_percent"))
        rows = [
            {"setting": f"paper, {sweep.paper['table']}", "parameter": name,
             "estimate": estimate, "largest error": error}
            for name, estimate, error in zip(sweep.parameters, *found, strict=True)
        ]  # fmt: skip
    for _, group in runs.groupby([*names, "parameter"], sort=False, dropna=False):
        first = group.iloc[0]
        words = {"setting": _words(first, varied, units), "parameter": first["parameter"]}
        rows.append({**words, **{name: first[name] for name in names}, **_statistics(group)})

    about = {
        "setting": Column(),
        "parameter": Column(),
        **{name: Column(units.get(name, ""), hidden=True) for name in names},
        "runs": Column(),
        "failed": Column(),
        **{name: column for name, (column, _) in STATISTICS.items()},
        "failures": Column(hidden=not any(row.get("failures") for row in rows)),
    }
    return _table(sweep, rows, about)


def _words(run: Series[Any], names: Sequence[str], units: Mapping[str, str]) -> str:
    """A run's values of some factors: texts, and numbers with name and unit."""
    words = []
    for name in names:
        value, unit = run[name], units.get(name, "")
        if isinstance(value, str):
            words.append(value)
        elif value == value and value is not None:
            text = f"{value:g}" if isinstance(value, float) else str(value)
            words.append(f"{name} {text} {'' if unit == COVARIANCE else unit}".rstrip())
    return ", ".join(words) or "all runs"


def _statistics(runs: DataFrame) -> dict[str, Any]:
    """Numbers of a parameter in a group of runs; NaN or None without converged runs."""
    good = good_of(runs)
    lost = runs.drop(good.index)["reason"]
    # Without the numbers of the filter's check.
    reasons = Counter("".join(reason.partition(NOT_THE_POSTERIOR)[:2]) for reason in lost)
    return {
        "runs": len(good),
        "failed": len(lost),
        **{name: number(good) for name, (_, number) in STATISTICS.items()},
        "failures": "; ".join(f"{n} x {text}" if n > 1 else text for text, n in reasons.items()),
    }


def _coverage(good: DataFrame) -> tuple[float | None, float | None, float | None]:
    """Share (%) of intervals that contain the truth, and its 95 % interval (Wilson)."""
    from scipy.stats import binomtest

    low, truth, high = good[["low", "true value", "high"]].dropna().to_numpy(dtype=np.float64).T
    if not truth.size:
        return None, None, None
    inside = int(((low <= truth) & (truth <= high)).sum())
    ends = binomtest(inside, truth.size).proportion_ci(confidence_level=0.95, method="wilson")
    return 100.0 * inside / truth.size, 100.0 * float(ends.low), 100.0 * float(ends.high)


def text_of(sweep: Sweep) -> str:
    """The table of a sweep for a terminal, at most 100 characters wide."""
    from pandas import DataFrame

    table = by_setting(sweep)
    if len(table) > LONGEST:
        return f"{len(table)} settings and parameters: too many for a terminal"
    shown = {name: table.values[name] for name in (*SHOWN, "SD over runs")}
    label = {"estimate": replace(table.columns["estimate"], label="estimate ± SD")}
    readable = replace(table, values=shown, columns={**table.columns, **label}).readable()
    return str(DataFrame(readable).to_string(index=False, line_width=WIDTH))


def write_sweep(results: Path, sweep: Sweep) -> list[Path]:
    """Write the tables and figures of one sweep into an existing folder; returns their paths.

    ``sweep_NAME.csv`` has a row for each run, ``sweep_NAME_table.csv`` and ``.tex`` a row for each
    setting, ``sweep_NAME.md`` is the page.

    Raises an `InputError` if its name cannot name a file, or a file cannot be written.
    """
    if not re.fullmatch(r"[\w-]+", sweep.name):
        raise InputError(f"a sweep's name must be letters, digits, - and _, not {sweep.name!r}")
    from experiments.sweeps.figures import figures_of

    base, drawn = results / f"sweep_{sweep.name}", figures_of(sweep)
    for part in CAPTIONS.keys() - drawn:
        name = f"{base.name}_{part}" if part else base.name
        if (older := base.with_name(f"{name}.png")).is_file():
            older.unlink()  # it would contradict the tables
    return write_page(
        base,
        sweep.title,
        {"": shortened(runs_of(sweep))},
        {"table": shortened(by_setting(sweep))},
        sweep.records,
        figures=drawn,
        captions=CAPTIONS,
        latex=(f"{base.name}_table",),
    )
