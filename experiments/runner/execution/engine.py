"""Runs the jobs of a sweep on the threads of this process, or on the workers of a dask cluster.

Both call `execute` for each job, which runs it in a process of its own: a crash, too much time or
memory cost that job alone.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from experiments.common.records.record import Record, stamp
from experiments.common.study import Result
from experiments.runner.execution.cluster import EngineSettings, run_on_dask
from experiments.runner.execution.guard import WorkerProcess, run_apart
from experiments.runner.jobs.request import Request
from experiments.sweeps.collected import head_of
from mvest.errors import MvestError


def run_jobs(
    requests: Sequence[Request], settings: EngineSettings, at_a_time: int, asked_ns: int | None
) -> Generator[tuple[int, Record]]:
    """Run jobs; yields the position of each and the head of its record, as they end.

    Closing the iterator early, as an interrupt does, ends the jobs that run; nothing is recorded
    of them.

    Parameters
    ----------
    requests : sequence of Request
    settings : EngineSettings
    at_a_time : int
        Jobs that run on one machine beside each other and share its memory.
    asked_ns : int or None
        As in `run_apart`.

    Raises
    ------
    ConfigurationError
        If there is no such cluster, or it cannot be reached.
    OSError
        If dask's scheduler is lost.
    """
    if settings.elsewhere:
        yield from run_on_dask(execute, stop_jobs, requests, settings, asked_ns)
        return
    pool = ThreadPoolExecutor(min(at_a_time, len(requests)))
    futures = {
        pool.submit(execute, request, asked_ns, at_a_time): k for k, request in enumerate(requests)
    }
    try:
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BaseException:
        stop_jobs()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_idle: dict[str, list[WorkerProcess]] = {}
"""Folder in which a process works -> those that have no job."""

_busy: set[WorkerProcess] = set()


def execute(request: Request, asked_ns: int | None = None, at_a_time: int = 1) -> Record:
    """Run a job, unless it is done, in a process that this one keeps for its jobs.

    Whatever becomes of the job is in the head of a record that is returned.
    """
    idle = _idle.setdefault(str(Path.cwd()), [])
    try:
        worker = idle.pop()
    except IndexError:
        worker = WorkerProcess()
    _busy.add(worker)
    try:
        record = run_apart(request, worker, asked_ns, at_a_time)
    except (MvestError, OSError) as error:
        # Not even a record of the failure could be written.
        result = Result(status="failed", reason=str(error))
        record = stamp(request.values, request.config_hash, result, time.time())
    finally:
        _busy.remove(worker)
    idle.append(worker)
    return head_of(record)


def stop_jobs() -> None:
    """End the jobs that run in processes of this one; nothing is recorded of them."""
    for worker in list(_busy):
        worker.stop()
