"""The jobs of a sweep: which are done, how long the others take, and what all gave.

``plan.json`` in the sweep's folder is all that is needed to work on the sweep: by shards under any
scheduler (`Plan.read`), by MLflow, and by the same command when it goes on.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from experiments.common.progress import duration
from experiments.common.records.record import Record, here_and_now
from experiments.common.schema import build
from experiments.runner.jobs import Request, failed_record, last_record
from experiments.sweeps.collected import Sweep, SweptJob, head_of
from mvest.errors import ConfigurationError, InputError
from mvest.provenance import config_hash, write_json
from mvest.reading.documents import read_mapping
from mvest.reading.text import one_line

PLAN = "plan.json"  # file in a sweep's folder that lists its jobs
# Settings that differ between jobs, or that belong to a machine or the runner.
NOT_COMMON = ("factors", "paths", "tracking", "sweep")
NOT_RUN = "not run"  # reason of a job that never began or was interrupted


def earlier(jobs: Iterable[Request]) -> dict[str, Record]:
    """Hash of a configuration -> head of the record of its last attempt, if it has one."""
    records = ((job.config_hash, last_record(job.folder, job.config_hash)) for job in jobs)
    return {key: head_of(record) for key, record in records if record is not None}


@dataclass(frozen=True, slots=True)
class Plan:
    """All jobs of a sweep, in order."""

    name: str
    folder: Path
    sweep: dict[str, Any]  # of the configuration; empty for jobs swept on the command line
    jobs: tuple[Request, ...]
    before: Mapping[str, Record] = field(default_factory=dict)  # earlier attempts, see `earlier`
    workers: int = 1  # jobs that run at a time
    # Whether to copy the sweep to the results; False: not because of overrides; None: no sweep to
    # be published.
    publish: bool | None = None
    written_ns: int | None = None  # time of `write`

    @property
    def common(self) -> dict[str, Any]:
        """A configuration, for what all jobs share: where to write, track and publish."""
        return self.jobs[0].values

    @property
    def to_run(self) -> list[Request]:
        """Jobs that are missing, have failed, or are to be run again."""
        done = {key for key, record in self.before.items() if record.converged}
        return [job for job in self.jobs if job.values["force"] or job.config_hash not in done]

    def require_different(self) -> None:
        """Raise a `ConfigurationError` that names two equal jobs, or two with one folder."""
        first: dict[Path, Request] = {}
        for job in self.jobs:
            other = first.setdefault(job.folder.resolve(), job)
            if other is not job:
                same = other.config_hash == job.config_hash
                what = "are one and the same" if same else f"have one folder, {job.folder}"
                raise ConfigurationError(
                    f"two jobs {what}: {' '.join(other.overrides)} and {' '.join(job.overrides)}"
                )

    def write(self) -> Plan:
        """Write ``plan.json``, of later jobs only the differences to the first one."""
        self.folder.mkdir(parents=True, exist_ok=True)
        place, created = self.folder / PLAN, time.gmtime()
        jobs = [
            job.to_json()
            | {
                "hash": job.short_hash,
                "folder": os.path.relpath(job.folder, self.folder),
                "name": job.label if job.values["factors"] else job.values["row"],
                "factors": job.values["factors"],
                "values": {k: v for k, v in job.values.items() if v is not self.common.get(k, job)},
                "without": [key for key in self.common if key not in job.values],
            }
            for job in self.jobs
        ]
        sweep_id = f"{time.strftime('%Y%m%d-%H%M%S', created)}-{uuid.uuid4().hex[:4]}"
        try:
            before = read_mapping(place)
            # The same jobs, perhaps with more of them, continue the same sweep.
            if {job["hash"] for job in before["jobs"]} <= {job["hash"] for job in jobs}:
                sweep_id = before["sweep_id"]
        except (InputError, KeyError, TypeError):
            pass  # the first sweep here
        plan = {
            "sweep": self.sweep.get("name", self.name),
            "size": self.sweep.get("size"),
            "sweep_id": sweep_id,
            "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", created),
            "name": self.name,
            "settings": self.sweep,
            "publish": self.publish,
            "directory": Path.cwd(),  # paths in a configuration are relative to it
            "values": self.common,
            "jobs": jobs,
        }
        write_json(place, plan)
        return replace(self, written_ns=place.stat().st_mtime_ns)

    @classmethod
    def read(cls, folder: Path, *, look: bool = True) -> Plan:
        """The plan in a sweep's folder; ``look`` reads the records of earlier attempts.

        Changes to the directory in which the sweep was planned.

        Raises an `InputError` if there is none, or it was written by another version or on another
        machine.
        """
        place = folder.resolve() / PLAN
        if not place.is_file():
            raise InputError(f"no sweep is planned in {folder}")
        try:
            data = read_mapping(place)
            directory = str(data["directory"])
            if not os.access(directory, os.X_OK):
                raise InputError(f"directory {one_line(directory, 80)} cannot be entered")
            os.chdir(directory)
            common, requests = data["values"], []
            for job in data["jobs"]:
                shared = {k: v for k, v in common.items() if k not in job["without"]}
                own = {"values": shared | job["values"], "folder": place.parent / job["folder"]}
                requests.append(build(Request, {**job, **own}))
            return cls(
                data["name"],
                place.parent,
                data["settings"],
                tuple(requests),
                earlier(requests) if look else {},
                publish=data["publish"],
                written_ns=place.stat().st_mtime_ns,
            )
        except OSError as error:
            raise InputError(f"no sweep is planned in {folder}: {error}") from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            why = one_line(error, 160)
            raise InputError(f"{place} is no plan of this version: {why}") from error

    def summary(self) -> str:
        """How many jobs are done and left, and how long they will take, in one line."""
        left, size = len(self.to_run), self.sweep.get("size")
        done = [record.seconds_total for record in self.before.values() if record.converged]
        takes = "nothing left"
        if left and done:
            total = duration(fmean(done) * left / min(self.workers, left))
            takes = f"about {total}, {self.workers} at a time"
        elif left:
            takes = "time unknown: no job has finished yet"
        return (
            f"{self.name}{f' ({size})' if size else ''}: {len(self.jobs)} jobs, {len(done)} done, "
            f"{len(self.before) - len(done)} failed before, {left} to run; {takes}"
        )

    def listing(self) -> str:
        """Every job with its state, one line each."""
        left, lines = {job.config_hash for job in self.to_run}, []
        for job in self.jobs:
            state = "run " if job.config_hash in left else "done"
            last = self.before.get(job.config_hash)
            failed = f"  [failed before: {last.reason}]" if last and not last.converged else ""
            lines.append(f"  {state}  {job.short_hash}  {job.label}{failed}")
        return "\n".join(lines)

    def collect(self, ended: Mapping[str, Record]) -> Sweep:
        """All results in order, failed and missing ones too; ``ended`` has heads of new records."""
        known, first = {**self.before, **ended}, self.common
        sources = [
            known[one.config_hash].provenance for one in self.jobs if one.config_hash in known
        ]
        return Sweep(
            name=str(self.sweep.get("name", self.name)),
            size=self.sweep.get("size"),
            title=first["title"],
            parameters=tuple(first["parameters"]),
            paper=first["paper"],
            provenance=here_and_now(
                config_hash({"jobs": [job.config_hash for job in self.jobs]}),
                next((one.mesh_hash for one in sources if one.mesh_hash != "none"), "none"),
                first["seed"],
            ),
            commits=tuple(sorted({str(one.git.sha) for one in sources})),
            settings={key: value for key, value in first.items() if key not in NOT_COMMON},
            jobs=tuple(
                SweptJob(
                    hash=job.short_hash,
                    seed=job.values["seed"],
                    repeats=job.values["repeats"],
                    # A job that was computed for another sweep has the factors of that one.
                    record=(known.get(job.config_hash) or failed_record(job, NOT_RUN)).model_copy(
                        update={"factors": job.values["factors"]}
                    ),
                )
                for job in self.jobs
            ),
        )
