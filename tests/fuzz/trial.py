"""How an importer ends on a file, within limits of memory and of computing."""

from __future__ import annotations

import os
import random
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from mvest.errors import MvestError
from tests.fuzz.mutation import changed

MAX_SECONDS, MAX_BYTES, MAX_LETTERS = 5, 2**30, 300
"""CPU seconds, additional memory, and length of a message without its folder."""
FAULTS = ("outside", "message", "memory", "slow")
ENDS = ("read", "refused", "stopped", *FAULTS)


Enter = Callable[[Path], object]
"""Takes a file, or the folder that it is in; what it returns does not matter."""
Makers = tuple[Callable[[Path], Path], ...]
"""Each writes valid files into an empty folder, and returns the one that is damaged."""


class Late(BaseException):
    """More than `MAX_SECONDS` of computing."""


class Bench:
    """The valid files of an importer in a folder, which damaged ones replace."""

    def __init__(self, enter: Enter, makers: Makers, folder: Path) -> None:
        self.enter, self.paths = enter, list[Path]()
        for number, maker in enumerate(makers):
            (folder / str(number)).mkdir(parents=True)
            self.paths.append(maker(folder / str(number)))
        self.contents = [path.read_bytes() for path in self.paths]
        self.whole = [outcome(self.enter, path) for path in self.paths]
        """How the valid files are read, which also loads what the importer needs."""

    def damaged(self, seed: int) -> tuple[int, bytes]:
        """The number of a valid file, and damaged bytes of it."""
        draw = random.Random(seed)
        number = draw.randrange(len(self.paths))
        return number, changed(self.contents[number], draw)

    def tried(self, content: bytes, number: int = 0) -> tuple[str, str]:
        """How the importer ends on bytes in the place of a valid file, and in which words."""
        path = self.paths[number]
        path.write_bytes(content)
        with limited():
            found = outcome(self.enter, path)
        if found[0] == "stopped":
            # The next child is started here, as it would have the limits of this process.
            path.write_bytes(self.contents[number])
            outcome(self.enter, path)
        return found


def outcome(enter: Enter, path: Path) -> tuple[str, str]:
    """One of `ENDS`, and the message."""
    try:
        enter(path)
    except MvestError as error:
        words = str(error)
        short = words.replace(f"{path.parent}{os.sep}", "")
        named = words.startswith(f"{path.parent}") or path.name in words
        if of_memory(error):
            return "memory", words
        if not (named and words.isprintable() and len(short) <= MAX_LETTERS):
            return "message", words
        return ("stopped" if "(limits " in words else "refused"), words
    except Late:
        return "slow", f"more than {MAX_SECONDS} s"
    except Exception as error:
        return ("memory" if of_memory(error) else "outside"), f"{type(error).__name__}: {error}"
    return "read", ""


def of_memory(error: BaseException | None) -> bool:
    """Whether there was too little memory, whatever it was made into."""
    while error is not None and not isinstance(error, MemoryError):
        error = error.__cause__ or error.__context__
    return error is not None


@contextmanager
def limited() -> Iterator[None]:
    """At most so much more than has been used."""

    def late(number: int, frame: object) -> NoReturn:
        raise Late

    before = resource.getrlimit(resource.RLIMIT_AS)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGPROF, late)
    resource.setrlimit(resource.RLIMIT_AS, (taken + MAX_BYTES, before[1]))
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGPROF, handler)
