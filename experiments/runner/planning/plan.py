"""What a sweep will run: its jobs, which of them are done, and how long the others will take.

``plan.json`` in the sweep's folder is all that who works on it needs: shards under any scheduler
(`Plan.read`), MLflow, and the same command when it goes on.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from experiments.common.progress import duration
from experiments.common.records.record import Record
from experiments.runner.jobs.folder import last_record
from experiments.runner.jobs.request import Request
from experiments.sweeps.collected import head_of
from mvest.errors import ConfigurationError, InputError
from mvest.provenance import git_state, write_json
from mvest.reading.documents import read_mapping
from mvest.reading.text import one_line

PLAN = "plan.json"
"""File in a sweep's folder with the jobs that it consists of."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedJob:
    """One job of a sweep.

    Attributes
    ----------
    request : Request
    before : Record or None
        Head of the record of an earlier attempt.
    """

    request: Request
    before: Record | None = None

    @classmethod
    def of(cls, request: Request) -> PlannedJob:
        """A job with what its folder says of an earlier attempt."""
        record = last_record(request.folder, request.config_hash)
        return cls(request, None if record is None else head_of(record))

    @property
    def done(self) -> bool:
        """Whether it has a result."""
        return self.before is not None and self.before.converged

    @property
    def values(self) -> dict[str, Any]:
        """The resolved configuration."""
        return self.request.values

    @property
    def folder(self) -> Path:
        """Where its record is."""
        return self.request.folder

    @property
    def to_run(self) -> bool:
        """Whether it is missing, has failed, or is to be run again."""
        return bool(self.values["force"]) or not self.done

    @property
    def short_hash(self) -> str:
        """What files call it."""
        return self.request.config_hash[:16]

    @property
    def label(self) -> str:
        """What sets the job apart, for a line of text."""
        return ", ".join(_texts(self.values["factors"])) or " ".join(self.request.overrides)


