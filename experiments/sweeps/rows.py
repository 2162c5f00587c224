"""The runs of a collected sweep, and its tidy table: one row per run, failures included.

A sweep is the content of ``sweep.json``: jobs that differ in their *factors*, each with one run per
seed. A job without any run (it was killed, it ran out of time) counts as one failed run.
Nothing here depends on when or where a run was made, so that equal results give equal files; times
stand in a table of their own.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.reporting.files import HASH_DIGITS
from mvest.typing import FloatArray

__all__ = [
    "FACTORS",
    "Run",
    "Sweep",
    "check_sweep",
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
    "unit_of",
]

Sweep = Mapping[str, Any]
"""The content of a ``sweep.json``."""

REQUIRED = ("schema", "sweep", "title", "parameters", "provenance", "jobs", "cost")
REQUIRED_OF_JOB = ("hash", "row", "factors", "status", "reason", "runs")
SCHEMA = 1
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
    converged: bool
    reason: str
    truth: FloatArray
    start: FloatArray
    estimate: FloatArray
    std: FloatArray
    bound: FloatArray
    distance: Mapping[str, Any]
    iterations: int | None
    forward_solves: int | None
    iterates: FloatArray
    iterate_std: FloatArray

    @property
    def error(self) -> FloatArray:
        """Signed error of each parameter in percent of the truth, ``(p,)``; NaN without either."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100.0 * (self.estimate - self.truth) / self.truth

    @property
    def largest_error(self) -> float:
        """Largest error without sign in percent; NaN if one is missing."""
        return float(np.max(np.abs(self.error)))


def check_sweep(sweep: Any, where: str) -> Sweep:
    """The mapping itself, if it has the layout of a collected sweep.

    Raises
    ------
    InputError
        Naming ``where`` it comes from and what it lacks.
    """
    if not isinstance(sweep, Mapping):
        raise InputError(f"{where} is no collected sweep but a {type(sweep).__name__}")
    missing = [key for key in REQUIRED if key not in sweep]
    if missing:
        raise InputError(f"{where} is no collected sweep: it lacks {', '.join(missing)}")
    if sweep["schema"] != SCHEMA:
        raise InputError(f"{where} has schema {sweep['schema']}; this version reads {SCHEMA}")
    if not isinstance(sweep["sweep"], Mapping) or not {"name", "kind"} <= set(sweep["sweep"]):
        raise InputError(f"{where}: `sweep` must say its name and its kind")
    for k, job in enumerate(sweep["jobs"]):
        lacks = [key for key in REQUIRED_OF_JOB if not isinstance(job, Mapping) or key not in job]
        if lacks:
            raise InputError(f"{where}: job {k} lacks {', '.join(lacks)}")
        for run in job["runs"]:
            for key in ("estimate", "std", "bound"):
                values = run.get(key)
                if values is not None and len(values) != len(sweep["parameters"]):
                    raise InputError(
                        f"{where}: job {job['hash']}, seed {run.get('seed')}: {key} has "
                        f"{len(values)} values for {len(sweep['parameters'])} parameters"
                    )
    return sweep


def runs_of(sweep: Sweep) -> list[Run]:
    """Every run in the order of the jobs and, within one, of its seeds.

    Seeds that a job was to run and left no result of (its ``seed`` and ``repeats`` say which) count
    as failed runs; a job that does not say so and has no result counts as one.
    """
    return [_run(sweep, job, run) for job in sweep["jobs"] for run in [*job["runs"], *_lost(job)]]


