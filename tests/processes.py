"""Finds processes that work in a folder, to test that none is left behind."""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

linux = pytest.mark.skipif(not Path("/proc/self").exists(), reason="finds the processes in /proc")


def living(folder: Path) -> list[int]:
    """The processes, not this one, that work in a folder or below."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            lives = (place / "stat").read_text().rsplit(") ", 1)[1][0] != "Z"
            here = (place / "cwd").readlink().is_relative_to(folder.resolve())
            if lives and here and int(place.name) != os.getpid():
                found.append(int(place.name))
    return found


def command_of(process: int) -> str:
    """Its command line."""
    return Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ")


def alive(folder: Path) -> list[str]:
    """Command lines of the processes, not this one, that work in a folder or below."""
    found = []
    for process in living(folder):
        with suppress(OSError):
            found.append(command_of(process))
    return found


def until(condition: Callable[[], bool], within_s: float = 120.0) -> None:
    """Wait."""
    stop = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < stop, "waited in vain"
        time.sleep(0.05)


def gone(folder: Path, within_s: float = 5.0) -> bool:
    """Whether nothing lives in a folder any more, within so many seconds."""
    stop = time.monotonic() + within_s
    while alive(folder) and time.monotonic() < stop:
        time.sleep(0.05)
    return not alive(folder)
