"""One table of all estimates of a folder: a row for each parameter of each case and seed.

It is made for programs of statistics: one type and one stated unit a column (`COLUMNS`, written
beside it as a data dictionary), failures as rows without numbers, nothing aggregated.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.common.records.estimates import SeedRun, Spread
from experiments.common.records.record import Provenance, require_written
from experiments.runner.jobs.compared import compared
from experiments.sweeps.collected import Sweep, check_sweep
from mvest.errors import InputError, cannot_write
from mvest.files import write_atomically
from mvest.problem.registration import unit_of
from mvest.provenance import require_sealed
from mvest.reading.json_file import read_mapping

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["COLUMNS", "Column", "estimate_table", "sweep_table", "write_estimates"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table.

    Attributes
    ----------
    name : str
    kind : {"text", "integer", "number", "truth value"}
    unit : str
        Empty for what has none; ``as unit`` where the column ``unit`` says it.
    meaning : str
    """

    name: str
    kind: str
    unit: str
    meaning: str


AS_UNIT = "as unit"
_TYPES = {"text": "string", "integer": "Int64", "number": "float64", "truth value": "boolean"}

COLUMNS = (
    Column("record", "text", "", "file of the run or sweep, from the folder of all of them"),
    Column("job", "text", "", "hash of the job within a sweep"),
    Column("study", "text", "", "kind of study; sweep for a sweep"),
    Column("experiment", "text", "", "name of the experiment or sweep"),
    Column("row", "text", "", "what tables call the case or job"),
    Column("factors", "text", "", "JSON of what a sweep varies, with its value in this job"),
    Column("simulated", "truth value", "", "whether the case's frames are stated as simulated"),
    Column("gate", "text", "", "whether the anatomy is known to have one closed state"),
    Column("seed", "integer", "", "of the random errors, or of a drawn case"),
    Column("status", "text", "", "converged or failed"),
    Column("reason", "text", "", "why the estimation ended"),
    Column("verdict", "text", "", "how far the estimate of a case may be believed"),
    Column("parameter", "text", "", "what is estimated, E_f.anterior say; empty of a lost job"),
    Column("unit", "text", "", "unit of the parameter; empty for factors"),
    Column("kind", "text", "", "modulus or nuisance, where the record says it"),
    Column("treatment", "text", "", "estimated, considered or fixed, where the record says it"),
    Column("prior_mean", "number", AS_UNIT, "mean of the prior"),
    Column("prior_std", "number", AS_UNIT, "standard deviation of the prior"),
    Column("estimate", "number", AS_UNIT, "estimate"),
    Column("std", "number", AS_UNIT, "its standard deviation"),
    Column("low", "number", AS_UNIT, "lower end of its 95 % interval"),
    Column("high", "number", AS_UNIT, "upper end of its 95 % interval"),
    Column("truth", "number", AS_UNIT, "true value, of simulated cases"),
    Column("relative_error", "number", "1", "(estimate - truth) / truth"),
    Column("bound", "number", AS_UNIT, "Cramér-Rao standard deviation: of the data alone"),
    Column("distance_mean", "number", "mm", "mean distance of fitted from observed vertices"),
    Column("distance_std", "number", "mm", "standard deviation of these distances"),
    Column("distance_max", "number", "mm", "largest of these distances"),
    Column("nis", "number", "1", "normalised innovation squared of the whole frame"),
    Column("iterations", "integer", "", "of the filter"),
    Column("forward_solves", "integer", "", "runs of the model for this estimate"),
    Column("seconds", "number", "s", "wall-clock time of this estimate"),
    Column("seconds_of_job", "number", "s", "wall-clock time of its whole job, all seeds together"),
    Column("overhead_of_job", "number", "s", "of that, neither simulating nor estimating"),
    Column("config_sha256", "text", "", "of the configuration"),
    Column("mesh_sha256", "text", "", "of the estimator's mesh"),
    Column("commit", "text", "", "of the code that computed it"),
    Column("changed", "truth value", "", "whether tracked files differed from the commit"),
    Column("version", "text", "", "of mvest"),
)  # fmt: skip
"""All columns, in their order."""

DICTIONARY = "column,type,unit,meaning"


def estimate_table(folder: Path) -> DataFrame:
    """The estimates of all records and sweeps below a folder.

    Raises
    ------
    InputError
        If there is none, or a file is damaged or not as it was written.
    """
    rows = [row for path in _files(folder) for row in _rows_of_file(path, folder)]
    if not rows:
        raise InputError(f"{folder}: no record of a run or sweep that holds estimates")
    return _typed(rows)


def sweep_table(sweep: Sweep) -> DataFrame:
    """The estimates of a collected sweep; a row without numbers for a lost job."""
    return _typed(list(_sweep_rows(sweep)))


def write_estimates(folder: Path, target: Path) -> list[Path]:
    """Write the table of a folder (``.csv`` or ``.parquet``), and its data dictionary beside it.

    Raises
    ------
    InputError
        As `estimate_table`; or the name ends otherwise, or a file cannot be written.
    """
    if target.suffix not in (".csv", ".parquet"):
        raise InputError(f"{target}: expected a name that ends with .csv or .parquet")
    table = estimate_table(folder)
    content = table.to_csv(index=False) if target.suffix == ".csv" else table.to_parquet()
    dictionary = target.with_suffix(".columns.csv")
    lines = [f'{c.name},{c.kind},{c.unit},"{c.meaning}"' for c in COLUMNS]
    try:
        written = [write_atomically(target, content)]
        return [*written, write_atomically(dictionary, "\n".join([DICTIONARY, *lines, ""]))]
    except OSError as error:
        raise cannot_write(target, error) from error


