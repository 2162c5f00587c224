"""One file of a whole sweep: ``sweep.json``, from the results of its jobs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import Any

from experiments.common.record import Record, model_of_values
from experiments.runner.compared import Compared, last_compared
from experiments.runner.plan import Plan, PlannedJob
from mvest.provenance import config_hash, provenance

__all__ = ["NOT_RUN", "collect", "overheads"]

SCHEMA = 1
"""Version of the layout of ``sweep.json``."""

UNSAID = ("factors", "paths", "tracking")
"""Settings that are no part of what a sweep has in common, or belong to a machine."""

NOT_RUN = "not run"
"""Reason of a job that never began or was interrupted."""


def collect(
    plan: Plan, returned: Mapping[str, Mapping[str, Any]], earlier: Mapping[str, float]
) -> dict[str, Any]:
    """What all jobs of a sweep found, in their order, failed and missing ones included.

    Parameters
    ----------
    plan : Plan
    returned : mapping
        Short hash -> what the job's launcher was told at its end, for those that ended.
    earlier : mapping
        Short hash -> overhead that was measured when the job was run before.
    """
    records = [last_compared(job.folder, job.config_hash) for job in plan.jobs]
    ended = [record for record in records if record is not None]
    stored = [record.findings.truth_store for record in ended]
    entries = [
        _entry(job, record, returned.get(job.config_hash[:16]))
        for job, record in zip(plan.jobs, records, strict=True)
    ]
    first = plan.jobs[0].values
    run_again = {job.config_hash[:16] for job in plan.to_run}
    kept = {key: value for key, value in earlier.items() if key not in run_again}
    spent = kept | overheads(plan, returned)
    return {
        "schema": SCHEMA,
        "sweep": plan.sweep or {"name": plan.name, "size": None, "kind": None},
        "title": first["title"],
        "parameters": first["parameters"],
        "paper": first["paper"],
        "truth_hits": stored.count("hit"),
        "truth_misses": stored.count("miss"),
        "provenance": {
            **provenance(),
            "config_hash": config_hash({"jobs": [job.config_hash for job in plan.jobs]}),
            "mesh_hash": next((r.provenance.mesh_hash for r in ended), "none"),
            "seed": first["seed"],
            "commits": sorted({str(r.provenance.git.sha) for r in ended}),
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
        "settings": {key: value for key, value in first.items() if key not in UNSAID},
        "jobs": entries,
        "cost": [
            {
                "hash": entry["hash"],
                "seconds": sum(run["seconds"] or 0.0 for run in entry["runs"]),
                "seconds_total": None if record is None else record.seconds_total,
                "overhead": spent.get(entry["hash"]),
            }
            for entry, record in zip(entries, records, strict=True)
        ],
    }


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


def _entry(
    job: PlannedJob, record: Record[Compared] | None, end: Mapping[str, Any] | None
) -> dict[str, Any]:
    """A job's part of the file, with what each seed gave."""
    values, settings = job.values, job.values["filter"]
    runs = record.findings.repeats if record and not record.findings.died else ()
    return {
        "hash": job.config_hash[:16],
        "row": values["row"],
        "factors": values["factors"],
        "seed": values["seed"],
        "repeats": values["repeats"],
        "status": "failed" if record is None else record.status,
        "reason": record.reason if record else (end["reason"] if end else NOT_RUN),
        "model": asdict(model_of_values(values)),
        "initial": settings["initial"],
        "truth": values["truth"]["values"],
        "P0": settings["P0"],
        "Q": settings["Q"],
        "R": settings["R"],
        "filter": settings["mode"],
        "runs": [asdict(run) for run in runs],
    }
