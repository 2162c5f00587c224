"""One run of one configuration: build, simulate, estimate, write down, log."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.config import hash_of, without_places
from experiments.common.records.record import FIELDS, Record, stamp, write_record
from experiments.common.records.writer import words_of, write_results
from experiments.common.schema import build
from experiments.common.study import Check, Job, Results, Study, load_study, study_names
from experiments.results.keep import arrays_of, publish
from experiments.runner.execution.check import require_room
from experiments.runner.execution.guard import run_apart
from experiments.runner.jobs.folder import (
    CONFIG,
    RESULT,
    FailedRunError,
    computed_record,
    finished_record,
    lock,
    make_way,
    mark_done,
    require_writable,
    unwritten,
    write_failure,
)
from experiments.runner.jobs.limits import MEMORY_LIMIT, default_memory_gb, held_memory
from experiments.runner.jobs.request import Request
from experiments.runner.tracking.store import require_no_password
from mvest.errors import ConfigurationError, InputError
from mvest.files import write_atomically
from mvest.provenance import write_json
from mvest.reading.text import one_line


def run_job(request: Request) -> None:
    """Run a job in this process, unless it is done.

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
    if values["time_limit_s"] is not None:
        # Only another process can be stopped at any moment.
        record = run_apart(request, aloud=True)
        _raise_failure(record, folder)
        print(words_of(study, record))
        print(f"Written to {folder}")
        return
    with lock(folder):
        done = None if values["force"] else finished_record(folder, request.config_hash)
        if done is None:
            make_way(request)
            _compute_here(request)
            return
    print(words_of(study, done))
    source = done.provenance
    print(
        f"Done on {source.finished} by commit {(source.git.sha or 'unknown')[:12]}, in "
        f"{folder}; force=true runs it again"
    )
    _publish(study, request, done)
    study.finish(_job(study, request), done)


def _compute_here(request: Request) -> None:
    """Run a job in this process, which is held to its memory."""
    started, held = time.time(), None
    limit_gb = request.values[MEMORY_LIMIT] or default_memory_gb()
    require_room(request.values, limit_gb)
    try:
        with held_memory(limit_gb) as held:
            compute(request)
    except MemoryError as error:
        reason = ": ".join(filter(None, [str(held), str(error)]))
        _raise_failure(write_failure(request, reason, started), request.folder)


def compute(request: Request) -> None:
    """Run a job in its folder, which exists; its record and figures are then on disk.

    The record comes first. Where something after it cannot be written, the next run of the job
    writes that, and computes nothing again.

    Raises
    ------
    MvestError
        If a setting is inadmissible or a file cannot be written.
    FailedRunError
        If the computation found no estimate; the run is recorded all the same.
    """
    started = time.time()
    values, folder = request.values, request.folder
    study = load_study(values["study"])
    job = _job(study, request)
    record = computed_record(folder, request.config_hash)
    if record is None:
        result = study.run(job)
        if hash_of(values) != request.config_hash:
            # Nobody can say of which content it is the result.
            reason = "a file or folder that the settings name was changed before the job ended"
            result = replace(result, status="failed", reason=reason)
        (folder / FIELDS).unlink(missing_ok=True)  # of an earlier run
        if result.arrays:
            write_atomically(folder / FIELDS, partial(np.savez_compressed, **result.arrays))
        record = stamp(values, request.config_hash, result, started)
        write_json(folder / CONFIG, without_places(values))
        write_record(folder / RESULT, record)
    try:
        _write_out(study, request, record)
        study.finish(job, record)
    except MemoryError:
        raise
    except Exception as error:
        # Whatever a library for figures or texts raises: the numbers are not lost with it.
        why = one_line(error) or type(error).__name__
        raise InputError(f"{why}; {unwritten(folder)}") from error
    _raise_failure(record, folder)


def _write_out(study: Study[Any], request: Request, record: Record) -> None:
    """All that follows from a record on disk, and the marker that says so."""
    folder, name = request.folder, record.experiment
    if request.values["figures"]:
        write_results(folder, study, Results({name: record}, arrays_of(folder, name)))
        if study.files is not None:
            study.files(folder, record)
    print(words_of(study, record))
    print(f"Written to {folder}")
    _publish(study, request, record)
    if record.converged:
        mark_done(folder)


def require_checks(study: Study[Any], values: Mapping[str, Any]) -> tuple[Check, ...]:
    """What ``check=true`` says of a study.

    Raises
    ------
    ConfigurationError
        If it has nothing to say of studies of this kind.
    """
    checks = study.checks()
    if not checks:
        kinds = ", ".join(name for name in study_names() if load_study(name).checks())
        raise ConfigurationError(
            f"experiment {values['name']}: check=true has nothing to say of a study of the kind "
            f"{values['study']}; expected one of {kinds}"
        )
    return checks


def _job(study: Study[Any], request: Request) -> Job[Any]:
    return Job(
        request.values,
        build(study.settings, request.values),
        request.folder,
        request.config_hash,
    )


def _publish(study: Study[Any], request: Request, record: Record) -> None:
    """Let the results take over a run of an experiment as it is configured."""
    values = request.values
    kept = record.converged or study.keeps_failures
    if not values["publish"] or values["sweep"] or not kept:
        return
    results = Path(values["paths"]["results"])
    if request.publish_as is None:
        print(f"{results} left as it is: this run has overrides")
        return
    publish(study, results, {request.publish_as: (record, request.folder)})
    print(f"Results in {results}")


def _raise_failure(record: Record, folder: Path) -> None:
    if not record.converged:
        detail = f" ({record.detail})" if record.detail else ""
        raise FailedRunError(record.reason + detail, folder)