def _files(folder: Path) -> list[Path]:
    """Records and sweeps: of the published results, or of runs; a sweep stands for its jobs."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder")
    kept = [*folder.glob("records/*/*.json"), *folder.glob("sweeps/*.json")]
    if kept:
        return sorted(kept)
    sweeps = sorted(folder.rglob("sweep.json"))
    whole = {path.parent for path in sweeps}
    runs = [path for path in folder.rglob("result.json") if not whole & set(path.parents)]
    return sorted([*sweeps, *runs])


def _rows_of_file(path: Path, folder: Path) -> Iterator[dict[str, Any]]:
    data = read_mapping(path)
    if "jobs" in data:
        sweep = check_sweep(data, str(path))
        require_sealed(data, str(path))
        rows = _sweep_rows(sweep)
    else:
        require_written(data, path)
        rows = _record_rows(data, str(path))
    place = path.relative_to(folder).as_posix()
    yield from ({"record": place, **row} for row in rows)


def _record_rows(data: Mapping[str, Any], where: str) -> Iterator[dict[str, Any]]:
    record = compared(data, where)
    found = data.get("findings") or {}
    case = found.get("case") or {}
    unknowns = {row["name"]: row for row in (case or found).get("unknowns") or ()}
    # A study of volumes knows the truth of moduli beside what a page of a case says of them.
    unknowns |= {row["modulus"]["name"]: row["modulus"] for row in _of_volume(found)}
    if not ({"estimate", "repeats"} & set(found) or record.findings.died):
        return
    common = {
        "study": record.study,
        "experiment": record.experiment,
        "row": record.row,
        "factors": _json(record.factors),
        "simulated": (case.get("about") or {}).get("simulated"),
        "gate": record.gate,
        "verdict": record.findings.verdict,
        "seconds_of_job": record.seconds_total,
        **_origin(record.provenance, record.provenance.mesh_hash),
    }
    truth = found.get("truth")
    for run in record.findings.repeats:
        yield from _run_rows(common, run, record.parameters, truth, unknowns)


def _of_volume(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    rows = [row for row in found.get("rows") or () if isinstance(row, Mapping) and "modulus" in row]
    return rows if len({row.get("patient") for row in rows}) == 1 else []


def _sweep_rows(sweep: Sweep) -> Iterator[dict[str, Any]]:
    costs = {cost.hash: cost for cost in sweep.cost}
    for job in sweep.jobs:
        cost = costs[job.hash]
        common = {
            "job": job.hash,
            "study": "sweep",
            "experiment": sweep.name,
            "row": job.row,
            "factors": _json(job.factors),
            "seconds_of_job": cost.seconds_total,
            "overhead_of_job": cost.overhead,
            **_origin(sweep.provenance, None),
        }
        for run in job.runs or (SeedRun(seed=job.seed, status=job.status, reason=job.reason),):
            yield from _run_rows(common, run, sweep.parameters, job.truth, {})


def _origin(source: Provenance, mesh: str | None) -> dict[str, Any]:
    return {
        "config_sha256": source.config_hash,
        "mesh_sha256": mesh,
        "commit": source.git.sha,
        "changed": source.git.dirty,
        "version": source.versions.get("mvest"),
    }


def _run_rows(
    common: Mapping[str, Any],
    run: SeedRun,
    parameters: Sequence[str],
    truth: Any,
    unknowns: Mapping[str, Mapping[str, Any]],
) -> Iterator[dict[str, Any]]:
    """A row for each parameter of an estimate; one alone where nothing is known of any."""
    names = list(dict.fromkeys([*parameters, *unknowns]))
    whole = {
        **common,
        "seed": run.seed,
        "status": run.status,
        "reason": " ".join(run.reason.split()),
        **{f"distance_{name}": value for name, value in _spread(run.distance_mm).items()},
        "nis": run.nis,
        "iterations": run.iterations,
        "forward_solves": run.forward_solves,
        "seconds": run.seconds,
    }
    if not names:
        yield whole
    for k, name in enumerate(names):
        known = unknowns.get(name, {})
        row = {
            "parameter": name,
            "unit": known.get("unit", unit_of(name)),
            "estimate": _entry(run.estimate, k, len(parameters)),
            "std": _entry(run.std, k, len(parameters)),
            "truth": _entry(truth, k, len(parameters)),
            "relative_error": _entry(run.relative_error, k, len(parameters)),
            "bound": _entry(run.bound, k, len(parameters)),
        }
        row |= {c: known[c] for c in UNKNOWN if known.get(c) is not None}
        if row["relative_error"] is None and row["estimate"] is not None and row["truth"]:
            row["relative_error"] = row["estimate"] / row["truth"] - 1.0
        yield whole | row


UNKNOWN = (
    "kind",
    "treatment",
    "prior_mean",
    "prior_std",
    "estimate",
    "std",
    "low",
    "high",
    "truth",
)
"""Columns that the page of a case states of each unknown."""


def _spread(distance: Spread | None) -> dict[str, float]:
    return {} if distance is None else asdict(distance)


def _entry(values: Any, k: int, count: int) -> Any:
    """Entry k of the values of so many parameters; None where there are not as many."""
    fits = isinstance(values, Sequence) and len(values) == count and k < count
    return values[k] if fits else None


def _json(factors: Mapping[str, Any]) -> str | None:
    return json.dumps(dict(factors), ensure_ascii=False) if factors else None


def _typed(rows: Sequence[Mapping[str, Any]]) -> DataFrame:
    from pandas import DataFrame, Series

    return DataFrame(
        {
            column.name: Series([row.get(column.name) for row in rows], dtype=_TYPES[column.kind])
            for column in COLUMNS
        }
    )
