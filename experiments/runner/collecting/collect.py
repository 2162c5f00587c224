"""One file of a whole sweep: ``sweep.json``, from what its jobs ended with.

That is appended to a file of the process that ran a job, so that ten thousand records need not be
opened. The records stay the truth: a line that is torn, missing or of an older one is left aside.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from experiments.common.records.estimates import Paper, SeedRun
from experiments.common.records.record import Record, Status, here_and_now, model_of_values
from experiments.runner.jobs.compared import Compared, last_compared
from experiments.runner.jobs.folder import is_done, result_time
from experiments.runner.planning.plan import Plan, PlannedJob
from experiments.sweeps.collected import SCHEMA, Cost, Sweep, SweepJob
from mvest.errors import InputError
from mvest.provenance import config_hash, require_sealed
from mvest.reading.json_file import parse_json

__all__ = ["ENDS", "NOT_RUN", "End", "collect", "overheads", "read_ends"]

UNSAID = ("factors", "paths", "tracking")
"""Settings that are no part of what a sweep has in common, or belong to a machine."""

NOT_RUN = "not run"
"""Reason of a job that never began or was interrupted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """What a sweep keeps of a job, from its record and from who ran it.

    Attributes
    ----------
    hash : str
        The job's short one.
    status : {"converged", "failed"}
    reason : str
    runs : tuple of SeedRun
        None where the job as a whole was lost.
    truth_store : str or None
    mesh_hash, commit : str
    seconds_total, seconds_computing : float or None
        All of the job, and of that simulating and estimating; None where it left no record.
    written_ns : int or None
        When the record was written.
    finished : float
        Seconds since the epoch, as the process that ran it says.
    process : str
        Which one ran it; empty where that is not known.
    """

    hash: str
    status: Status
    reason: str
    runs: tuple[SeedRun, ...] = ()
    truth_store: str | None = None
    mesh_hash: str = "none"
    commit: str = "None"
    seconds_total: float | None = None
    seconds_computing: float | None = None
    written_ns: int | None = None
    finished: float = 0.0
    process: str = ""

    @classmethod
    def of(cls, job: PlannedJob, record: Record[Compared], process: str = "") -> End:
        """What is kept of a record that a process has just written, or somebody before."""
        found = record.findings
        return cls(
            hash=job.short_hash,
            status=record.status,
            reason=record.reason,
            runs=() if found.died else found.repeats,
            truth_store=found.truth_store,
            mesh_hash=record.provenance.mesh_hash,
            commit=str(record.provenance.git.sha),
            seconds_total=record.seconds_total,
            seconds_computing=(
                found.seconds_computing or found.repeats[0].seconds or record.seconds_total
            ),
            written_ns=result_time(job.folder),
            finished=time.time(),
            process=process,
        )


ENDS = "ends"
"""Folder within a sweep's of the files to which processes append the ends of their jobs."""

_END = TypeAdapter(End)


def read_ends(folder: Path) -> dict[str, End]:
    """What the jobs of a sweep ended with last, by their short hashes."""
    found: dict[str, End] = {}
    for path in sorted((folder / ENDS).glob("*.jsonl")):
        for line in path.read_bytes().splitlines():
            try:
                data = parse_json(line, str(path))
                end = _END.validate_python(data)
                require_sealed(data, str(path))
            except (ValidationError, InputError):
                # Between two lines, cut off with the process that wrote it, of another version, or
                # not as it was written.
                continue
            if end.hash not in found or found[end.hash].finished < end.finished:
                found[end.hash] = end
    return found


def collect(plan: Plan, appended: Mapping[str, End]) -> Sweep:
    """What all jobs of a sweep gave, in their order, failed and missing ones included.

    Parameters
    ----------
    plan : Plan
    appended : mapping
        From `read_ends`; jobs that are not there are read from their folders.
    """
    ends = [_end(job, appended.get(job.short_hash)) for job in plan.jobs]
    recorded = [end for end in ends if end.seconds_total is not None]
    stored = [end.truth_store for end in recorded]
    first = plan.jobs[0].values
    spent = overheads(ends)
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
            next((end.mesh_hash for end in recorded), "none"),
            first["seed"],
        ),
        commits=tuple(sorted({end.commit for end in recorded})),
        settings={key: value for key, value in first.items() if key not in UNSAID},
        jobs=tuple(map(_collected, plan.jobs, ends)),
        cost=tuple(
            Cost(
                end.hash,
                sum(run.seconds or 0.0 for run in end.runs),
                end.seconds_total,
                spent.get(end.hash),
            )
            for end in ends
        ),
    )


def overheads(ends: Iterable[End]) -> dict[str, float]:
    """Seconds per job that were not spent in simulating or estimating, by its short hash.

    Measured from the end of one job to the end of the next of the same process, so that launching,
    writing and drawing all count. A process's first job is left out: what is imported and compiled
    with it is paid for once.
    """
    processes: dict[str, list[End]] = {}
    for end in ends:
        if end.process:
            processes.setdefault(end.process, []).append(end)
    spent = {}
    for by_one in processes.values():
        for before, end in pairwise(sorted(by_one, key=lambda end: end.finished)):
            if end.status == "converged" and end.seconds_computing is not None:
                spent[end.hash] = end.finished - before.finished - end.seconds_computing
    return spent


def _end(job: PlannedJob, end: End | None) -> End:
    """A job's end as it was appended, where that is of the record which is there now."""
    written = result_time(job.folder)
    if end is not None and end.written_ns == written:
        whole = is_done(job.folder) == (end.status == "converged")
        if written is None or whole:
            return end
    record = last_compared(job.folder, job.config_hash)
    if record is None:
        return End(hash=job.short_hash, status="failed", reason=NOT_RUN)
    return End.of(job, record)


def _collected(job: PlannedJob, end: End) -> SweepJob:
    """A job with what each seed gave."""
    values, settings = job.values, job.values["filter"]
    return SweepJob(
        hash=job.short_hash,
        row=values["row"],
        factors=values["factors"],
        seed=values["seed"],
        repeats=values["repeats"],
        status=end.status,
        reason=end.reason,
        model=model_of_values(values),
        initial=settings["initial"],
        truth=values["truth"]["values"],
        P0=settings["P0"],
        Q=settings["Q"],
        R=settings["R"],
        filter=settings["mode"],
        runs=end.runs,
    )
