"""One run of one configuration: build, simulate, estimate, write down, log."""

from __future__ import annotations

import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.common.config import hash_of, without_places
from experiments.common.records.record import Record, stamp
from experiments.common.records.writer import words_of, write_results
from experiments.common.schema import build
from experiments.common.study import Job, Results, Study, load_study
from experiments.results.keep import arrays_of
from experiments.results.publish import publish_run
from experiments.runner.execution.check import require_checks, require_room
from experiments.runner.execution.guard import run_apart
from experiments.runner.jobs.folder import (
    CONFIG,
    RESULT,
    UNWRITTEN,
    FailedRunError,
    computed_record,
    lock,
    make_way,
    mark_done,
    replace_record,
    require_writable,
    usable_record,
    write_failure,
    write_hydra,
)
from experiments.runner.jobs.limits import default_memory_gb, held_memory
from experiments.runner.jobs.request import Request
from experiments.runner.tracking.store import require_no_password
from mvest.errors import InputError, MvestError
from mvest.provenance import write_json
from mvest.reading.text import one_line


def run_job(request: Request) -> None:
    """Run a job, in this process unless it has a time limit; if it is done, show its result.

    Raises
    ------
    MvestError
        If a setting is inadmissible or a file cannot be written.
    FailedRunError
        If the computation found no estimate; the run is recorded all the same.
    """
    values, folder = request.values, request.folder
    study = load_study(values["study"])
    require_no_password(values["tracking"]["uri"])
    require_writable(folder)
    if values["check"]:
        for check in require_checks(study, values):
            print(check(values, folder), flush=True)
        return
    record = usable_record(request)
    if record is not None:
        source = record.provenance
        _tell(study, record, folder)
        print(
            f"Done on {source.finished} by commit {(source.git.sha or 'unknown')[:12]}; "
            "force=true runs it again"
        )
        study.finish(_job(study, request), record)
    elif values["time_limit_s"] is not None:
        # Only another process can be stopped at any moment.
        record = run_apart(request, aloud=True)
        if record.converged:
            _tell(study, record, folder)
    else:
        with lock(folder):
            record = usable_record(request) or _run_here(request)
    publish_run(values, record, folder, request.publish_as)
    if not record.converged:
        detail = f" ({record.detail})" if record.detail else ""
        raise FailedRunError(f"{record.reason}{detail} (recorded in {folder / RESULT})")


def _run_here(request: Request) -> Record:
    make_way(request)
    started = time.time()
    try:
        return compute(request, request.values["memory_limit_gb"] or default_memory_gb())
    except MemoryError as error:
        return write_failure(request, str(error), started)


def compute(request: Request, memory_gb: float) -> Record:
    """Run a job in its folder, which is locked; returns its record, which is then on disk.

    The record comes first. Where something after it cannot be written, the next run of the job
    writes that, and computes nothing again.

    Raises
    ------
    MvestError
        If a setting is inadmissible or a file cannot be written.
    MemoryError
        If it needs more memory; the message states the limit.
    """
    require_room(request.values, memory_gb)
    with held_memory(memory_gb):
        write_hydra(request)
        study = load_study(request.values["study"])
        job = _job(study, request)
        record = None
        if not request.values["force"]:
            record = computed_record(request.folder, request.config_hash)
        if record is None:
            record = _computed(study, job, request)
        try:
            _write_out(study, request, record)
            study.finish(job, record)
        except MemoryError:
            raise
        except Exception as error:
            # Whatever a library for figures or texts raises: the numbers are not lost with it.
            missing = UNWRITTEN.format(request.folder)
            raise InputError(f"{reason_of(error)}; {missing}") from error
        return record


def answer(request: Request, memory_gb: float) -> dict[str, Any]:
    """What a worker answers: the ``reason`` is None if the job wrote its record.

    ``refused`` says that the request is wrong, and that this process may run another one.
    """
    try:
        compute(request, memory_gb)
    except Exception as error:
        # Whatever it is costs its own job; the traceback is in the log.
        traceback.print_exception(error, file=sys.stdout)
        return {"reason": reason_of(error), "refused": isinstance(error, MvestError)}
    return {"reason": None, "refused": False}


def reason_of(error: Exception) -> str:
    """Why a job has no result, in one line."""
    text = one_line(error)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MvestError):
        return text
    if isinstance(error, MemoryError):
        return text or "out of memory"
    return f"{type(error).__name__}: {text}"


def _computed(study: Study[Any], job: Job[Any], request: Request) -> Record:
    started = time.time()
    result = study.run(job)
    if hash_of(request.values) != request.config_hash:
        # Nobody can say of which content it is the result.
        reason = "a file or folder that the settings name was changed before the job ended"
        result = replace(result, status="failed", reason=reason)
    record = stamp(request.values, request.config_hash, result, started)
    replace_record(request.folder, record, result.arrays)
    return record


def _write_out(study: Study[Any], request: Request, record: Record) -> None:
    """All that follows from a record on disk, and the marker that says so."""
    folder, name = request.folder, record.experiment
    write_json(folder / CONFIG, without_places(request.values))
    if request.values["figures"]:
        write_results(folder, study, Results({name: record}, arrays_of(folder, name)))
        if study.files is not None:
            study.files(folder, record)
    _tell(study, record, folder)
    if record.converged:
        mark_done(folder)


def _tell(study: Study[Any], record: Record, folder: Path) -> None:
    """Print the result, and where it is."""
    print(words_of(study, record))
    print(f"Written to {folder}")
    if (page := folder / "report.html").is_file():
        print(f"Report: {page}")


def _job(study: Study[Any], request: Request) -> Job[Any]:
    settings = build(study.settings, request.values)
    return Job(request.values, settings, request.folder, request.config_hash)
