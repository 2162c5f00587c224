"""One table of all estimates of a folder: a row for each parameter of each case and seed.

It is made for statistics programs: each column has one type and one stated unit (`COLUMNS`, also
written as a data dictionary), failures are rows without numbers, and nothing is aggregated.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.common.records.record import Record, read_record
from experiments.results.published import RECORDS, records_of
from experiments.sweeps.collected import SWEEPS, Sweep, read_sweep
from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.problem.record import EstimateRecord

if TYPE_CHECKING:
    from pandas import DataFrame

TYPES = {"text": "string", "integer": "Int64", "number": "float64", "truth value": "boolean"}

MLFLOW = {"mlartifacts", "mlruns"}  # folders of copies

COLUMNS: dict[str, tuple[str, str, str]] = {
    "record": ("text", "", "file of the run or sweep, from the folder of all of them"),
    "job": ("text", "", "hash of the job within a sweep"),
    "study": ("text", "", "kind of study"),
    "experiment": ("text", "", "name of the experiment or sweep"),
    "row": ("text", "", "what tables call the case or job"),
    "factors": ("text", "", "JSON of what a sweep varies, with its value in this job"),
    "simulated": ("truth value", "", "whether the case's frames are stated as simulated"),
    "gate": ("text", "", "whether the anatomy is known to have one closed state"),
    "seed": ("integer", "", "of the random errors, or of a drawn case"),
    "status": ("text", "", "converged or failed"),
    "reason": ("text", "", "why the estimation ended"),
    "verdict": ("text", "", "how far the estimate of a case may be believed"),
    "parameter": ("text", "", "what is estimated, E_f.anterior say; empty of a lost job"),
    "unit": ("text", "", "unit of the parameter; empty for factors"),
    "kind": ("text", "", "modulus, nuisance or derived"),
    "treatment": ("text", "", "always estimated"),
    "prior_mean": ("number", "as unit", "mean of the prior"),
    "prior_std": ("number", "as unit", "standard deviation of the prior"),
    "estimate": ("number", "as unit", "estimate"),
    "std": ("number", "as unit", "its standard deviation"),
    "low": ("number", "as unit", "lower end of its 95 % interval"),
    "high": ("number", "as unit", "upper end of its 95 % interval"),
    "truth": ("number", "as unit", "true value, of simulated cases"),
    "relative_error": ("number", "1", "(estimate - truth) / truth"),
    "bound": ("number", "as unit", "Cramér-Rao standard deviation: of the data alone"),
    "distance_mean": ("number", "mm", "mean distance of fitted from observed vertices"),
    "distance_std": ("number", "mm", "standard deviation of these distances"),
    "distance_max": ("number", "mm", "largest of these distances"),
    "nis": ("number", "1", "normalised innovation squared of the whole frame"),
    "iterations": ("integer", "", "of the filter"),
    "forward_solves": ("integer", "", "runs of the model for this estimate"),
    "seconds": ("number", "s", "wall-clock time of this estimate"),
    "seconds_of_job": ("number", "s", "wall-clock time of its whole job, all seeds together"),
    "config_sha256": ("text", "", "of the configuration"),
    "mesh_sha256": ("text", "", "of the estimator's mesh"),
    "commit": ("text", "", "of the code that computed it"),
    "changed": ("truth value", "", "whether tracked files differed from the commit"),
    "version": ("text", "", "of mvest"),
}
"""Column -> type, unit and meaning; ``as unit`` where the column ``unit`` says it."""


def estimate_table(folder: Path) -> DataFrame:
    """The estimates of all records and sweeps below a folder of runs, or of published results.

    A file that is unreadable, foreign or changed costs a line of warning. MLflow's copies are left
    out.

    Raises an `InputError` if there is none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder")
    rows: list[dict[str, Any]] = []
    tables = sorted((folder / RECORDS).glob("*.jsonl"))
    published = sorted((folder / SWEEPS).glob("*.json"))
    sweeps, runs = (
        [path for path in sorted(folder.rglob(name)) if not MLFLOW & set(path.parts)]
        for name in ("sweep.json", "result.json")
    )
    if tables or published:
        sweeps, runs = published, []
    whole: set[Path] = set()  # folders of sweeps, which stand for their jobs
    for path in [*tables, *sweeps, *runs]:
        place = path.relative_to(folder).as_posix()
        try:
            if path in tables:
                for name, record in records_of(folder, path.stem).records.items():
                    rows += _rows(record, f"{place}#{name}")
            elif path in sweeps:
                rows += _of_sweep(read_sweep(path), place)
                whole.add(path.parent)
            elif not whole & set(path.parents):
                rows += _rows(read_record(path), place)
        except InputError as error:
            print(f"warning: left out: {error}", file=sys.stderr)
    if not rows:
        raise InputError(f"{folder}: no record of a run or sweep that holds estimates")
    return _typed(rows)


def sweep_table(sweep: Sweep) -> DataFrame:
    """The estimates of a collected sweep, with a row without numbers for a lost job."""
    return _typed(_of_sweep(sweep))


def write_estimates(folder: Path, target: Path) -> list[Path]:
    """Write the table of a folder (``.csv`` or ``.parquet``), and its data dictionary next to it.

    Raises an `InputError` as `estimate_table`; or the name ends otherwise, or a file cannot be
    written.
    """
    if target.suffix not in (".csv", ".parquet"):
        raise InputError(f"{target}: expected a name that ends with .csv or .parquet")
    table = estimate_table(folder)
    content = table.to_csv(index=False) if target.suffix == ".csv" else table.to_parquet()
    lines = [f'{name},{kind},{unit},"{text}"' for name, (kind, unit, text) in COLUMNS.items()]
    dictionary = "\n".join(["column,type,unit,meaning", *lines, ""])
    return [
        write_atomically(target, content),
        write_atomically(target.with_suffix(".columns.csv"), dictionary),
    ]


def _of_sweep(sweep: Sweep, place: str | None = None) -> list[dict[str, Any]]:
    return [row for job in sweep.jobs for row in _rows(job.record, place, job=job.hash)]


def _rows(record: Record, place: str | None, **more: Any) -> Iterator[dict[str, Any]]:
    """A row for each unknown of each estimate; one row for a run that failed as a whole."""
    source = record.provenance
    common = more | {
        "record": place,
        "study": record.study,
        "experiment": record.experiment,
        "row": record.row,
        "factors": json.dumps(record.factors, ensure_ascii=False) if record.factors else None,
        "gate": record.gate,
        "seconds_of_job": record.seconds_total,
        "config_sha256": source.config_hash,
        "mesh_sha256": source.mesh_hash,
        "commit": source.git.sha,
        "changed": source.git.dirty,
        "version": source.versions.get("mvest"),
    }
    lost = EstimateRecord(seed=source.seed, status="failed", reason=record.reason)
    for estimate in record.estimates or (() if record.converged else (lost,)):
        for row in estimate.rows():
            yield {**common, **row, "reason": " ".join(row["reason"].split())}


def _typed(rows: list[dict[str, Any]]) -> DataFrame:
    from pandas import DataFrame

    kinds = {name: TYPES[kind] for name, (kind, _, _) in COLUMNS.items()}
    return DataFrame(rows, columns=list(COLUMNS), dtype=object).astype(kinds)
