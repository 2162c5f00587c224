"""One run of one configuration: build, simulate, estimate, write down."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from experiments.common.building.twin import require_room
from experiments.common.config import hash_of
from experiments.common.records.record import Record
from experiments.common.records.writer import words_of, write_results
from experiments.common.schema import build
from experiments.common.study import Job, Results, Study, load_study
from experiments.results.keep import arrays_of
from experiments.runner.execution.guard import run_apart
from experiments.runner.jobs.folder import (
    UNWRITTEN,
    attempt,
    last_record,
    mark_done,
    replace_record,
    usable_record,
    write_hydra,
)
from experiments.runner.jobs.limits import default_memory_gb, held_memory
from experiments.runner.jobs.request import Request
from mvest.errors import InputError, message_of
from mvest.reading.text import one_line


def run_job(request: Request) -> Record:
    """Run a job unless it is done, in this process unless it has a time limit; show its result.

    Raises
    ------
    MvestError
        If a setting is inadmissible or a file cannot be written.
    """
    values, folder = request.values, request.folder
    record = usable_record(request)
    if record is not None:
        source, study = record.provenance, load_study(record.study)
        _tell(record, folder)
        print(
            f"Done on {source.finished} by commit {(source.git.sha or 'unknown')[:12]}; "
            "force=true runs it again"
        )
        study.finish(_job(study, request), record)
        return record
    if values["time_limit_s"] is None:
        memory_gb = values["memory_limit_gb"] or default_memory_gb()
        return attempt(request, partial(compute, request, memory_gb))
    # Only another process can be stopped at any moment.
    record = run_apart(request, aloud=True)
    if record.converged:
        _tell(record, folder)
    return record


def compute(request: Request, memory_gb: float) -> None:
    """Run a job in its folder, which is locked, and write its record.

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
        record = last_record(request.folder, request.config_hash, cut_off=True)
        record = record or _computed(study, job, request)
        try:
            _write_out(study, request, record)
            study.finish(job, record)
        except MemoryError:
            raise
        except Exception as error:
            # Whatever a library for figures or texts raises: the numbers are not lost with it.
            missing = UNWRITTEN.format(request.folder)
            raise InputError(f"{one_line(message_of(error))}; {missing}") from error


def _job(study: Study[Any], request: Request) -> Job[Any]:
    settings = build(study.settings, request.values)
    return Job(request.values, settings, request.folder, request.config_hash)


def _computed(study: Study[Any], job: Job[Any], request: Request) -> Record:
    started = time.time()
    result = study.run(job)
    if hash_of(request.values) != request.config_hash:
        # Nobody can say of which content it is the result.
        reason = "a file or folder that the settings name was changed before the job ended"
        result = replace(result, status="failed", reason=reason)
    return replace_record(request, result, started)


def _write_out(study: Study[Any], request: Request, record: Record) -> None:
    """All that follows from a record on disk, and the marker that says so."""
    folder, name = request.folder, record.experiment
    if request.values["figures"]:
        write_results(folder, study, Results({name: record}, arrays_of(folder, name)))
        if study.files is not None:
            study.files(folder, record)
    _tell(record, folder)
    if record.converged:
        mark_done(folder)


def _tell(record: Record, folder: Path) -> None:
    """Print the result, and where it is."""
    print(words_of(load_study(record.study), record))
    print(f"Written to {folder}")
    if (page := folder / "report.html").is_file():
        print(f"Report: {page}")
