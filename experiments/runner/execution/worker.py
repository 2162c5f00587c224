"""Runs jobs one after the other for the process that started it.

Started as ``python -m experiments.runner.execution.worker``.

Requests come as lines of JSON on standard input, answers leave as lines of JSON on standard output.
What a job itself prints, crashes of compiled code included, goes to the log in its folder.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from experiments.runner.execution.check import require_room
from experiments.runner.execution.job import compute
from experiments.runner.jobs.folder import LOG, FailedRunError
from experiments.runner.jobs.interruption import raised
from experiments.runner.jobs.limits import MEMORY_LIMIT, held_memory
from experiments.runner.jobs.request import Request
from mvest.errors import MvestError

PREFERRED_VICTIM = "500"
"""Added to the badness by which Linux chooses whom to kill when memory runs out."""


def main() -> None:
    """Answer requests until the input is closed."""
    requests = os.fdopen(os.dup(sys.stdin.fileno()), "r", encoding="utf-8")
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    # Neither what a job prints nor a program that it starts may reach these two.
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1):
        os.dup2(nothing, stream)
    faulthandler.enable()
    _volunteer()
    # Asked to stop, it takes its temporary files away.
    with suppress(KeyboardInterrupt), raised():
        for line in requests:
            order = json.loads(line)
            limit_gb, aloud = order.pop(MEMORY_LIMIT), order.pop("aloud")
            request = Request.from_json(order)
            # Whoever waits for one job sees its progress.
            streams = (1,) if aloud else (1, 2)
            with _output_to(request.folder / LOG, streams):
                answered = answer(request, limit_gb)
            answers.write(json.dumps(answered) + "\n")
            answers.flush()
            # What a job leaves behind goes before the next; what stays is not looked through again.
            gc.collect()
            gc.freeze()


def answer(request: Request, memory_limit_gb: float | None = None) -> dict[str, Any]:
    """Run one job: ``{"reason": None}`` if it left its record, otherwise why it did not.

    ``healthy`` says whether another job may be run in this process, ``refused`` that nothing was
    computed because what was asked for is wrong.
    """
    memory = nullcontext() if memory_limit_gb is None else held_memory(memory_limit_gb)
    held = None
    try:
        with memory as held:
            if memory_limit_gb is not None:
                require_room(request.values, memory_limit_gb)
            compute(request)
    except FailedRunError:
        return {"reason": None, "healthy": True}
    except MvestError as error:
        print(f"error: {error}")
        return {"reason": _line(error), "healthy": True, "refused": True}
    except MemoryError as error:
        _trace(error)
        reason = ["out of memory" if held is None else str(held), _line(error)]
        return {"reason": ": ".join(filter(None, reason)), "healthy": False}
    except OSError as error:
        _trace(error)
        return {"reason": _line(error), "healthy": True}
    except Exception as error:
        # Whatever it is costs its own job; the traceback is in the log.
        _trace(error)
        return {"reason": f"{type(error).__name__}: {_line(error)}", "healthy": False}
    return {"reason": None, "healthy": True}


def _line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return (str(error).strip().splitlines() or [""])[0]


def _trace(error: BaseException) -> None:
    traceback.print_exception(error, file=sys.stdout)


@contextmanager
def _output_to(path: Path, streams: Sequence[int]) -> Iterator[None]:
    """Standard output (1) and error (2) of this process, or one of them, go to a file."""
    log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
    before = [os.dup(stream) for stream in streams]
    try:
        for stream in streams:
            os.dup2(log, stream)
        yield
    finally:
        for stream, usual in zip(streams, before, strict=True):
            _flush()
            os.dup2(usual, stream)
            os.close(usual)
        os.close(log)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            # The log's disk is full; what became of the job is told by its answer.
            continue


def _volunteer() -> None:
    """Let the system take this process before the one that could record its death."""
    place = Path("/proc/self/oom_score_adj")
    if place.exists():
        try:
            place.write_text(PREFERRED_VICTIM, encoding="ascii")
        except OSError:
            return


if __name__ == "__main__":
    main()
