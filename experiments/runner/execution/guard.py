"""Runs a job in a process apart, so that its death costs its own row and nothing else.

Whoever works on a sweep keeps one such process and gives it job after job: what is imported and
compiled is paid for once. A process that was killed, or ran out of memory or time, is replaced.
"""

from __future__ import annotations

import atexit
import json
import signal
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from subprocess import PIPE, TimeoutExpired

from experiments.common.records.record import Record
from experiments.runner.jobs.folder import (
    finished_record,
    is_done,
    lock,
    make_way,
    read_result,
    require_writable,
    result_time,
    write_failure,
)
from experiments.runner.jobs.limits import MEMORY_LIMIT, default_memory_gb
from experiments.runner.jobs.request import Request
from mvest.errors import ConfigurationError
from mvest.processes import Program, environment, python
from mvest.provenance import THREAD_VARIABLES

WORKER = python("experiments.runner.execution.worker")
"""Command of a process that runs jobs."""

LEAVE_S = 2.0
"""For a process without a job to end by itself, before it is ended."""


class StoppedError(Exception):
    """A process was stopped from outside; of the job that it ran nothing is recorded."""


class WorkerProcess:
    """A process that runs jobs, started when the first one comes and again when one has ended it.

    Parameters
    ----------
    command : sequence of str
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._program: Program | None = None
        self._waits = False
        self._stopped = False
        atexit.register(self.close)

    @property
    def runs(self) -> bool:
        """Whether the process is there, with all that it has imported."""
        return self._program is not None

    def run(
        self,
        request: Request,
        time_limit_s: float | None = None,
        memory_limit_gb: float | None = None,
        *,
        aloud: bool = False,
    ) -> str | None:
        """Run one job; None if it left its record, otherwise the reason why it did not.

        ``aloud``: somebody waits for this one job, sees its progress, and is told if it is refused.

        Raises
        ------
        StoppedError
            If `stop` was called.
        ConfigurationError
            If a job that runs aloud is refused.
        """
        program = self._started()
        process = program.process
        assert process.stdin is not None
        assert process.stdout is not None
        expired = threading.Event()

        def stop() -> None:
            expired.set()
            program.end()

        timer = threading.Timer(time_limit_s or 0.0, stop)
        timer.daemon = True
        if time_limit_s is not None:
            timer.start()
        try:
            order = request.to_json() | {MEMORY_LIMIT: memory_limit_gb, "aloud": aloud}
            self._waits = False
            process.stdin.write(json.dumps(order) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        except BaseException:
            # Interrupted: the job's process is not to go on alone.
            self.close()
            raise
        finally:
            timer.cancel()
        if line.endswith("\n") and not expired.is_set():
            answered = json.loads(line)
            self._waits = True
            if not answered["healthy"]:
                self.close()
            if aloud and answered.get("refused"):
                raise ConfigurationError(answered["reason"])
            return None if answered["reason"] is None else str(answered["reason"])
        self.close()
        if self._stopped:
            raise StoppedError
        if expired.is_set():
            return f"time limit of {time_limit_s:g} s"
        limit = "" if memory_limit_gb is None else f"; memory limit {memory_limit_gb:.3g} GB"
        return _end(process.returncode) + limit

    def close(self) -> None:
        """End the process, and whatever it has started."""
        if self._program is None:
            return
        process = self._program.process
        if self._waits and process.stdin is not None:
            # Nothing more is asked for; a signal would come amid its leaving.
            with suppress(OSError):
                process.stdin.close()
            with suppress(TimeoutExpired):
                process.wait(LEAVE_S)
        self._program.close()
        self._program = None

    def stop(self) -> None:
        """End the process for good, from another thread than the one that waits for its job."""
        self._stopped = True
        program = self._program
        if program is not None:
            program.end()

    def _started(self) -> Program:
        if self._program is not None and self._program.process.poll() is not None:
            self.close()
        if self._program is None:
            self._program = Program(
                self._command,
                stdin=PIPE,
                stdout=PIPE,
                text=True,
                encoding="utf-8",
                env=environment(**dict.fromkeys(THREAD_VARIABLES, "1")),
            )
        if self._stopped:
            self.close()
            raise StoppedError
        return self._program


def new_worker() -> WorkerProcess:
    """One that runs the jobs of studies."""
    return WorkerProcess(WORKER)


@cache
def own_worker() -> WorkerProcess:
    """The one that this process keeps for a run by itself."""
    return new_worker()


def run_apart(
    request: Request,
    worker: WorkerProcess | None = None,
    asked_ns: int | None = None,
    at_a_time: int = 1,
    *,
    aloud: bool = False,
) -> Record:
    """Run a job in a process apart unless it is done already; its record, whatever happened.

    Parameters
    ----------
    request : Request
    worker : WorkerProcess, optional
        The one kept by this process if not given.
    asked_ns : int, optional
        When the job was asked for: one that is to be run again (``force``) need not be once more
        if it was done since.
    at_a_time : int
        Jobs that run on this machine beside each other and share its memory.
    aloud : bool
        As in `WorkerProcess.run`.

    Raises
    ------
    MvestError
        If nothing can be recorded, or a job that runs aloud is refused.
    """
    values, started = request.values, time.time()
    require_writable(request.folder)
    worker = worker or own_worker()
    with lock(request.folder):
        if not values["force"] or _done_since(request.folder, asked_ns):
            done = finished_record(request.folder, request.config_hash)
            if done is not None:
                return done
        make_way(request)
        memory = values["memory_limit_gb"] or default_memory_gb(at_a_time)
        reason = worker.run(request, values["time_limit_s"], memory, aloud=aloud)
        if reason is None:
            record = read_result(request.folder, request.config_hash)
            if record is not None:
                return record
            reason = "it left no record"
        return write_failure(request, reason, started)


def _done_since(folder: Path, asked_ns: int | None) -> bool:
    written = result_time(folder)
    if asked_ns is None or written is None:
        return False
    return written > asked_ns and is_done(folder)


def _end(code: int | None) -> str:
    """How a process ended, in words."""
    if code is None or code >= 0:
        return f"its process ended with exit status {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = "unknown"
    hint = "; the system does so when memory runs out" if name == "SIGKILL" else ""
    return f"killed by signal {-code} ({name}{hint})"
