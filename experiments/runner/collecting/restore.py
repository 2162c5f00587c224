"""Results take over what earlier attempts at the jobs of a sweep ended with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.common.records.record import Record, record_from
from experiments.common.study import load_study
from experiments.results.keep import RECORDS, publish
from experiments.runner.jobs.folder import RESULT, last_record
from experiments.runner.planning.plan import Plan
from mvest.reading.json_file import read_mapping

__all__ = ["restore"]


def restore(plan: Plan) -> int:
    """Keep the records of jobs that have ended where the results have others of them, or none.

    A job keeps its own record as it ends. What was done before is not run again, and the results
    may have been put back to another state since.

    Returns
    -------
    int
        How many were kept.

    Raises
    ------
    MvestError
        If a record is damaged, or a file cannot be written.
    """
    kept: dict[tuple[str, str, Path], dict[str, tuple[Record[Any], Path]]] = {}
    for job in plan.jobs:
        data = None if job.publish_as is None else last_record(job.folder, job.config_hash)
        if job.publish_as is None or data is None:
            continue
        results = Path(job.values["paths"]["results"])
        if _has(results / RECORDS / str(data["table"]) / f"{job.publish_as}.json", job.config_hash):
            continue
        study = load_study(job.values["study"])
        record = record_from(data, study.findings, str(job.folder / RESULT))
        if record.converged or study.keeps_failures:
            group = (job.values["study"], record.table, results)
            kept.setdefault(group, {})[job.publish_as] = record, job.folder
    for (name, _, results), runs in kept.items():
        publish(load_study(name), results, runs)
    return sum(map(len, kept.values()))


def _has(path: Path, config_hash: str) -> bool:
    """Whether a kept record is of a configuration."""
    if not path.is_file():
        return False
    return bool(read_mapping(path).get("provenance", {}).get("config_hash") == config_hash)
