"""Runs jobs one after the other for the process that started it (`guard`).

Requests are lines of JSON on standard input, answers lines of JSON on standard output. What a job
itself prints, crashes of compiled code included, goes to the log in its folder.
"""

import faulthandler
import gc
import json
import os
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

from experiments.interruption import raised
from experiments.runner.execution.job import compute
from experiments.runner.jobs.folder import LOG
from experiments.runner.jobs.request import Request
from mvest.errors import MvestError, message_of
from mvest.reading.text import one_line


def main() -> None:
    """Answer requests until the input is closed."""
    requests, answers = (os.fdopen(os.dup(k), "rw"[k], encoding="utf-8") for k in (0, 1))
    # Neither what a job prints nor a program that it starts may reach these two.
    nothing, terminal = os.open(os.devnull, os.O_RDWR), os.dup(2)
    os.dup2(nothing, 0)
    os.dup2(nothing, 1)
    faulthandler.enable()
    with suppress(OSError):  # the system kills this process first when memory runs out
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
    # Asked to stop, it removes its temporary files.
    with suppress(KeyboardInterrupt), raised():
        for line in requests:
            order = json.loads(line)
            memory_gb, aloud = order.pop("memory_gb"), order.pop("aloud")
            request = Request.from_json(order)
            with (request.folder / LOG).open("wb") as log:
                for stream in (1,) if aloud else (1, 2):
                    os.dup2(log.fileno(), stream)
            answered = answer(request, memory_gb)
            with suppress(OSError):  # the log's disk is full
                sys.stdout.flush()
            os.dup2(nothing, 1)
            os.dup2(terminal, 2)
            answers.write(json.dumps(answered) + "\n")
            answers.flush()
            # What a job leaves behind goes before the next; what stays is not looked through again.
            gc.collect()
            gc.freeze()


def answer(request: Request, memory_gb: float) -> dict[str, Any]:
    """Run a job; the ``reason`` is None if it wrote its record.

    ``refused`` says that the request is wrong, and that this process may run another one.
    """
    try:
        compute(request, memory_gb)
    except Exception as error:
        # Whatever it is costs its own job; the traceback is in the log.
        traceback.print_exception(error, file=sys.stdout)
        reason = one_line(message_of(error))
        return {"reason": reason, "refused": isinstance(error, MvestError)}
    return {"reason": None, "refused": False}


if __name__ == "__main__":
    main()
