"""The runs of a collected sweep, and its tidy table: one row per run, failures included.

A job without any run (it was killed, it ran out of time) counts as one failed run.
Nothing here depends on when or where a run was made, so that equal results give equal files; times
stand in a table of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.common.records.estimates import SeedRun, Spread
from experiments.common.records.record import HASH_DIGITS
from experiments.common.records.report import bracketed_unit
from experiments.sweeps.collected import Cost, Sweep, SweepJob
from mvest.estimation.estimate import NOT_THE_POSTERIOR
from mvest.typing import FloatArray

__all__ = [
    "FACTORS",
    "Run",
    "cost_rows",
    "csv_text",
    "factor_label",
    "factor_names",
    "factor_text",
    "kind_of",
    "runs_of",
    "short_names",
    "sweep_line",
    "tidy_rows",
]

CONVERGED = "converged"
NUMBER_FORMAT = ".10g"
UNITS = {"mm": "mm", "mpa": "MPa", "mmhg": "mmHg", "s": "s", "percent": "%"}
"""Endings of factor names that say a unit."""
COVARIANCE_UNITS = {"P0": "filter coordinates²", "Q": "filter coordinates²", "R": "mm²"}
"""Coordinates are MPa, or their logarithms where the filter works in these."""


FACTORS: dict[str, tuple[set[str], ...]] = {
    "initial_guess": (set(),),
    "covariance": ({"varied", "scale"}, {"P0", "Q", "R"}),
    "noise": ({"kind", "noise_mm"},),
    "discrepancy": ({"discrepancy"}, {"truth"}),
    "filter": ({"filter"},),
}
"""Kinds of sweeps with tables and figures of their own, and the factors that these need (the first
set, or any other)."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a sweep; arrays are in the order of the sweep's parameters, NaN where absent.

    Attributes
    ----------
    factors : mapping
        What is varied, and its value here.
    seed : int or None
        None where a job left no run behind and does not say which seeds it had.
    mode : str
        Of the filter.
    cells : tuple of int
        Of the estimator's mesh; empty where a job does not say it.
    truth, start, estimate, std, bound : FloatArray
        ``(p,)`` MPa for moduli. ``bound`` is the Cramér–Rao standard deviation.
    iterates, iterate_std : FloatArray
        ``(i, p)``; empty where there is none.
    """

    job: str
    row: str
    factors: Mapping[str, Any]
    seed: int | None
    mode: str
    cells: tuple[int, ...]
    converged: bool
    reason: str
    truth: FloatArray
    start: FloatArray
    estimate: FloatArray
    std: FloatArray
    bound: FloatArray
    distance: Spread | None
    iterations: int | None
    forward_solves: int | None
    iterates: FloatArray
    iterate_std: FloatArray

    @property
    def ended(self) -> str:
        """Why it ended, without the numbers of the filter's check."""
        before, unlike, _ = self.reason.partition(NOT_THE_POSTERIOR)
        return before + unlike

    @property
    def error(self) -> FloatArray:
        """Signed error of each parameter in percent of the truth, ``(p,)``; NaN without either."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100.0 * (self.estimate - self.truth) / self.truth

    @property
    def largest_error(self) -> float:
        """Largest error without sign in percent; NaN if one is missing."""
        return float(np.max(np.abs(self.error)))


def runs_of(sweep: Sweep) -> list[Run]:
    """Every run in the order of the jobs and, within one, of its seeds.

    Seeds that a job was to run and left no result of (its ``seed`` and ``repeats`` say which) count
    as failed runs; a job that does not say so and has no result counts as one.
    """
    return [_run(sweep, job, run) for job in sweep.jobs for run in (*job.runs, *_lost(job))]


def _lost(job: SweepJob) -> list[SeedRun]:
    """Runs without a result, with the job's reason."""
    if job.seed is None:
        return [] if job.runs else [SeedRun(seed=None, status="failed", reason=job.reason)]
    left = {run.seed for run in job.runs}
    planned = range(job.seed, job.seed + job.repeats)
    return [
        SeedRun(seed=seed, status="failed", reason=job.reason)
        for seed in planned
        if seed not in left
    ]


def _run(sweep: Sweep, job: SweepJob, run: SeedRun) -> Run:
    p = len(sweep.parameters)
    return Run(
        job=job.hash,
        row=job.row,
        factors=job.factors,
        seed=run.seed,
        mode=factor_text(job.factors.get("filter") or job.filter),
        cells=job.model.cells if job.model else (),
        converged=run.converged,
        reason=run.reason or job.reason or "no reason given",
        truth=_values(job.truth, p),
        start=_values(job.initial, p),
        estimate=_values(run.estimate, p),
        std=_values(run.std, p),
        bound=_values(run.bound, p),
        distance=run.distance_mm,
        iterations=run.iterations,
        forward_solves=run.forward_solves,
        iterates=_table(run.iterates, p),
        iterate_std=_table(run.iterate_std, p),
    )


def _values(values: Sequence[float | None] | None, p: int) -> FloatArray:
    if values is None:
        return np.full(p, np.nan)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _table(rows: Sequence[Sequence[float | None]] | None, p: int) -> FloatArray:
    return np.array([_values(row, p) for row in rows or []], dtype=np.float64).reshape(-1, p)


def factor_names(sweep: Sweep) -> list[str]:
    """Names of everything varied, in the order in which the jobs bring them up."""
    return list(dict.fromkeys(name for job in sweep.jobs for name in job.factors))


def kind_of(sweep: Sweep) -> str:
    """The kind that decides on tables and figures, or nothing if its factors are not all there."""
    kinds = FACTORS.get(sweep.kind, ())
    complete = all(any(needed <= set(job.factors) for needed in kinds) for job in sweep.jobs)
    return sweep.kind if complete and kinds else ""


