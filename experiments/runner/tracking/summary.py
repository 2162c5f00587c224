"""A sweep as one run of MLflow: how it ended in a few numbers, and a table of all its jobs."""

from __future__ import annotations

import hashlib
from pathlib import Path
from statistics import fmean, median

from experiments.runner.collecting.estimate_table import sweep_table
from experiments.runner.tracking.store import Store, telling
from experiments.sweeps.collected import Sweep, read_sweep
from mvest.files import write_atomically

SWEEP, TABLE = "sweep.json", "jobs.parquet"
"""Files in a sweep's folder: its results, and all its jobs as a table."""

IS_SWEEP = "sweep"
"""Tag ``kind`` of a run that is a whole sweep."""


def log_summary(store: Store, folder: Path, sweep_id: str) -> None:
    """Bring the one run that stands for a sweep to the state of its folder.

    Raises
    ------
    TrackingError
        If the store cannot be written.
    InputError
        If the sweep's results cannot be read, or its table not written.
    """
    from mlflow.entities import Metric

    sweep = read_sweep(folder / SWEEP)
    result_hash = hashlib.sha256((folder / SWEEP).read_bytes()).hexdigest()
    with telling(store.place):
        chosen = f"tags.kind = '{IS_SWEEP}' and tags.sweep_id = '{sweep_id}'"
        before = store.client.search_runs([store.experiment], chosen)
        whole = [run for run in before if run.info.status == "FINISHED"]
        if whole and whole[0].data.tags.get("result_hash") == result_hash:
            return
    write_atomically(folder / TABLE, sweep_table(sweep).to_parquet())
    tags = {
        "kind": IS_SWEEP,
        "sweep_id": sweep_id,
        "result_hash": result_hash,
        "git_sha": sweep.provenance.git.sha,
        "folder": folder.name,
    }
    now = int(1000 * (folder / SWEEP).stat().st_mtime)
    with telling(store.place):
        run_id = store.client.create_run(
            store.experiment,
            run_name=f"all {len(sweep.jobs)} jobs",
            tags={key: str(value) for key, value in tags.items()},
        ).info.run_id
        numbers = [Metric(key, value, now, 0) for key, value in _totals(sweep).items()]
        store.client.log_batch(run_id, metrics=numbers)
        for name in (TABLE, SWEEP):
            store.client.log_artifact(run_id, str(folder / name))
        store.client.set_terminated(run_id, "FINISHED")
        for run in before:
            store.client.delete_run(run.info.run_id)


def _totals(sweep: Sweep) -> dict[str, float]:
    unknowns = [
        unknown
        for record in sweep.records
        for run in record.estimates
        for unknown in run.unknowns
        if run.converged
    ]
    errors = [abs(one.relative_error) for one in unknowns if one.relative_error is not None]
    overheads = [job.overhead for job in sweep.jobs if job.overhead is not None]
    totals: dict[str, float] = {
        "jobs": len(sweep.jobs),
        "failed": sum(not record.converged for record in sweep.records),
        "seconds": sum(record.seconds_total for record in sweep.records),
    }
    if errors:
        totals["error.mean"] = 100.0 * fmean(errors)
    if overheads:
        totals["overhead"] = median(overheads)
    return totals
