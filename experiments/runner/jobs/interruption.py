"""What asks a command to stop: Ctrl-C, SIGTERM and SIGHUP all end it in the same way."""

from __future__ import annotations

import atexit
import functools
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import ParamSpec

P = ParamSpec("P")

ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask a process to stop."""


class Interruption(KeyboardInterrupt):
    """A signal has asked this process to stop.

    Parameters
    ----------
    number : int
        Of the signal.

    Attributes
    ----------
    status : int
        Exit status of a command that was stopped by it, as a shell counts: 130 after Ctrl-C, 143
        after SIGTERM, 129 after SIGHUP.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.status = 128 + number


@contextmanager
def raised() -> Iterator[None]:
    """Raise the first signal that asks to stop as an `Interruption`, where the main thread is.

    While that is dealt with, another SIGTERM or SIGHUP is no news: schedulers send several. Another
    Ctrl-C ends the process at once, as a kill would, which leaves nothing half-written either. A
    signal that is ignored, as ``nohup`` has it, stays so.
    """
    before = {number: signal.getsignal(number) for number in ASKING}
    asked = False

    def ask(number: int, _: FrameType | None) -> None:
        nonlocal asked
        if not asked:
            asked = True
            atexit.register(_ignore)
            raise Interruption(number)
        if number == signal.SIGINT:
            os._exit(128 + number)

    for number, handler in before.items():
        if handler != signal.SIG_IGN:
            signal.signal(number, ask)
    try:
        yield
    finally:
        # Whoever was asked to stop, here or within, is about to end; another signal may come until
        # then.
        for number, handler in before.items():
            if not asked and signal.getsignal(number) is ask:
                signal.signal(number, handler)


def _ignore() -> None:
    """Let no signal change the exit status of an interpreter that takes itself apart."""
    for number in ASKING:
        signal.signal(number, signal.SIG_IGN)


def interruptible(command: Callable[P, int]) -> Callable[P, int]:
    """A command that returns an exit status, also where a signal asks it to stop."""

    @functools.wraps(command)
    def stopped(*given: P.args, **named: P.kwargs) -> int:
        with raised():
            try:
                return command(*given, **named)
            except KeyboardInterrupt as error:
                print(
                    "interrupted: what is finished is kept, and the same command goes on from "
                    "there",
                    file=sys.stderr,
                )
                return error.status if isinstance(error, Interruption) else 128 + signal.SIGINT

    return stopped
