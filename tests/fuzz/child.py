"""A process that reads damaged files, and what its parent sees of each.

The child sets its limits itself before each file, above what it has used so far: 5 s of computing
(the kernel ends it) and 1 GiB of address space (it meets a `MemoryError`, also one that a reader
makes an error of its own). Libraries end a process as well; the parent then starts another one.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from mvest.errors import MvestError
from tests.places import ROOT

__all__ = ["MAX_BYTES", "MAX_LETTERS", "MAX_SECONDS", "Child", "Outcome"]

MAX_SECONDS, MAX_WAIT = 5, 120
"""Of computing; and of waiting for a process that computes nothing, or cannot."""
MAX_BYTES = 2**30
MAX_LETTERS = 300
"""Of a message, the folder of the file aside."""


@dataclass(frozen=True)
class Outcome:
    """How a reader ended: ``read``, ``refused``, or by one of the faults.

    Faults are ``outside`` (an exception of another family), ``message``, ``memory``, ``slow`` and
    ``died``.
    """

    kind: str
    words: str = ""
    seconds: float = 0.0

    @property
    def faulty(self) -> bool:
        return self.kind not in ("read", "refused")


class Child:
    """Starts a process when there is something to read, and again after it has died."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._answers: queue.Queue[str] = queue.Queue()

    def __enter__(self) -> Child:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._end()

    def read(self, reader: str, path: Path, *, limited: bool = True) -> Outcome:
        """Let the child read a file; `limited` is False for the first of a reader, a valid one."""
        process = self._running()
        assert process.stdin is not None
        question = {"reader": reader, "path": str(path), "limited": limited}
        process.stdin.write(json.dumps(question) + "\n")
        process.stdin.flush()
        try:
            answer = self._answers.get(timeout=MAX_WAIT)
        except queue.Empty:
            self._end()
            return Outcome("slow", f"more than {MAX_WAIT} s of waiting", MAX_WAIT)
        if answer:
            return Outcome(**json.loads(answer))
        code = process.wait()
        self._end()
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            return Outcome("slow", f"more than {MAX_SECONDS} s of computing", MAX_SECONDS)
        return Outcome("died", f"exit status {code}")

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._answers = queue.Queue()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.fuzz.child"],
                cwd=ROOT,
                env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                encoding="utf-8",
            )
            threading.Thread(
                target=_collect, args=(self._process, self._answers), daemon=True
            ).start()
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            for stream in (self._process.stdin, self._process.stdout):
                assert stream is not None
                with contextlib.suppress(BrokenPipeError):
                    stream.close()
            self._process.wait()
            self._process = None


def _collect(process: subprocess.Popen[str], answers: queue.Queue[str]) -> None:
    """Lines of the child, and an empty one at its end."""
    assert process.stdout is not None
    with contextlib.suppress(ValueError):  # closed by the parent
        for line in process.stdout:
            answers.put(line)
    answers.put("")


def outcome(read: Callable[[Path], object], path: Path) -> Outcome:
    """How a reader ends in this process."""
    start = time.process_time()
    kind, words = "read", ""
    try:
        read(path)
    except MvestError as error:
        message = str(error)
        kind, words = "refused" if _fits(message, path) else "message", message
        if _is_memory(error):
            kind = "memory"
    except Exception as error:
        kind, words = "outside", f"{type(error).__name__}: {error}"
        if _is_memory(error):
            kind = "memory"
    return Outcome(kind, words[:2000], time.process_time() - start)


def _fits(message: str, path: Path) -> bool:
    """Whether a message is one short line with the name of the file, or of one beside it."""
    short = message.replace(f"{path.parent}{os.sep}", "")
    named = any(file.name in message for file in path.parent.iterdir())
    return named and message.isprintable() and len(short) <= MAX_LETTERS


def _is_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _limit() -> None:
    """At most so much more than has been used."""
    import resource

    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = math.ceil(used.ru_utime + used.ru_stime) + MAX_SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.RLIM_INFINITY))
    pages = Path("/proc/self/statm")
    if pages.exists():
        taken = int(pages.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + MAX_BYTES, resource.RLIM_INFINITY))


def _unlimit() -> None:
    import resource

    for limit in (resource.RLIMIT_CPU, resource.RLIMIT_AS):
        resource.setrlimit(limit, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def main() -> None:
    """Answer each line of the input by one of the output; what libraries print goes nowhere."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    import resource

    from tests.fuzz.readers import READERS

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for line in sys.stdin:
        question: dict[str, Any] = json.loads(line)
        if question["limited"]:
            _limit()
        found = outcome(READERS[question["reader"]].read, Path(question["path"]))
        _unlimit()
        answers.write(
            json.dumps({"kind": found.kind, "words": found.words, "seconds": found.seconds}) + "\n"
        )
        answers.flush()


if __name__ == "__main__":
    main()
