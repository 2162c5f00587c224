"""How a command ends: one line if it is refused, or stopped by Ctrl-C, SIGTERM or SIGHUP."""

import argparse
import atexit
import functools
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, ParamSpec

from mvest.errors import MvestError, message_of

P = ParamSpec("P")

ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # signals that ask a process to stop
TRACEBACKS = "HYDRA_FULL_ERROR"  # environment variable that turns tracebacks on
AGAIN_S = 0.01  # time after which a signal is sent again that Python has dropped


class Interruption(KeyboardInterrupt):
    """Signal ``number`` stopped this process.

    ``status`` is the exit status: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.status = 128 + number


@contextmanager
def raised() -> Iterator[None]:
    """Raise the first signal that asks to stop as an `Interruption` in the main thread.

    Further SIGTERM and SIGHUP are then ignored, because schedulers send several. A further Ctrl-C
    ends the process at once; like a kill, it leaves nothing half-written. An ignored signal, as
    with ``nohup``, stays ignored. Python drops exceptions in a weak reference's callback or a
    ``__del__``; such a signal is sent again.
    """
    unraisable = sys.unraisablehook
    before = {number: signal.getsignal(number) for number in ASKING}
    stopped = False

    def ask(number: int, _: FrameType | None) -> None:
        nonlocal stopped
        if not stopped:
            stopped = True
            atexit.register(_ignore)
            raise Interruption(number)
        if number == signal.SIGINT:
            os._exit(128 + number)

    def again(number: int) -> None:
        nonlocal stopped
        stopped = False
        signal.pthread_kill(threading.main_thread().ident or 0, number)

    def dropped(lost: "sys.UnraisableHookArgs") -> None:
        if isinstance(lost.exc_value, Interruption):
            threading.Timer(AGAIN_S, again, (lost.exc_value.status - 128,)).start()
        else:
            unraisable(lost)

    sys.unraisablehook = dropped
    for number, handler in before.items():
        if handler != signal.SIG_IGN:
            signal.signal(number, ask)
    try:
        yield
    finally:
        sys.unraisablehook = unraisable
        # A stopped process is about to end; another signal may come until then.
        for number, handler in before.items():
            if not stopped and signal.getsignal(number) is ask:
                signal.signal(number, handler)


def _ignore() -> None:
    """Let no signal change the exit status of an interpreter that shuts down."""
    for number in ASKING:
        signal.signal(number, signal.SIG_IGN)


def interruptible(command: Callable[P, int]) -> Callable[P, int]:
    """A command that returns an exit status, also if it is refused or stopped."""

    @functools.wraps(command)
    def stopped(*given: P.args, **named: P.kwargs) -> int:
        with raised():
            try:
                status = command(*given, **named)
                sys.stdout.flush()
                return status
            except BrokenPipeError:
                # The reader of the output has closed it, as `head` does.
                with suppress(OSError):
                    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                return 128 + signal.SIGPIPE
            except (MvestError, OSError) as error:
                if TRACEBACKS in os.environ:
                    raise
                print(f"error: {message_of(error).splitlines()[0]}", file=sys.stderr)
                return 2
            except KeyboardInterrupt as error:
                done = "finished results are on disk, and the same command goes on from there"
                print(f"interrupted: {done}", file=sys.stderr)
                return error.status if isinstance(error, Interruption) else 128 + signal.SIGINT

    return stopped


class _Form(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Help with defaults, and descriptions as they are written."""


class Parser(argparse.ArgumentParser):
    """A parser of a command's words that refuses wrong ones in one line.

    ``example`` is shown at the end of the help. ``arguments`` maps names to arguments of
    `argparse.ArgumentParser.add_argument`; an argument is a path unless it has another type.
    """

    def __init__(
        self,
        command: str,
        about: str,
        example: str,
        arguments: Mapping[str, Mapping[str, Any]],
        usage: str | None = None,
    ) -> None:
        super().__init__(command, usage, about, epilog=f"example: {example}", formatter_class=_Form)
        for name, given in arguments.items():
            default = {} if "action" in given else {"type": Path}
            self.add_argument(name, **{**default, **given})

    def error(self, message: str) -> NoReturn:
        """Print it and exit with status 2."""
        self.exit(2, f"error: {message}\n")