def _lost(job: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Runs without a result, with the job's reason."""
    nothing = {"status": "failed", "reason": job["reason"]}
    if job.get("seed") is None:
        return [] if job["runs"] else [nothing]
    planned = range(job["seed"], job["seed"] + job.get("repeats", 1))
    found = {run.get("seed") for run in job["runs"]}
    return [nothing | {"seed": seed} for seed in planned if seed not in found]


def _run(sweep: Sweep, job: Mapping[str, Any], found: Mapping[str, Any]) -> Run:
    p = len(sweep["parameters"])
    return Run(
        job=str(job["hash"]),
        row=str(job["row"]),
        factors=job["factors"],
        seed=found.get("seed"),
        mode=factor_text(job["factors"].get("filter") or _filter_of(job)),
        converged=found.get("status") == CONVERGED,
        reason=str(found.get("reason") or job["reason"] or "no reason given"),
        truth=_values(job.get("truth"), p),
        start=_values(job.get("initial"), p),
        estimate=_values(found.get("estimate"), p),
        std=_values(found.get("std"), p),
        bound=_values(found.get("bound"), p),
        distance=found.get("distance_mm") or {},
        iterations=found.get("iterations"),
        forward_solves=found.get("forward_solves"),
        iterates=_table(found.get("iterates"), p),
        iterate_std=_table(found.get("iterate_std"), p),
    )


def _values(values: Sequence[float | None] | None, p: int) -> FloatArray:
    if values is None:
        return np.full(p, np.nan)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _table(rows: Sequence[Sequence[float | None]] | None, p: int) -> FloatArray:
    return np.array([_values(row, p) for row in rows or []], dtype=np.float64).reshape(-1, p)


def factor_names(sweep: Sweep) -> list[str]:
    """Names of everything varied, in the order in which the jobs bring them up."""
    return list(dict.fromkeys(name for job in sweep["jobs"] for name in job["factors"]))


def kind_of(sweep: Sweep) -> str:
    """The kind that decides on tables and figures, or nothing if its factors are not all there."""
    kind = str(sweep["sweep"]["kind"])
    complete = all(
        any(needed <= set(job["factors"]) for needed in FACTORS.get(kind, ()))
        for job in sweep["jobs"]
    )
    return kind if complete and kind in FACTORS else ""


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


def unit_of(parameter: str) -> str:
    """`` [MPa]`` for a modulus, nothing for any other parameter."""
    return " [MPa]" if parameter.startswith("E_f.") else ""


def short_names(parameters: Sequence[str]) -> list[str]:
    """Names for figures: the regions where all are the same modulus, full names otherwise."""
    kinds = {name.partition(".")[0] for name in parameters}
    return [name.partition(".")[2] or name if len(kinds) == 1 else name for name in parameters]


def sweep_line(sweep: Sweep) -> str:
    """Where a sweep comes from in one line, without anything that changes from day to day."""
    source = sweep["provenance"]
    git, settings = source.get("git") or {}, sweep["sweep"]
    # Jobs may come from several commits; without their word it is the one that collected them.
    shas = source.get("commits") or [git.get("sha")]
    commits = ", ".join(
        "unknown" if sha in (None, "None") else str(sha)[:HASH_DIGITS] for sha in shas
    )
    commits += "+changes" if git.get("dirty") else ""
    version = (source.get("versions") or {}).get("mvest", "unknown")
    parts = [f"sweep_{settings['name']}: mvest {version}", f"commit {commits}"]
    for key, words in (("config_hash", "configuration"), ("mesh_hash", "mesh")):
        if source.get(key):
            parts.append(f"{words} {str(source[key])[:HASH_DIGITS]}")
    size = f", size {settings['size']}" if settings.get("size") else ""
    return ", ".join(parts) + f", {len(sweep['jobs'])} jobs{size}"


def tidy_rows(sweep: Sweep) -> list[dict[str, Any]]:
    """One mapping per run: factors first, then plain numbers under names with their unit."""
    factors, parameters = factor_names(sweep), sweep["parameters"]
    jobs = {str(job["hash"]): job for job in sweep["jobs"]}
    rows = []
    for run in runs_of(sweep):
        job = jobs[run.job]
        row: dict[str, Any] = {factor_label(name): run.factors.get(name) for name in factors}
        fixed: dict[str, Any] = {
            "run": run.row,
            "job": run.job,
            "seed": run.seed,
            "status": CONVERGED if run.converged else "failed",
            "filter": _filter_of(job),
            "element": (job.get("model") or {}).get("element"),
            "noise [mm]": (job.get("model") or {}).get("noise_mm"),
        }
        for k, name in enumerate(parameters):
            unit = unit_of(name)
            fixed[f"truth {name}{unit}"] = run.truth[k]
            fixed[f"start {name}{unit}"] = run.start[k]
            for key in ("P0", "Q"):
                fixed[f"{key} {name} [filter coordinates²]"] = _diagonal(job.get(key), k)
            fixed[f"estimate {name}{unit}"] = run.estimate[k]
            fixed[f"std {name}{unit}"] = run.std[k]
            fixed[f"Cramér–Rao bound {name}{unit}"] = run.bound[k]
            fixed[f"signed error {name} [%]"] = run.error[k]
        fixed |= {
            "R [mm²]": _diagonal(job.get("R"), 0),
            "distance mean [mm]": run.distance.get("mean"),
            "distance SD [mm]": run.distance.get("std"),
            "distance max [mm]": run.distance.get("max"),
            "iterations": run.iterations,
            "forward solves": run.forward_solves,
            "reason": run.reason,
        }
        rows.append(row | {name: value for name, value in fixed.items() if name not in row})
    return rows


def _filter_of(job: Mapping[str, Any]) -> Any:
    named = job.get("filter")
    return named.get("mode") if isinstance(named, Mapping) else named


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
    cost = {str(entry["hash"]): entry for entry in sweep["cost"]}
    rows = []
    for job in sweep["jobs"]:
        times = cost.get(str(job["hash"]), {})
        seconds, total = times.get("seconds"), times.get("seconds_total")
        known = seconds is not None and total is not None
        solves = [run["forward_solves"] for run in job["runs"] if run.get("forward_solves")]
        rows.append(
            {factor_label(name): job["factors"].get(name) for name in factors}
            | {
                "run": job["row"],
                "job": job["hash"],
                "status": job["status"],
                "seeds": len(job["runs"]),
                "forward solves of all seeds": sum(solves),
                "estimation [s]": seconds,
                "whole job [s]": total,
                "rest of the job [s]": total - seconds if known else None,
                "overhead [s]": times.get("overhead"),
            }
        )
    return rows


def csv_text(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str], notes: Sequence[str]
) -> str:
    """CSV with comment lines above it; a missing value is an empty cell."""
    stream = io.StringIO()
    for note in notes:
        stream.write(f"# {' '.join(note.split())}\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(row.get(name)) for name in columns])
    return stream.getvalue()


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    if isinstance(value, float):
        return format(float(value), NUMBER_FORMAT)
    # A line break inside a cell would end the row for every simple reader.
    return " ".join(str(value).split()) if isinstance(value, str) else str(value)