def factor_label(name: str) -> str:
    """A factor's name with its unit: ``noise_mm`` as ``noise [mm]``."""
    if name.startswith("start_"):
        return f"{name.replace('_', ' ')} [MPa]"
    if name in COVARIANCE_UNITS:
        return f"{name} [{COVARIANCE_UNITS[name]}]"
    stem, _, ending = name.rpartition("_")
    unit = UNITS.get(ending.lower())
    return f"{stem.replace('_', ' ')} [{unit}]" if stem and unit else name.replace("_", " ")


def factor_text(value: Any) -> str:
    """A factor's value as people write it."""
    return f"{value:g}" if isinstance(value, float) else "–" if value is None else str(value)


def short_names(parameters: Sequence[str]) -> list[str]:
    """Names for figures: the regions where all are the same modulus, full names otherwise."""
    kinds = {name.partition(".")[0] for name in parameters}
    return [name.partition(".")[2] or name if len(kinds) == 1 else name for name in parameters]


def sweep_line(sweep: Sweep) -> str:
    """Where a sweep comes from in one line, without anything that changes from day to day."""
    source = sweep.provenance
    # Jobs may come from several commits; without their word it is the one that collected them.
    commits = ", ".join(
        "unknown" if sha in (None, "None") else sha[:HASH_DIGITS]
        for sha in sweep.commits or (source.git.sha,)
    )
    commits += "+changes" if source.git.dirty else ""
    size = f", size {sweep.sweep['size']}" if sweep.sweep.get("size") else ""
    return (
        f"sweep_{sweep.name}: mvest {source.versions['mvest']}, commit {commits}, configuration "
        f"{source.config_hash[:HASH_DIGITS]}, mesh {source.mesh_hash[:HASH_DIGITS]}, "
        f"{len(sweep.jobs)} jobs{size}"
    )


def tidy_rows(sweep: Sweep) -> list[dict[str, Any]]:
    """One mapping per run: factors first, then plain numbers under names with their unit."""
    factors = factor_names(sweep)
    jobs = {job.hash: job for job in sweep.jobs}
    rows = []
    for run in runs_of(sweep):
        job, distance = jobs[run.job], run.distance
        row: dict[str, Any] = {factor_label(name): run.factors.get(name) for name in factors}
        fixed: dict[str, Any] = {
            "run": run.row,
            "job": run.job,
            "seed": run.seed,
            "status": CONVERGED if run.converged else "failed",
            "filter": job.filter,
            "element": None if job.model is None else job.model.element,
            "noise [mm]": None if job.model is None else job.model.noise_mm,
        }
        for k, name in enumerate(sweep.parameters):
            unit = bracketed_unit(name)
            fixed[f"truth {name}{unit}"] = run.truth[k]
            fixed[f"start {name}{unit}"] = run.start[k]
            for key, variance in (("P0", job.P0), ("Q", job.Q)):
                fixed[f"{key} {name} [filter coordinates²]"] = _diagonal(variance, k)
            fixed[f"estimate {name}{unit}"] = run.estimate[k]
            fixed[f"std {name}{unit}"] = run.std[k]
            fixed[f"Cramér–Rao bound {name}{unit}"] = run.bound[k]
            fixed[f"signed error {name} [%]"] = run.error[k]
        fixed |= {
            "R [mm²]": _diagonal(job.R, 0),
            "distance mean [mm]": None if distance is None else distance.mean,
            "distance SD [mm]": None if distance is None else distance.std,
            "distance max [mm]": None if distance is None else distance.max,
            "iterations": run.iterations,
            "forward solves": run.forward_solves,
            "reason": run.reason,
        }
        rows.append(row | {name: value for name, value in fixed.items() if name not in row})
    return rows


def _diagonal(value: Any, k: int) -> Any:
    """Entry k of a covariance's diagonal, given as one number, a diagonal or a matrix."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        entry = value[k] if k < len(value) else None
        return entry[k] if isinstance(entry, Sequence) else entry
    return value


def cost_rows(sweep: Sweep) -> list[dict[str, Any]]:
    """One mapping per job: its factors, runs, forward solves and seconds.

    The rest of a job is what is not estimation: the simulation of its truth, say, unless it was
    stored. Overhead is what is neither, where it was measured.
    """
    factors = factor_names(sweep)
    cost = {entry.hash: entry for entry in sweep.cost}
    rows = []
    for job in sweep.jobs:
        times = cost.get(job.hash, Cost(job.hash, None, None))
        seconds, total = times.seconds, times.seconds_total
        rest = None if seconds is None or total is None else total - seconds
        rows.append(
            {factor_label(name): job.factors.get(name) for name in factors}
            | {
                "run": job.row,
                "job": job.hash,
                "status": job.status,
                "seeds": len(job.runs),
                "forward solves of all seeds": sum(run.forward_solves or 0 for run in job.runs),
                "estimation [s]": seconds,
                "whole job [s]": total,
                "rest of the job [s]": rest,
                "overhead [s]": times.overhead,
            }
        )
    return rows


def csv_text(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str], notes: Sequence[str]
) -> str:
    """CSV with comment lines above it; a missing value is an empty cell."""
    cells = [[_cell(row.get(name)) for name in columns] for row in rows]
    above = "".join(f"# {' '.join(note.split())}\n" for note in notes)
    return above + pd.DataFrame(cells, columns=list(columns)).to_csv(index=False)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    if isinstance(value, float):
        return format(float(value), NUMBER_FORMAT)
    # A line break inside a cell would end the row for every simple reader.
    return " ".join(str(value).split()) if isinstance(value, str) else str(value)
