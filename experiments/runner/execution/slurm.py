"""Slurm: arrays whose tasks each drain a shard of a sweep's list, whatever their fate.

A task runs ``mvest worker``, as any other scheduler would. Here its arrays are submitted, waited
for or asked about later, and what died with a task is recorded, with Slurm's word for why.
"""

from __future__ import annotations

import math
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from experiments.runner.execution.drain import Shard
from experiments.runner.jobs.folder import is_done, require_writable, result_time, write_failure
from experiments.runner.planning.plan import Plan, PlannedJob
from mvest.errors import ConfigurationError, InputError
from mvest.processes import environment, python
from mvest.provenance import write_json
from mvest.reading.documents import read_json

WORDS = {
    "OUT_OF_MEMORY": "it ran out of memory (hydra.launcher.mem_gb)",
    "TIMEOUT": "it ran out of time (hydra.launcher.timeout_min)",
    "CANCELLED": "it was cancelled",
    "NODE_FAIL": "its node failed",
    "PREEMPTED": "it was preempted",
    "FAILED": "its process died",
}
"""Slurm's states of a task that did not complete, in words."""

NO_OPTIONS = (
    "array_parallelism", "jobs_per_task", "setup", "poll_s", "additional_parameters", "_target_",
)  # fmt: skip
"""Settings that are no options of sbatch."""

NAMES = {"name": "job-name", "timeout_min": "time"}
"""Options of sbatch that settings name otherwise."""

FOLDER, SUBMITTED = ".slurm", "submitted.json"
"""Within a sweep's folder, of what Slurm writes and what it was asked for."""

DEFAULT_MAX = 1001
"""Slurm's ``MaxArraySize`` where it is not told."""

LAST_LOOKS = 3
"""Questions to Slurm's accounting about tasks that have ended, while it still knows no state."""


@dataclass(frozen=True, slots=True)
class Submission:
    """One array that was submitted.

    Attributes
    ----------
    array : str
        Slurm's number.
    offset : int
        Task k of it drains shard ``offset + k``.
    tasks : tuple of int
    count : int
        Shards of the sweep.
    asked_ns : int
        When the plan that it works on was written.
    """

    array: str
    offset: int
    tasks: tuple[int, ...]
    count: int
    asked_ns: int

    def shard(self, task: int) -> Shard:
        """What a task drains."""
        return Shard(self.offset + task, self.count)

    def ended(self, job: PlannedJob) -> bool:
        """Whether a job is done, or has failed since the array was asked for."""
        return is_done(job.folder) or (result_time(job.folder) or 0) > self.asked_ns


