"""Works on the list of a sweep's jobs: all of it on this machine, or one shard of it anywhere."""

from __future__ import annotations

import os
import queue
import re
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass

from experiments.runner.collecting.collect import ENDS, End
from experiments.runner.execution.guard import StoppedError, WorkerProcess, new_worker, run_apart
from experiments.runner.jobs.folder import FailedRunError, result_time
from experiments.runner.planning.plan import Plan, PlannedJob
from mvest.errors import ConfigurationError, MvestError


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several parts of a list, every ``count``-th of its jobs from ``index`` on.

    Attributes
    ----------
    index, count : int
        The first shard is 1.

    Raises
    ------
    ConfigurationError
        If it is none of so many.
    """

    index: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count:
            raise ConfigurationError(f"shard {self}, expected I/N with I from 1 to N")

    @classmethod
    def parse(cls, text: str) -> Shard:
        """The shard that a text like 2/8 names."""
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None:
            raise ConfigurationError(f"shard {text!r}, expected I/N, for example 2/8")
        return cls(int(found[1]), int(found[2]))

    def of(self, jobs: tuple[PlannedJob, ...]) -> tuple[PlannedJob, ...]:
        """Its jobs: of the whole list, whatever is done, so that no two shards share one."""
        return jobs[self.index - 1 :: self.count]

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


def drain_here(plan: Plan) -> None:
    """Run what is left of a sweep in as many processes as it has workers.

    Raises
    ------
    KeyboardInterrupt
        If the sweep was interrupted; of the jobs that were under way nothing is recorded.
    OSError
        If the end of a job cannot be written.
    """
    left: queue.SimpleQueue[PlannedJob] = queue.SimpleQueue()
    for job in plan.to_run:
        left.put(job)
    workers = [new_worker() for _ in range(min(plan.workers, left.qsize()))]
    with ThreadPoolExecutor(max(1, len(workers))) as pool:
        try:
            threads = [
                pool.submit(_drain, plan, _taken(left), worker, f"here-{number}")
                for number, worker in enumerate(workers)
            ]
            wait(threads)
        except BaseException:
            for worker in workers:
                worker.stop()
            raise
    for worker in workers:
        worker.close()
    for thread in threads:
        thread.result()


def drain_shard(plan: Plan, shard: Shard) -> tuple[int, int]:
    """Run what is left of one shard; how many jobs it has, and how many of them have no estimate.

    Raises
    ------
    OSError
        If the end of a job cannot be written.
    """
    worker, jobs = new_worker(), shard.of(plan.jobs)
    try:
        failed = _drain(plan, jobs, worker, f"shard-{shard.index}-of-{shard.count}")
    finally:
        worker.close()
    return len(jobs), failed


def drain_inline(plan: Plan) -> None:
    """Run what is left of a sweep in this process, for debuggers; a job's death ends the sweep."""
    # Imports what computes, which whoever only hands out jobs does not need.
    from experiments.runner.execution.job import run_job

    for job in plan.to_run:
        try:
            run_job(job.request)
        except (MvestError, FailedRunError) as error:
            print(f"failed: {error}", file=sys.stderr)


def _taken(left: queue.SimpleQueue[PlannedJob]) -> Iterator[PlannedJob]:
    while True:
        try:
            yield left.get_nowait()
        except queue.Empty:
            return


def _drain(plan: Plan, jobs: Iterable[PlannedJob], worker: WorkerProcess, name: str) -> int:
    """Run jobs one after the other; returns how many have no estimate."""
    place = plan.folder / ENDS
    place.mkdir(exist_ok=True)
    process = f"{os.uname().nodename}:{os.getpid()}:{name}"
    failed = 0
    with (place / f"{name}.jsonl").open("a", encoding="utf-8") as ends:
        for job in jobs:
            before = result_time(job.folder)
            try:
                record = run_apart(job.request, worker, plan.written_ns, plan.workers)
                end = End.of(job, record, process)
            except StoppedError:
                break
            except (MvestError, OSError) as error:
                end = End.lost(job, str(error))
            if before is not None and end.written_ns == before:
                # It was done already.
                continue
            failed += not end.record.converged
            # In a line of its own, also after one that was cut off.
            ends.write(f"\n{end.line()}\n")
            ends.flush()
    return failed
