"""Runs each job in a worker process, so that a crash or a limit costs only that job.

A worker runs job after job and is replaced after a crash, or when memory or time ran out. The jobs
of a sweep run on the threads of this process, or on the workers of a dask cluster (`cluster`);
both call `execute` for each job.
"""

import atexit
import json
import threading
import time
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from functools import partial
from pathlib import Path
from subprocess import PIPE, TimeoutExpired
from typing import Any

from experiments.common.records.record import Record
from experiments.runner.cluster import EngineSettings, run_on_dask
from experiments.runner.jobs import Request, attempt, default_memory_gb, failed_record
from experiments.sweeps.collected import head_of
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.processes import Program, ending, environment, python
from mvest.provenance import THREAD_VARIABLES

WORKER = python("experiments.runner.job")  # command of a process that runs jobs
LEAVE_S = 2.0  # time in which a worker without a job exits by itself


class StoppedError(Exception):
    """The worker was stopped from outside; its job has no record."""


class WorkerProcess:
    """A process that runs jobs. It is started for the first job, and again after it ended."""

    def __init__(self, command: Sequence[str] = ()) -> None:
        self._command = command or WORKER
        self._program: Program | None = None
        self._stopped = False
        atexit.register(self.close)

    def run(self, request: Request, at_a_time: int = 1, *, aloud: bool = False) -> str | None:
        """Run one job; None if it wrote its record, otherwise the reason.

        With ``aloud`` the progress of the job is shown, and a refusal is a `ConfigurationError`.
        Raises `StoppedError` after `stop`.
        """
        if self._program is not None and self._program.process.poll() is not None:
            self.close()
        streams = {"stdin": PIPE, "stdout": PIPE, "encoding": "utf-8"}
        one_thread = environment(**dict.fromkeys(THREAD_VARIABLES, "1"))
        try:
            self._program = self._program or Program(self._command, env=one_thread, **streams)
        except OSError as error:
            raise InputError(f"no process for {request.folder}: {error.strerror}") from error
        program = self._program
        if self._stopped:
            self.close()
            raise StoppedError
        process: Any = program.process
        began, line = time.monotonic(), ""
        memory_gb = request.values["memory_limit_gb"] or default_memory_gb(at_a_time)
        limit_s = request.values["time_limit_s"] or threading.TIMEOUT_MAX
        timer = threading.Timer(limit_s, program.end)
        timer.daemon = True
        timer.start()
        order = request.to_json() | {"memory_gb": memory_gb, "aloud": aloud}
        try:
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(order) + "\n")
                process.stdin.flush()
                line = process.stdout.readline()
        except BaseException:
            # Interrupted: the job ends, too.
            program.end()
            self.close()
            raise
        finally:
            timer.cancel()
        expired = time.monotonic() - began >= limit_s
        if line.endswith("\n") and not expired:
            answer = json.loads(line)
            reason: str | None = answer["reason"]
            if aloud and answer["refused"]:
                raise ConfigurationError(reason)
            if reason is not None and not answer["refused"]:
                self.close()
            return reason
        self.close()
        if self._stopped:
            raise StoppedError
        if expired:
            return f"time limit of {limit_s:g} s"
        return f"{ending(process.returncode)}; memory limit {memory_gb:.3g} GB"

    def close(self) -> None:
        """End the process, and whatever it has started."""
        program, self._program = self._program, None
        if program is None:
            return
        process: Any = program.process
        with suppress(OSError, TimeoutExpired):
            # A signal would disturb its clean-up.
            process.stdin.close()
            process.wait(LEAVE_S)
        program.close()

    def stop(self) -> None:
        """End the process for good; called from another thread than `run`."""
        self._stopped = True
        program = self._program
        if program is not None:
            program.end()


def run_jobs(
    requests: Sequence[Request], settings: EngineSettings, at_a_time: int, requested_ns: int | None
) -> Generator[tuple[int, Record]]:
    """Run jobs; yields the position of each and the head of its record, as they end.

    Closing the iterator early, as an interrupt does, ends the running jobs without a record.
    ``at_a_time`` jobs share one machine and its memory; for ``requested_ns`` see `usable_record`.

    Raises a `ConfigurationError` if the cluster cannot be reached, and an `OSError` if dask's
    scheduler is lost.
    """
    if settings.elsewhere:
        yield from run_on_dask(execute, stop_jobs, requests, settings, requested_ns)
        return
    pool = ThreadPoolExecutor(min(at_a_time, len(requests)))
    futures = {
        pool.submit(execute, request, requested_ns, at_a_time): k
        for k, request in enumerate(requests)
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
"""Working folder -> worker processes without a job."""

_busy: set[WorkerProcess] = set()


def run_apart(
    request: Request, requested_ns: int | None = None, at_a_time: int = 1, *, aloud: bool = False
) -> Record:
    """Run a job as `attempt` does, in a worker process (see `WorkerProcess.run`)."""
    idle = _idle.setdefault(str(Path.cwd()), [])
    try:
        worker = idle.pop()
    except IndexError:
        worker = WorkerProcess()
    _busy.add(worker)
    try:
        run = partial(worker.run, request, at_a_time, aloud=aloud)
        return attempt(request, run, requested_ns)
    finally:
        _busy.remove(worker)
        idle.append(worker)


def execute(request: Request, requested_ns: int | None = None, at_a_time: int = 1) -> Record:
    """Run a job as `run_apart` does; returns the head of its record, also if none was written."""
    try:
        record = run_apart(request, requested_ns, at_a_time)
    except (MvestError, OSError) as error:
        record = failed_record(request, str(error))
    return head_of(record)


def stop_jobs() -> None:
    """End the running jobs of this process without a record."""
    for worker in list(_busy):
        worker.stop()
