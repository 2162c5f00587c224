"""Start child processes that exit when their parent does. All computing processes start here.

A supervisor runs beside each program: this file, run as a script. It holds one end of a socket, the
lifeline. The system closes the other end when the parent dies, even of a signal that nobody can
catch. The supervisor then ends the program, and what that one has started, within two seconds. On
Linux it also ends what has left the program's process group (prctl(2), child subreaper), and the
program dies with a supervisor that is killed.

Imports only the standard library, so that a supervisor starts in milliseconds.
"""

from __future__ import annotations

import ctypes
import os
import resource
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

ROOT = Path(__file__).resolve().parents[1]
"""Folder that holds this package, and those that were installed with it."""

GRACE_S = 1.0
"""Time from asking a program to stop to killing it."""

MAX_WAIT_S = 2.0
"""Time that killed processes get to be gone."""

POLL_S, WATCH_S = 0.01, 0.5
"""Time between two looks at killed processes, and at the parent of a pool."""

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""Options of prctl(2)."""


class Program(AbstractContextManager["Program"]):
    """A running program, which ends with this process and takes with it all that it has started.

    It leads a session of its own, so that signals of a terminal do not reach it. A context manager
    ends it on leaving; otherwise it ends when nothing refers to it any more.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments; no shell reads them.
    **options
        Of `subprocess.Popen`: streams, folder, environment.

    Attributes
    ----------
    process : subprocess.Popen
        The supervisor. Its streams are the program's, and it ends with the program's exit status
        or signal.
    pid : int
        Number of the program, and of its session and group.

    Raises
    ------
    OSError
        If the program cannot be started.
    """

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        self._lifeline, other = socket.socketpair()
        supervisor = [sys.executable, "-I", "-S", __file__, str(other.fileno())]
        try:
            with other:
                self.process: subprocess.Popen[Any] = subprocess.Popen(
                    [*supervisor, *command],
                    pass_fds=(other.fileno(),),
                    start_new_session=True,
                    **options,
                )
        except BaseException:
            self._lifeline.close()
            raise
        try:
            failure, self.pid = map(int, self._lifeline.recv(64).split() or (0, 0))
            if failure or not self.pid:
                why = os.strerror(failure) if failure else "it was killed"
                raise OSError(failure, why, command[0])
        except BaseException:
            self.close()
            raise

    def end(self) -> None:
        """Ask for the program's end, without waiting for it; from any thread."""
        with suppress(OSError):  # it has ended
            self._lifeline.shutdown(socket.SHUT_WR)
            # A supervisor that was stopped does not notice.
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
            time.sleep(WATCH_S)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=look, daemon=True).start()


def _supervise(lifeline: int, command: list[str]) -> None:
    """Run a program to its end or that of the lifeline; end with its exit status or signal."""
    supervisor = os.getpid()
    os.set_inheritable(lifeline, False)
    _prctl(PR_SET_CHILD_SUBREAPER, 1)

    def end_with_supervisor() -> None:
        _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != supervisor:  # it died before
            os._exit(1)

    try:
        program = subprocess.Popen(command, start_new_session=True, preexec_fn=end_with_supervisor)
    except OSError as error:
        os.write(lifeline, f"{error.errno} 0".encode())
        os._exit(127)
    with suppress(OSError):
        os.write(lifeline, f"0 {program.pid}".encode())
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    # A signal to the supervisor is meant for the program.
    for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(which, lambda number, _: _signal(-program.pid, number))

    def end_with_lifeline() -> None:
        os.read(lifeline, 1)
        _signal(-program.pid, signal.SIGTERM)
        time.sleep(GRACE_S)
        _signal(-program.pid, signal.SIGKILL)

    threading.Thread(target=end_with_lifeline, daemon=True).start()
    status = program.wait()
    _kill_descendants(program.pid)
    if status < 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if status != -signal.SIGKILL:
            signal.signal(-status, signal.SIG_DFL)
        os.kill(supervisor, -status)
    os._exit(status)


def _kill_descendants(group: int) -> None:
    """Kill a program's group and the orphans that this process has adopted."""
    until = time.monotonic() + MAX_WAIT_S
    children = [0]
    while children and time.monotonic() < until:
        children = _children()
        for target in (-group, *children):
            _signal(target, signal.SIGKILL)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        time.sleep(POLL_S if children else 0)


def _children() -> list[int]:
    """Processes whose parent this is, where the system lists them."""
    with suppress(OSError):
        return [int(n) for n in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()]
    return []


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _signal(target: int, which: int) -> None:
    """Signal a process, or the group that a negative number names, if it exists."""
    # macOS refuses if all of a group has ended and waits to be collected.
    with suppress(ProcessLookupError, PermissionError):
        os.kill(target, which)


if __name__ == "__main__":
    _supervise(int(sys.argv[1]), sys.argv[2:])
