"""One file of a whole sweep: ``sweep.json``, from what its jobs ended with.

Each process that runs jobs appends their ends to a file of its own, so that ten thousand records
need not be opened. The records stay the truth: a line that is torn, missing or older than its
record is ignored.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from experiments.common.records.record import Frozen, Record, here_and_now, stamp
from experiments.common.study import Result
from experiments.runner.jobs.folder import is_done, last_record, result_time
from experiments.runner.planning.plan import Plan, PlannedJob
from experiments.sweeps.collected import Sweep, SweptJob, head_of
from mvest.errors import InputError
from mvest.provenance import config_hash, require_sealed, sealed
from mvest.reading.documents import parse_json

NOT_COMMON = ("factors", "paths", "tracking", "sweep")
"""Settings that jobs do not have in common, or that belong to a machine or the runner."""

NOT_RUN = "not run"
"""Reason of a job that never began or was interrupted."""

ENDS = "ends"
"""Folder within a sweep's of the files to which processes append the ends of their jobs."""


class End(Frozen):
    """How a job ended.

    Attributes
    ----------
    hash : str
        The job's short one.
    record : Record
        Its head; one that says why where the job left none.
    process : str
        Which one ran it; empty where that is not known.
    finished : float
        Seconds since the epoch, as that process says.
    written_ns : int or None
        When the record was written; None where it could not be.
    """

    hash: str
    record: Record
    process: str = ""
    finished: float = 0.0
    written_ns: int | None = None

    @classmethod
    def of(cls, job: PlannedJob, record: Record, process: str = "") -> End:
        """The end of a job whose record was just written, or found."""
        return cls(
            hash=job.short_hash,
            record=head_of(record),
            process=process,
            finished=time.time(),
            written_ns=result_time(job.folder),
        )

    @classmethod
    def lost(cls, job: PlannedJob, reason: str) -> End:
        """The end of a job without a record."""
        result = Result(status="failed", reason=reason)
        record = stamp(job.values, job.config_hash, result, time.time())
        return cls(hash=job.short_hash, record=record)

    def line(self) -> str:
        """A line of the log of ends."""
        return json.dumps(sealed(self.model_dump(mode="json", exclude_defaults=True)))

    @property
    def seconds_computing(self) -> float:
        """Seconds of simulating and estimating."""
        computing = self.record.numbers.get("seconds_computing")
        spent = [one.seconds for one in self.record.estimates[:1]]
        found = [one for one in (computing, *spent) if isinstance(one, int | float) and one]
        return float(found[0]) if found else self.record.seconds_total


def read_ends(folder: Path) -> dict[str, End]:
    """What the jobs of a sweep ended with last, by their short hashes."""
    found: dict[str, End] = {}
    for path in sorted((folder / ENDS).glob("*.jsonl")):
        for line in path.read_bytes().splitlines():
            try:
                data = parse_json(line, str(path))
                require_sealed(data, str(path))
                end = End.model_validate({k: v for k, v in data.items() if k != "sha256"})
            except (ValidationError, InputError, AttributeError):
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
    sources = [end.record.provenance for end in ends if end.record.reason != NOT_RUN]
    first = plan.jobs[0].values
    spent = overheads(ends)
    return Sweep(
        name=str(plan.sweep.get("name", plan.name)),
        size=plan.sweep.get("size"),
        title=first["title"],
        parameters=tuple(first["parameters"]),
        paper=first["paper"],
        provenance=here_and_now(
            config_hash({"jobs": [job.config_hash for job in plan.jobs]}),
            next((one.mesh_hash for one in sources if one.mesh_hash != "none"), "none"),
            first["seed"],
        ),
        commits=tuple(sorted({str(one.git.sha) for one in sources})),
        settings={key: value for key, value in first.items() if key not in NOT_COMMON},
        jobs=tuple(
            _swept(job, end, spent.get(end.hash)) for job, end in zip(plan.jobs, ends, strict=True)
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
            if end.record.converged:
                spent[end.hash] = end.finished - before.finished - end.seconds_computing
    return spent


def _end(job: PlannedJob, end: End | None) -> End:
    """A job's end as it was appended, where that is of the record which is there now."""
    written = result_time(job.folder)
    if end is not None and end.written_ns == written:
        whole = is_done(job.folder) == end.record.converged
        if written is None or whole:
            return end
    record = last_record(job.folder, job.config_hash)
    return End.lost(job, NOT_RUN) if record is None else End.of(job, record)


def _swept(job: PlannedJob, end: End, overhead: float | None) -> SweptJob:
    values: dict[str, Any] = job.values
    settings, truth = values["filter"], values["truth"]["values"]
    return SweptJob(
        hash=end.hash,
        seed=values["seed"],
        repeats=values["repeats"],
        start=settings["initial"],
        truth=truth,
        P0=settings["P0"],
        Q=settings["method"].get("Q", 0.0),
        R=settings["R"],
        overhead=overhead,
        record=end.record,
    )
