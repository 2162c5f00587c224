"""One run of one configuration: check it, compute, write the record and everything that follows.

As a program it runs jobs one after the other for the process that started it (`engine`): requests
are lines of JSON on standard input, answers are lines of JSON on standard output. The output of a
job, crashes of compiled code included, goes to the log in its folder.
"""

import faulthandler
import gc
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from experiments.common.building.closure import mechanics_of
from experiments.common.config import hash_of
from experiments.common.progress import wrapped
from experiments.common.records.record import Record
from experiments.common.records.writer import words_of, write_results
from experiments.common.schema import build
from experiments.common.study import Job, Results, load_study, study_names
from experiments.console import raised
from experiments.results.published import arrays_of
from experiments.runner import jobs
from experiments.runner.engine import run_apart
from experiments.runner.jobs import Request
from experiments.runner.tracking import require_no_password
from mvest.errors import ConfigurationError, InputError, MvestError, message_of
from mvest.reading.text import one_line


def require_admissible(values: Mapping[str, Any]) -> None:
    """Raise an `MvestError` that names a setting that no job could run with."""
    require_no_password(values["tracking"]["uri"])
    mechanics_of(values)
    load_study(values["study"]).require(values)


def check_of(values: Mapping[str, Any]) -> Callable[[Mapping[str, Any], Path], str]:
    """The check of a study; raises a `ConfigurationError` if it has none."""
    check = load_study(values["study"]).check
    if check is None:
        kinds = ", ".join(name for name in study_names() if load_study(name).check)
        raise ConfigurationError(
            f"experiment {values['name']}: a study of the kind {values['study']} has no "
            f"check=true; expected one of {kinds}"
        )
    return check


def run_job(request: Request) -> Record:
    """Run a job unless it is done, and show its result.

    It runs in this process unless it has a time limit.

    Raises an `MvestError` if a setting is inadmissible or a file cannot be written.
    """
    values, folder = request.values, request.folder
    record = jobs.usable_record(request)
    if record is not None:
        source = record.provenance
        _show(record, folder)
        print(
            f"Done on {source.finished} by commit {(source.git.sha or 'unknown')[:12]}; "
            "force=true runs it again"
        )
        return record
    if values["time_limit_s"] is None:
        memory_gb = values["memory_limit_gb"] or jobs.default_memory_gb()
        return jobs.attempt(request, partial(compute, request, memory_gb))
    # Only another process can be stopped at any moment.
    record = run_apart(request, aloud=True)
    if record.converged:
        _show(record, folder)
    return record


def compute(request: Request, memory_gb: float) -> None:
    """Run a job in its folder, which is locked, and write its record and all that follows.

    If a file after the record cannot be written, the next run of the job writes it and computes
    nothing again.

    Raises an `MvestError` if a setting is inadmissible or a file cannot be written, and a
    `MemoryError` that states the limit if it needs more memory.
    """
    folder, values = request.folder, request.values
    with jobs.held_memory(memory_gb):
        jobs.write_hydra(request)
        study = load_study(values["study"])
        record = jobs.last_record(folder, request.config_hash, cut_off=True)
        if record is None:
            started = time.time()
            settings = study.settings_of(values)
            result = study.run(Job(values, settings, folder, request.config_hash))
            if hash_of(values) != request.config_hash:
                # It is unknown which content was read.
                reason = "a file or folder that the settings name was changed before the job ended"
                result = result.changed(status="failed", reason=reason)
            record = jobs.replace_record(request, result, started)
        try:
            if values["figures"]:
                name = record.experiment
                write_results(folder, study, Results({name: record}, arrays_of(folder, name)))
                if study.files is not None:
                    study.files(folder, record)
            _show(record, folder)
            if record.converged:
                jobs.mark_done(folder)
        except MemoryError:
            raise
        except Exception as error:
            # Whatever a library for figures or texts raises, the numbers are on disk.
            raise InputError(
                f"{one_line(message_of(error))}; {jobs.UNWRITTEN.format(folder)}"
            ) from error


def _show(record: Record, folder: Path) -> None:
    """Print the result, its folder, and the file to open."""
    print(wrapped(words_of(load_study(record.study), record)))
    print(f"Written to {folder}")
    if (page := folder / "report.html").is_file():
        print(f"Report: {page}")


def main() -> None:
    """Answer requests until the input is closed."""
    requests, answers = (os.fdopen(os.dup(k), "rw"[k], encoding="utf-8") for k in (0, 1))
    # Neither the prints of a job nor the programs that it starts may use these two.
    nothing, terminal = os.open(os.devnull, os.O_RDWR), os.dup(2)
    os.dup2(nothing, 0)
    os.dup2(nothing, 1)
    faulthandler.enable()
    with suppress(OSError):  # the system kills this process first when memory runs out
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
    # On a signal to stop, it removes its temporary files.
    with suppress(KeyboardInterrupt), raised():
        for line in requests:
            order = json.loads(line)
            request = build(Request, order)
            with (request.folder / jobs.LOG).open("wb") as log:
                for stream in (1,) if order["aloud"] else (1, 2):
                    os.dup2(log.fileno(), stream)
            answered = answer(request, order["memory_gb"])
            with suppress(OSError):  # the log's disk is full
                sys.stdout.flush()
            os.dup2(nothing, 1)
            os.dup2(terminal, 2)
            answers.write(json.dumps(answered) + "\n")
            answers.flush()
            # Collect the garbage of this job; what stays is not searched again.
            gc.collect()
            gc.freeze()


def answer(request: Request, memory_gb: float) -> dict[str, Any]:
    """Run a job: the ``reason`` if it wrote no record, and whether the request is ``refused``."""
    try:
        compute(request, memory_gb)
    except Exception as error:
        # Compiled code reports an interruption as an error of its own, perhaps twice.
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise cause from None
            cause = cause.__cause__
        # Any error costs only its own job; the traceback is in the log.
        traceback.print_exception(error, file=sys.stdout)
        reason = one_line(message_of(error))
        return {"reason": reason, "refused": isinstance(error, MvestError)}
    return {"reason": None, "refused": False}


if __name__ == "__main__":
    main()