@dataclass(frozen=True, slots=True)
class Plan:
    """All jobs of a sweep, in order.

    Attributes
    ----------
    name : str
        Of the configuration.
    folder : Path
        Of the sweep.
    sweep : dict
        The configuration's ``sweep``, empty for jobs swept on the command line.
    jobs : tuple of PlannedJob
    workers : int
        Jobs that run at a time; 1 where it is not known.
    publish : bool or None
        Whether the results take the sweep over; None: they are not to.
    written_ns : int or None
        When the plan was written; None: it was not.
    """

    name: str
    folder: Path
    sweep: dict[str, Any]
    jobs: tuple[PlannedJob, ...]
    workers: int
    publish: bool | None = None
    written_ns: int | None = None

    @property
    def common(self) -> dict[str, Any]:
        """A configuration, for what all jobs are told alike: where to write, track and publish."""
        return self.jobs[0].values

    @property
    def to_run(self) -> list[PlannedJob]:
        """Jobs that are missing, have failed, or are to be run again."""
        return [job for job in self.jobs if job.to_run]

    def require_different(self) -> None:
        """Refuse a plan with the same job twice, or with two jobs in one folder.

        Raises
        ------
        ConfigurationError
            The message names both.
        """
        first: dict[Path, PlannedJob] = {}
        for job in self.jobs:
            other = first.setdefault(job.folder.resolve(), job)
            if other is not job:
                same = other.request.config_hash == job.request.config_hash
                what = "are one and the same" if same else f"have one folder, {job.folder}"
                raise ConfigurationError(
                    f"two jobs {what}: {' '.join(other.request.overrides)} and "
                    f"{' '.join(job.request.overrides)}"
                )

    def write(self) -> Plan:
        """Write ``plan.json`` into the sweep's folder; returns the plan as it was written.

        Of the configurations the first one is written whole, of the others what differs.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        created = time.gmtime()
        first = self.jobs[0].values
        jobs = [
            job.request.to_json()
            | {
                "hash": job.short_hash,
                "folder": os.path.relpath(job.folder, self.folder),
                "name": name,
                "factors": job.values["factors"],
                "values": {k: v for k, v in job.values.items() if v is not first.get(k, job)},
                "without": [key for key in first if key not in job.values],
            }
            for job, name in zip(self.jobs, self.names(), strict=True)
        ]
        sweep_id = f"{time.strftime('%Y%m%d-%H%M%S', created)}-{uuid.uuid4().hex[:4]}"
        try:
            before = read_mapping(self.folder / PLAN)
            # The same jobs, perhaps with more of them, are the same sweep that goes on.
            if {job["hash"] for job in before["jobs"]} <= {job["hash"] for job in jobs}:
                sweep_id = before["sweep_id"]
        except (InputError, KeyError, TypeError):
            # The first sweep here.
            pass
        write_json(
            self.folder / PLAN,
            {
                "sweep": self.sweep.get("name", self.name),
                "size": self.sweep.get("size"),
                "sweep_id": sweep_id,
                "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", created),
                "name": self.name,
                "settings": self.sweep,
                "publish": self.publish,
                # Paths in a configuration are relative to where the command was typed.
                "directory": Path.cwd(),
                "values": first,
                "jobs": jobs,
            },
        )
        return replace(self, written_ns=(self.folder / PLAN).stat().st_mtime_ns)

    @classmethod
    def read(cls, folder: Path, *, look: bool = True) -> Plan:
        """The plan in a sweep's folder; unless it is to ``look``, as if no job had been run.

        The process then works where the sweep was planned.

        Raises
        ------
        InputError
            If there is none, or it was written by another version or on another machine.
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
            first = data["values"]
            requests = [
                Request(
                    {k: v for k, v in first.items() if k not in job["without"]} | job["values"],
                    job["config_hash"],
                    place.parent / job["folder"],
                    job["publish_as"],
                    tuple(job["overrides"]),
                )
                for job in data["jobs"]
            ]
            jobs = tuple(map(PlannedJob.of if look else PlannedJob, requests))
            written = place.stat().st_mtime_ns
            settings, publish = data["settings"], data["publish"]
            return cls(data["name"], place.parent, settings, jobs, 1, publish, written)
        except OSError as error:
            raise InputError(f"no sweep is planned in {folder}: {error}") from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            why = one_line(error, 160)
            raise InputError(f"{place} is no plan of this version: {why}") from error

    def names(self) -> list[str]:
        """What sets each job apart, in a few words: the factors in which jobs differ."""
        factors = [_texts(job.values["factors"]) for job in self.jobs]
        shared = set(factors[0]).intersection(*factors) if len(factors) > 1 else set()
        found = [", ".join(text for text in texts if text not in shared) for texts in factors]
        return [name or str(job.values["row"]) for name, job in zip(found, self.jobs, strict=True)]

    def summary(self) -> str:
        """How much is done and how much is left, in one line."""
        left, done = self.to_run, sum(job.done for job in self.jobs)
        failed = sum(job.before is not None and not job.done for job in self.jobs)
        size = f" ({self.sweep['size']})" if "size" in self.sweep else ""
        text = f"{self.name}{size}: {len(self.jobs)} jobs, {done} done, {failed} failed before, "
        return f"{text}{len(left)} to run{self._stale()}; {self.estimate()}"

    def listing(self) -> str:
        """Every job with its state, one line each."""
        return "\n".join(
            f"  {'run ' if job.to_run else 'done'}  {job.short_hash}  "
            f"{job.label}"
            + (f"  [failed before: {job.before.reason}]" if job.before and not job.done else "")
            for job in self.jobs
        )

    def estimate(self) -> str:
        """How long the jobs that are left will take, from those that were done before."""
        left = len(self.to_run)
        spent = [job.before.seconds_total for job in self.jobs if job.before and job.done]
        if not left or not spent:
            return "time unknown: no job has finished yet" if left else "nothing left"
        total = duration(fmean(spent) * left / min(self.workers, left))
        return f"about {total}, {self.workers} at a time"

    def _stale(self) -> str:
        """A remark on results that other code than the present one computed."""
        present = git_state(Path(__file__).resolve().parent)["sha"]
        commits = [job.before.provenance.git.sha for job in self.jobs if job.before and job.done]
        other = sum(sha != present for sha in commits)
        return f" ({other} of the done ones by another commit; force=true redoes)" if other else ""


def _texts(factors: Mapping[str, Any]) -> list[str]:
    return [f"{name}={value}" for name, value in factors.items()]