def submit(plan: Plan, settings: Mapping[str, Any]) -> list[Submission]:
    """Submit the shards in which something is left, in as many arrays as Slurm's limit makes.

    Parameters
    ----------
    plan : Plan
        Which was written.
    settings : mapping
        ``hydra.launcher``.

    Raises
    ------
    ConfigurationError
        If Slurm is not there or refuses an array; none is then left with it.
    """
    assert plan.written_ns is not None
    each = settings["jobs_per_task"]
    count = math.ceil(len(plan.jobs) / each)
    left = {job.config_hash for job in plan.to_run}
    shards = [
        number
        for number in range(1, count + 1)
        if any(job.config_hash in left for job in Shard(number, count).of(plan.jobs))
    ]
    size = _max_array_size() - 1
    chunks = [
        (offset, [number - offset for number in within])
        for first, within in groupby(shards, lambda number: (number - 1) // size)
        for offset in (first * size,)
    ]
    at_once = max(1, settings["array_parallelism"] // max(1, len(chunks)))
    folder = plan.folder.resolve() / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    script = folder / "task.sh"
    script.write_text(_script(plan, settings, count), encoding="utf-8")
    found: list[Submission] = []
    try:
        for offset, tasks in chunks:
            array = (
                _run(
                    *("sbatch", "--parsable", f"--array={_ranges(tasks)}%{at_once}"),
                    *(
                        f"--output={folder}/%A_%a.out",
                        *_options(settings),
                        str(script),
                        str(offset),
                    ),
                )
                .strip()
                .partition(";")[0]
            )
            found.append(Submission(array, offset, tuple(tasks), count, plan.written_ns))
    except ConfigurationError:
        cancel(found)
        raise
    write_json(folder / SUBMITTED, [asdict(one) for one in found])
    names = " ".join(one.array for one in found)
    print(
        f"Slurm array {names}: {len(shards)} tasks, {len(left)} jobs; `scancel {names}` ends it",
        file=sys.stderr,
    )
    return found


def submitted(folder: Path) -> list[Submission]:
    """The arrays that were submitted last for the sweep in a folder; none if there were none."""
    try:
        data = read_json(folder / FOLDER / SUBMITTED)
        return [Submission(**{**one, "tasks": tuple(one["tasks"])}) for one in data]
    except (InputError, TypeError, KeyError):
        return []


def wait_for(arrays: Sequence[Submission], poll_s: float) -> None:
    """Wait until no task of the arrays waits or runs; if interrupted, they are cancelled."""
    try:
        while under_way(arrays):
            time.sleep(poll_s)
    except KeyboardInterrupt:
        cancel(arrays)
        raise


def cancel(arrays: Sequence[Submission]) -> None:
    """End the arrays."""
    if arrays:
        subprocess.run(["scancel", *(one.array for one in arrays)], check=False)


def under_way(arrays: Sequence[Submission]) -> set[str]:
    """Tasks that wait or run; all of them if the queue cannot be asked."""
    waiting: set[str] = set()
    for one in arrays:
        asked = _ask("squeue", "--noheader", "--array", "--jobs", one.array, "--format", "%i")
        if asked.returncode == 0:
            waiting |= set(asked.stdout.split())
        elif "Invalid job id" not in asked.stderr:
            waiting |= {f"{one.array}_{task}" for task in one.tasks}
        # Of an array that ended some minutes ago the queue knows nothing.
    return waiting


def record_dead(plan: Plan, arrays: Sequence[Submission], poll_s: float) -> int:
    """Record the jobs that ended with their tasks, and why; how many are still to come.

    Parameters
    ----------
    plan : Plan
    arrays : sequence of Submission
    poll_s : float
        Time (s) between two questions to Slurm's accounting.
    """
    alive = under_way(arrays)
    to_come = 0
    lost: dict[str, list[PlannedJob]] = {}
    for one in arrays:
        for task in one.tasks:
            left = [job for job in one.shard(task).of(plan.jobs) if not one.ended(job)]
            if f"{one.array}_{task}" in alive:
                to_come += len(left)
            elif left:
                lost[f"{one.array}_{task}"] = left
    states: dict[str, str] = {}
    for look in range(LAST_LOOKS if lost else 0):
        if look:
            time.sleep(poll_s)
        states = _states(arrays)
        if all(states.get(task, "PENDING") not in ("PENDING", "RUNNING") for task in lost):
            break
    for name, jobs in lost.items():
        output = plan.folder.resolve() / FOLDER / f"{name}.out"
        state = states.get(name)
        words = WORDS.get(state or "", f"Slurm's state is {state}")
        if state in (None, "PENDING", "RUNNING"):
            words = "it died, of what Slurm's accounting does not say"
            if not output.exists():
                words = "it was cancelled before it began"
        reason = f"Slurm job {name}: {words}"
        if output.exists():
            reason += f"; its output is in {output}"
        for job in jobs:
            require_writable(job.folder)
            write_failure(job.request, reason, time.time())
    return to_come


def _states(arrays: Sequence[Submission]) -> dict[str, str]:
    """Task -> Slurm's last word on it."""
    numbers = ",".join(one.array for one in arrays)
    asked = _ask(
        *("sacct", "--allocations", "--noheader", "--parsable2"),
        *("--jobs", numbers, "--format", "JobID,State"),
    )
    pairs = (line.partition("|") for line in asked.stdout.splitlines())
    # "CANCELLED by 1000"
    return {task: state.split(" ")[0] for task, _, state in pairs}


def _script(plan: Plan, settings: Mapping[str, Any], count: int) -> str:
    """What a task runs; its first argument is the offset of its array."""
    path = shlex.quote(environment()["PYTHONPATH"])
    worker = shlex.join(python("experiments.cli", "worker"))
    folder = shlex.quote(str(plan.folder.resolve()))
    return "\n".join(
        [
            "#!/bin/bash",
            *settings["setup"],
            f"export PYTHONPATH={path}",
            f'exec {worker} {folder} --shard "$(($1 + SLURM_ARRAY_TASK_ID))/{count}"',
            "",
        ]
    )


def _options(settings: Mapping[str, Any]) -> list[str]:
    """Options of sbatch."""
    given = {key: value for key, value in settings.items() if key not in NO_OPTIONS}
    if given.pop("mem_gb", None) is not None:
        given["mem"] = f"{settings['mem_gb']}G"
    named = {NAMES.get(key, key.replace("_", "-")): value for key, value in given.items()}
    named |= settings["additional_parameters"]
    return [f"--{key}={value}" for key, value in named.items() if value is not None]


def _max_array_size() -> int:
    for line in _run("scontrol", "show", "config").splitlines():
        key, _, value = line.partition("=")
        if key.strip() == "MaxArraySize":
            return max(2, int(value))
    return DEFAULT_MAX


def _ranges(numbers: Sequence[int]) -> str:
    """Increasing numbers as sbatch takes them: 1-3,5."""
    parts = []
    for _, pairs in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        run = [number for _, number in pairs]
        parts.append(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}")
    return ",".join(parts)


def _run(*command: str) -> str:
    """What a command of Slurm's says.

    Raises
    ------
    ConfigurationError
        If it is not there or refuses; Slurm's own words are kept.
    """
    done = _ask(*command)
    if done.returncode:
        raise ConfigurationError(f"Slurm takes no jobs: {' '.join(done.stderr.split())}")
    return done.stdout


def _ask(*command: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise ConfigurationError(
            f"launcher=slurm needs Slurm: {command[0]} is not on this machine"
        ) from error
