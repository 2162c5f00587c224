"""Start child processes that exit when their parent does. All computing processes start here.

A supervisor runs next to each program: this file as a script. It holds one end of a socket, the
lifeline. The system closes the other end when the parent dies, even if it is killed. The supervisor
then ends the program and its descendants within two seconds. On Linux it also ends descendants that
left the program's process group (prctl(2), child subreaper), and the program dies if its supervisor
is killed. Only the standard library is imported, so a supervisor starts in milliseconds.
"""

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
"""Folder of this package and of those that were installed with it."""

GRACE_S, MAX_WAIT_S, POLL_S, WATCH_S = 1.0, 2.0, 0.01, 0.5
"""From asking a program to stop to killing it; for killed processes to disappear; between two looks
at killed processes; and between two looks at the parent of a pool."""

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""Options of prctl(2)."""


class Program(AbstractContextManager["Program"]):
    """A running program that ends with this process, together with its descendants.

    It leads its own session, so that signals of a terminal do not reach it. A context manager ends
    it on exit; otherwise it ends when it is no longer referenced.

    OSError if the program cannot be started.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments; no shell reads them.
    **options
        Of `subprocess.Popen`: streams, folder, environment.

    Attributes
    ----------
    process : subprocess.Popen
        The supervisor, with the program's streams and its exit status or signal.
    pid : int
        Number of the program, and of its session and group.
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
        """Ask the program to end, without waiting for it; from any thread."""
        with suppress(OSError):  # it has ended
            self._lifeline.shutdown(socket.SHUT_WR)
            # A stopped supervisor would not notice.
            self.process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """End the program, and wait until it and its descendants have disappeared."""
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
    """Command that runs a module in another Python, to be started with an `environment`.

    It does not import from its working folder, which may be somebody else's case.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


def environment(**more: str) -> dict[str, str]:
    """The environment of another Python: the present one and ``more``, with the same packages.

    Empty and relative entries of ``PYTHONPATH`` mean the working folder and are left out.
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
    """Run a program as `subprocess.run` does; it never outlives this process.

    OSError if it cannot be started. subprocess.TimeoutExpired if it took longer.

    Parameters
    ----------
    command : sequence of str
    input : str, optional
        For its standard input.
    timeout : float, optional
        s; the program is ended after this time.
    **options
        Of `subprocess.Popen`.
    """
    if input is not None:
        options["stdin"] = subprocess.PIPE
    with Program(command, **options) as program:
        out, err = program.process.communicate(input, timeout)
        return subprocess.CompletedProcess(command, program.process.returncode, out, err)


def ending(code: int) -> str:
    """How a process ended; a negative exit status is the number of the signal that killed it."""
    if code >= 0:
        return f"exit status {code}"
    name = {int(known): known.name for known in signal.Signals}.get(-code, "unknown")
    hint = "; the system does so when memory runs out" if name == "SIGKILL" else ""
    return f"killed by signal {-code} ({name}{hint})"


def side_by_side(
    function: Callable[..., T], calls: Iterable[tuple[Any, ...]], processes: int
) -> Iterator[T]:
    """Results of a function for many arguments, in order, from processes with one thread each.

    Parameters
    ----------
    function : callable
        Importable by another process.
    calls : iterable of tuple
        Arguments of each call, consumed when needed.
    processes : int
        1 computes in this process.
    """
    if processes == 1:
        return (function(*arguments) for arguments in calls)
    import joblib  # slow to import

    # joblib starts its processes without -P.
    os.environ.update(environment(PYTHONSAFEPATH="1"))
    with joblib.parallel_config(
        backend="loky", inner_max_num_threads=1, initializer=_watch, initargs=(os.getpid(),)
    ):
        parallel = joblib.Parallel(n_jobs=processes, return_as="generator")
        return iter(parallel(joblib.delayed(function)(*arguments) for arguments in calls))


def _watch(parent: int) -> None:
    """End this process when its parent has ended.

    PR_SET_PDEATHSIG is no alternative: it acts when the starting thread ends, and any thread may
    start the processes of a pool.
    """

    def look() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=look, daemon=True).start()


def _supervise(lifeline: int, command: list[str]) -> None:
    """Run a program until it or the lifeline ends; end with its exit status or signal."""
    supervisor = os.getpid()
    os.set_inheritable(lifeline, False)
    _prctl(PR_SET_CHILD_SUBREAPER, 1)

    def end_with_supervisor() -> None:
        _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != supervisor:  # it has died already
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
    # Pass signals on to the program.
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
    until, children = time.monotonic() + MAX_WAIT_S, [group]
    while children and time.monotonic() < until:
        children = []
        with suppress(OSError):  # only Linux lists them
            listed = Path(f"/proc/self/task/{os.getpid()}/children").read_text()
            children = [int(number) for number in listed.split()]
        for target in (-group, *children):
            _signal(target, signal.SIGKILL)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        time.sleep(POLL_S if children else 0)


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _signal(target: int, which: int) -> None:
    """Signal a process, or the group of a negative number, if it exists."""
    # macOS refuses if the whole group has ended but was not waited for.
    with suppress(ProcessLookupError, PermissionError):
        os.kill(target, which)


if __name__ == "__main__":
    _supervise(int(sys.argv[1]), sys.argv[2:])
