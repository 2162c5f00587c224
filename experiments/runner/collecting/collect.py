"""One file of a whole sweep, ``sweep.json``: what its jobs ended with."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from experiments.common.records.record import Record, here_and_now, stamp
from experiments.common.study import Result
from experiments.runner.planning.plan import Plan, PlannedJob
from experiments.sweeps.collected import Sweep, SweptJob
from mvest.provenance import config_hash

NOT_COMMON = ("factors", "paths", "tracking", "sweep")
"""Settings that jobs do not have in common, or that belong to a machine or the runner."""

NOT_RUN = "not run"
"""Reason of a job that never began or was interrupted."""


def collect(plan: Plan, ended: Mapping[str, Record]) -> Sweep:
    """What all jobs of a sweep gave, in their order, failed and missing ones included.

    Parameters
    ----------
    plan : Plan
    ended : mapping
        Hash of a configuration -> head of the record of a job that has just been run.
    """
    records = [ended.get(job.request.config_hash, job.before) for job in plan.jobs]
    sources = [record.provenance for record in records if record is not None]
    first = plan.common
    return Sweep(
        name=str(plan.sweep.get("name", plan.name)),
        size=plan.sweep.get("size"),
        title=first["title"],
        parameters=tuple(first["parameters"]),
        paper=first["paper"],
        provenance=here_and_now(
            config_hash({"jobs": [job.request.config_hash for job in plan.jobs]}),
            next((one.mesh_hash for one in sources if one.mesh_hash != "none"), "none"),
            first["seed"],
        ),
        commits=tuple(sorted({str(one.git.sha) for one in sources})),
        settings={key: value for key, value in first.items() if key not in NOT_COMMON},
        jobs=tuple(_swept(job, one) for job, one in zip(plan.jobs, records, strict=True)),
    )


def _swept(job: PlannedJob, record: Record | None) -> SweptJob:
    values: dict[str, Any] = job.values
    if record is None:
        result = Result(status="failed", reason=NOT_RUN)
        record = stamp(values, job.request.config_hash, result, time.time())
    return SweptJob(
        hash=job.short_hash,
        seed=values["seed"],
        repeats=values["repeats"],
        # One that was computed for another sweep has the factors of that.
        record=record.model_copy(update={"factors": values["factors"]}),
    )
