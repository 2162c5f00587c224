"""Processes that end with the one that started them: the one place that starts any that computes.

Whatever becomes of this process, a kill that nobody can catch included, a program that it has
started is ended within two seconds, and with it what that one has started in turn. A keeper beside
each program (`mvest._keeper`) sees to it.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

KEEPER = Path(__file__).with_name("_keeper.py")

ROOT = Path(__file__).resolve().parents[1]
"""What holds this package, and those that were installed with it."""

GRACE_S = 1.0
"""Between asking a program to stop and stopping it."""

LOOK_S = 0.5
"""Between two looks of a pool's process for the one that started it."""


class Program(AbstractContextManager["Program"]):
    """A running program, which ends with this process and takes with it all that it has started.

    It leads a session of its own, so that what a terminal tells this process does not reach it. As
    a context it is ended on leaving; otherwise when nothing refers to it any more.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments; no shell reads them.
    **options
        Of `subprocess.Popen`: streams, folder, environment.

    Attributes
    ----------
    process : subprocess.Popen
        Of the keeper: the streams are the program's, and it ends as the program does, with the
        same exit status or signal.
    pid : int
        Number of the program, and of its session and group.

    Raises
    ------
    OSError
        If the program cannot be started.
    """

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        self._lifeline, other = socket.socketpair()
        try:
            with other:
                keeper = [sys.executable, "-I", "-S", str(KEEPER), str(other.fileno())]
                self.process: subprocess.Popen[Any] = subprocess.Popen(
                    [*keeper, str(GRACE_S), *command],
                    pass_fds=(other.fileno(),),
                    start_new_session=True,
                    **options,
                )
            self.pid = self._begun(command[0])
        except BaseException:
            self._lifeline.close()
            raise

    def _begun(self, program: str) -> int:
        """The program's number, once it runs."""
        try:
            said = self._lifeline.recv(64).split()
        except BaseException:
            self.close()
            raise
        failure, pid = (int(word) for word in said or (b"0", b"0"))
        if failure or not pid:
            self.close()
            raise OSError(failure, os.strerror(failure) if failure else "it was killed", program)
        return pid

    def end(self) -> None:
        """Ask for the program's end, without waiting for it; from any thread."""
        with suppress(OSError):  # it has ended
            self._lifeline.shutdown(socket.SHUT_WR)
            # A keeper that was stopped does not notice.
            self.process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """End the program, and wait until it and all that it has started is gone."""
        self.end()
        self.process.wait()
        self._lifeline.close()
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                with suppress(OSError):
                    stream.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def python(module: str, *arguments: str) -> list[str]:
    """Command that runs a module in another Python; start it with an `environment`.

    The folder in which it is started is no place to import from: it may be a case of somebody else.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


def environment(**more: str) -> dict[str, str]:
    """Environment of another Python: this one's and ``more``; it finds the packages found here.

    Entries of ``PYTHONPATH`` that are empty or relative mean the working folder, and are left out.
    """
    places = [str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    path = os.pathsep.join(dict.fromkeys(filter(os.path.isabs, places)))
    return {**os.environ, "PYTHONPATH": path, **more}


def run(
    command: Sequence[str],
    *,
    input: str | None = None,
    timeout: float | None = None,
    **options: Any,
) -> subprocess.CompletedProcess[Any]:
    """Run a program to its end, as `subprocess.run` does; it ends with this process at the latest.

    Parameters
    ----------
    command : sequence of str
    input : str, optional
        For its standard input.
    timeout : float, optional
        s, after which it is ended.
    **options
        Of `subprocess.Popen`.

    Raises
    ------
    OSError
        If it cannot be started.
    subprocess.TimeoutExpired
        If it took longer.
    """
    if input is not None:
        options["stdin"] = subprocess.PIPE
    with Program(command, **options) as program:
        out, err = program.process.communicate(input, timeout)
        return subprocess.CompletedProcess(command, program.process.returncode, out, err)


def ending(code: int) -> str:
    """How a process ended, in words; a negative exit status is the signal that killed it."""
    if code >= 0:
        return f"exit status {code}"
    name = {int(known): known.name for known in signal.Signals}.get(-code, "unknown")
    hint = "; the system does so when memory runs out" if name == "SIGKILL" else ""
    return f"killed by signal {-code} ({name}{hint})"


def side_by_side(
    function: Callable[..., T], calls: Iterable[tuple[Any, ...]], processes: int
) -> Iterator[T]:
    """What a function returns for many arguments, in their order, from processes of one thread.

    Parameters
    ----------
    function : callable
        Of a module, so that another process can import it.
    calls : iterable of tuple
        Arguments of each call; taken as they are needed.
    processes : int
        1 computes here, without further processes.
    """
    if processes == 1:
        return (function(*arguments) for arguments in calls)
    import joblib  # and with it asyncio, which one process needs not wait for

    # joblib starts processes now and later, without -P.
    os.environ.update(environment(PYTHONSAFEPATH="1"))
    with joblib.parallel_config(
        backend="loky", inner_max_num_threads=1, initializer=_watch, initargs=(os.getpid(),)
    ):
        parallel = joblib.Parallel(n_jobs=processes, return_as="generator")
        return iter(parallel(joblib.delayed(function)(*arguments) for arguments in calls))


def _watch(parent: int) -> None:
    """End this process once its parent has ended.

    The system's own signal for that is none to use here: it comes when the thread ends that started
    this process, and a pool's processes are started by any thread.
    """

    def look() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_S)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=look, daemon=True).start()
