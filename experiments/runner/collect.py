"""One file of a whole sweep: ``sweep.json``, from the results of its jobs."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

from experiments.common.estimates import Paper
from experiments.common.record import Record, here_and_now, model_of_values
from experiments.runner.compared import Compared, last_compared
from experiments.runner.plan import Plan, PlannedJob
from experiments.sweeps.collected import SCHEMA, Cost, Sweep, SweepJob
from mvest.provenance import config_hash

__all__ = ["NOT_RUN", "collect", "overheads"]

UNSAID = ("factors", "paths", "tracking")
"""Settings that are no part of what a sweep has in common, or belong to a machine."""

NOT_RUN = "not run"
"""Reason of a job that never began or was interrupted."""


def collect(
    plan: Plan, returned: Mapping[str, Mapping[str, Any]], earlier: Mapping[str, float]
) -> Sweep:
    """What all jobs of a sweep gave, in their order, failed and missing ones included.

    Parameters
    ----------
    plan : Plan
    returned : mapping
        Short hash -> what the job gave its launcher at its end, for those that ended.
    earlier : mapping
        Short hash -> overhead that was measured when the job was run before.
    """
    records = [last_compared(job.folder, job.config_hash) for job in plan.jobs]
    ended = [record for record in records if record is not None]
    stored = [record.findings.truth_store for record in ended]
    jobs = tuple(
        _collected(job, record, returned.get(job.config_hash[:16]))
        for job, record in zip(plan.jobs, records, strict=True)
    )
    first = plan.jobs[0].values
    run_again = {job.config_hash[:16] for job in plan.to_run}
    kept = {key: value for key, value in earlier.items() if key not in run_again}
    spent = kept | overheads(plan, returned)
    return Sweep(
        schema=SCHEMA,
        sweep=plan.sweep or {"name": plan.name, "size": None, "kind": None},
        title=first["title"],
        parameters=tuple(first["parameters"]),
        paper=first["paper"] and Paper(**first["paper"]),
        truth_hits=stored.count("hit"),
        truth_misses=stored.count("miss"),
        provenance=here_and_now(
            config_hash({"jobs": [job.config_hash for job in plan.jobs]}),
            next((r.provenance.mesh_hash for r in ended), "none"),
            first["seed"],
        ),
        commits=tuple(sorted({str(r.provenance.git.sha) for r in ended})),
        settings={key: value for key, value in first.items() if key not in UNSAID},
        jobs=jobs,
        cost=tuple(
            Cost(
                job.hash,
                sum(run.seconds or 0.0 for run in job.runs),
                None if record is None else record.seconds_total,
                spent.get(job.hash),
            )
            for job, record in zip(jobs, records, strict=True)
        ),
    )


def overheads(plan: Plan, returned: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Seconds per job that were not spent in simulating or estimating.

    Measured from the end of one job to the end of the next of the same process, so that launching,
    composing, writing, drawing and logging all count. A process's first job is left out: what is
    imported and compiled with it is paid for once.
    """
    computing = {}
    for job in plan.to_run:
        record = last_compared(job.folder, job.config_hash)
        if record is not None and record.converged:
            found = record.findings
            computing[job.config_hash[:16]] = (
                found.seconds_computing or found.repeats[0].seconds or record.seconds_total
            )
    processes: dict[str, list[Mapping[str, Any]]] = {}
    for end in returned.values():
        processes.setdefault(str(end["process"]), []).append(end)
    spent = {}
    for ends in processes.values():
        ordered = sorted(ends, key=lambda end: float(end["finished"]))
        for before, end in pairwise(ordered):
            if end["hash"] in computing:
                between = float(end["finished"]) - float(before["finished"])
                spent[str(end["hash"])] = between - computing[str(end["hash"])]
    return spent


def _collected(
    job: PlannedJob, record: Record[Compared] | None, end: Mapping[str, Any] | None
) -> SweepJob:
    """A job with what each seed gave."""
    values, settings = job.values, job.values["filter"]
    return SweepJob(
        hash=job.config_hash[:16],
        row=values["row"],
        factors=values["factors"],
        seed=values["seed"],
        repeats=values["repeats"],
        status="failed" if record is None else record.status,
        reason=record.reason if record else (end["reason"] if end else NOT_RUN),
        model=model_of_values(values),
        initial=settings["initial"],
        truth=values["truth"]["values"],
        P0=settings["P0"],
        Q=settings["Q"],
        R=settings["R"],
        filter=settings["mode"],
        runs=record.findings.repeats if record and not record.findings.died else (),
    )
