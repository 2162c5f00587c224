"""One run of one configuration: build, simulate, estimate, write down, log."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.common.config import hash_of, without_places
from experiments.common.records.record import Record, record_from, stamp, write_record
from experiments.common.schema import build
from experiments.common.study import Check, Job, Study, load_study, study_names
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
from mvest.provenance import write_json
from mvest.reading.text import one_line

__all__ = ["FailedRunError", "compute", "run_job"]


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
        data = run_apart(request, aloud=True)
        _raise_failure(data["status"], data["reason"], data["detail"], folder)
        _say(study, record_from(data, study.findings, str(folder / RESULT)))
        print(f"Written to {folder}")
        return
    with lock(folder):
        done = None if values["force"] else finished_record(folder, request.config_hash)
        if done is None:
            make_way(request)
            _compute_here(request)
            return
    record = record_from(done, study.findings, str(folder / RESULT))
    _say(study, record)
    source = record.provenance
    print(
        f"Done on {source.finished} by commit {(source.git.sha or 'unknown')[:12]}, in "
        f"{folder}; force=true runs it again"
    )
    _publish(study, request, record)
    study.finish(_job(study, request), record)


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
        data = write_failure(request, reason, started)
        _raise_failure(data["status"], reason, "", request.folder)


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
    record = _computed(study, request)
    if record is None:
        outcome = study.run(job)
        if hash_of(values) != request.config_hash:
            # Nobody can say of which content it is the result.
            reason = "a file or folder that the settings name was changed before the job ended"
            outcome = replace(outcome, status="failed", reason=reason)
        record = stamp(values, request.config_hash, outcome, started)
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
    _raise_failure(record.status, record.reason, record.detail, folder)


def _computed(study: Study[Any, Any], request: Request) -> Record[Any] | None:
    """What an earlier attempt computed, of which not everything could be written."""
    folder = request.folder
    data = computed_record(folder, request.config_hash)
    if data is None:
        return None
    try:
        return record_from(data, study.findings, str(folder / RESULT))
    except InputError:
        return None


def _say(study: Study[Any, Any], record: Record[Any]) -> None:
    """What a finished run says on the terminal."""
    if record.caution:
        print(record.caution)
    print(study.words(record))


def _write_out(study: Study[Any, Any], request: Request, record: Record[Any]) -> None:
    """All that follows from a record on disk, and the marker that says so."""
    folder = request.folder
    if request.values["figures"]:
        if study.write_run is not None:
            study.write_run(folder, record)
        else:
            study.write(folder, {record.table: record}, arrays_of(folder, record.table))
    _say(study, record)
    print(f"Written to {folder}")
    _publish(study, request, record)
    if record.converged:
        mark_done(folder)


def require_checks(study: Study[Any, Any], values: Mapping[str, Any]) -> tuple[Check, ...]:
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


def _job(study: Study[Any, Any], request: Request) -> Job[Any]:
    return Job(
        request.values,
        build(study.settings, request.values),
        request.folder,
        request.config_hash,
    )


def _publish(study: Study[Any, Any], request: Request, record: Record[Any]) -> None:
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


def _raise_failure(status: str, reason: str, detail: str, folder: Path) -> None:
    if status != "converged":
        raise FailedRunError(reason + (f" ({detail})" if detail else ""), folder)
