"""Keeps one program: ends it, and all that it has started, with whoever asked for it.

Started by `mvest.processes` as ``_keeper.py LIFELINE GRACE_S PROGRAM [ARGUMENT ...]``. The lifeline
is a socket. Its other end is closed by the system with the process that holds it, however that one
ends; so no signal has to be caught, and no system needs more than processes and groups. Linux has
two things more: what leaves the program's group is handed to the keeper and ended by it, and the
program ends with a keeper that is killed.

Imports nothing but what starts in milliseconds, for there is one of these beside every program.
"""

import contextlib
import ctypes
import os
import resource
import select
import signal
import sys
import time

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""Of prctl(2)."""

MAX_WAIT_S, POLL_S = 2.0, 0.01
"""For what has been killed to be gone, which the system may delay; and between two looks at it."""


def main(lifeline: int, grace_s: float, command: list[str]) -> None:
    """Run the program to its end or that of the lifeline; ends as the program does."""
    woken, waker = os.pipe()
    os.set_inheritable(lifeline, False)
    os.set_blocking(waker, False)
    _prctl(PR_SET_CHILD_SUBREAPER, 1)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    program, failure = _start(command)
    with contextlib.suppress(OSError):
        os.write(lifeline, f"{failure} {program}".encode())
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    # Whoever ends a process by its number means the program.
    for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(which, lambda number, _: _signal(-program, number))
    events = select.poll()
    for end in (lifeline, woken):
        events.register(end, select.POLLIN)
    status = None
    while status is None:
        ready = {end for end, _ in events.poll()}
        if woken in ready:
            os.read(woken, 4096)
        status = _collect(program)
        if status is None and lifeline in ready:
            _signal(-program, signal.SIGTERM)
            status = _wait(program, grace_s)
            break
    status = _kill_all(program, status)
    if status is not None and os.WIFSIGNALED(status):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        number = os.WTERMSIG(status)
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(1 if status is None else os.WEXITSTATUS(status))


def _start(command: list[str]) -> tuple[int, int]:
    """Start the program in a session of its own; its number, and the error's if it cannot be."""
    keeper = os.getpid()
    heard, said = os.pipe()
    program = os.fork()
    if program == 0:
        try:
            os.setsid()
            _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
            if os.getppid() != keeper:
                # The keeper died before that was asked for.
                os._exit(1)
            for which in (signal.SIGPIPE, signal.SIGXFSZ):
                # Python ignores these, and what is ignored stays so.
                signal.signal(which, signal.SIG_DFL)
            os.execvp(command[0], command)
        except OSError as error:
            os.write(said, str(error.errno).encode())
        os._exit(127)
    os.close(said)
    failure = os.read(heard, 16)
    os.close(heard)
    return program, int(failure or 0)


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _collect(program: int) -> int | None:
    """Collect what has ended; the program's status if it is among that."""
    status = None
    while True:
        try:
            ended, how = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return status
        if not ended:
            return status
        if ended == program:
            status = how


def _wait(program: int, seconds: float) -> int | None:
    """Give the program time to end; its status if it does."""
    until = time.monotonic() + seconds
    while (status := _collect(program)) is None and time.monotonic() < until:
        time.sleep(POLL_S)
    return status


def _kill_all(program: int, status: int | None) -> int | None:
    """Kill the program's group, and what was handed to this process; the program's status."""
    until = time.monotonic() + MAX_WAIT_S
    while True:
        children = _children()
        for target in (-program, *children):
            _signal(target, signal.SIGKILL)
        ended = _collect(program)
        status = ended if status is None else status
        if (status is not None and not children) or time.monotonic() > until:
            return status
        time.sleep(POLL_S)


def _children() -> list[int]:
    """Processes whose parent this is, as far as the system lists them."""
    try:
        listed = os.open(f"/proc/self/task/{os.getpid()}/children", os.O_RDONLY)
    except OSError:
        return []
    try:
        return [int(child) for child in os.read(listed, 2**16).split()]
    finally:
        os.close(listed)


def _signal(target: int, which: int) -> None:
    """Signal a process, or the group that a negative number names, if there is anyone."""
    # macOS refuses where all of a group has ended and waits to be collected.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(target, which)


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3:])
