"""One file of a whole sweep: ``sweep.json``, from the results of its jobs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import Any

from experiments.common.plain import flat
from experiments.common.record import model_of_values
from experiments.runner.folder import last_record
from experiments.runner.plan import Plan, PlannedJob
from mvest.provenance import config_hash, provenance

__all__ = ["NOT_RUN", "collect", "overheads"]

SCHEMA = 1
"""Version of the layout of ``sweep.json``."""

RUN = (
    "seed",
    "status",
    "reason",
    "detail",
    "estimate",
    "std",
    "relative_error",
    "bound",
    "distance_mm",
    "distance_to_truth_mm",
    "nis",
    "nis_band",
    "iterations",
    "forward_solves",
    "iterates",
    "iterate_std",
    "seconds",
)
"""What is kept of each seed of a job."""

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
    found = [_entry(job, returned.get(job.config_hash[:16])) for job in plan.jobs]
    records = [record for _, record in found if record is not None]
    stored = [flat(record).get("truth_store") for record in records]
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
            "mesh_hash": next((r["provenance"]["mesh_hash"] for r in records), "none"),
            "seed": first["seed"],
            "commits": sorted({str(r["provenance"]["git"]["sha"]) for r in records}),
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
        "settings": {key: value for key, value in first.items() if key not in UNSAID},
        "jobs": [entry for entry, _ in found],
        "cost": [
            {
                "hash": entry["hash"],
                "seconds": sum(run["seconds"] or 0.0 for run in entry["runs"]),
                "seconds_total": None if record is None else record["seconds_total"],
                "overhead": spent.get(entry["hash"]),
            }
            for entry, record in found
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
        record = last_record(job.folder, job.config_hash)
        if record is not None and record["status"] == "converged":
            whole = flat(record)
            computing[job.config_hash[:16]] = float(
                whole.get("seconds_computing") or whole.get("seconds") or whole["seconds_total"]
            )
    processes: dict[str, list[Mapping[str, Any]]] = {}
    for end in returned.values():
        processes.setdefault(str(end["process"]), []).append(end)
    found = {}
    for ends in processes.values():
        ordered = sorted(ends, key=lambda end: float(end["finished"]))
        for before, end in pairwise(ordered):
            if end["hash"] in computing:
                spent = float(end["finished"]) - float(before["finished"])
                found[str(end["hash"])] = spent - computing[str(end["hash"])]
    return found


def _entry(
    job: PlannedJob, end: Mapping[str, Any] | None
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """A job's part of the file, and its record if there is one."""
    values, settings = job.values, job.values["filter"]
    record = last_record(job.folder, job.config_hash)
    entry = {
        "hash": job.config_hash[:16],
        "row": values["row"],
        "factors": values["factors"],
        "seed": values["seed"],
        "repeats": values["repeats"],
        "status": "failed" if record is None else record["status"],
        "reason": record["reason"] if record else (end["reason"] if end else NOT_RUN),
        "model": asdict(model_of_values(values)),
        "initial": settings["initial"],
        "truth": values["truth"]["values"],
        "P0": settings["P0"],
        "Q": settings["Q"],
        "R": settings["R"],
        "filter": settings["mode"],
        "runs": _runs(record),
    }
    return entry, record


def _runs(record: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """What each seed of a job found; nothing where the job as a whole was lost."""
    if record is None or record["findings"] is None:
        return []
    record = flat(record)
    if "repeats" in record:
        return [{key: run.get(key) for key in RUN} for run in record["repeats"]]
    innovation = record.get("innovation") or {}
    bound = (record.get("identifiability") or {}).get("cramer_rao_std")
    more = {
        "seed": record["provenance"]["seed"],
        "bound": bound,
        "nis": innovation.get("nis"),
        "nis_band": innovation.get("nis_band"),
        "seconds": record.get("seconds", record["seconds_total"]),
    }
    return [{key: more[key] if key in more else record.get(key) for key in RUN}]
