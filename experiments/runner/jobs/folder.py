"""The folder of a job: whether it is done, who is at work in it, and why it has no estimate.

A job is done when its marker holds the digest of its record, and the record belongs to the
requested configuration. The marker is written last. A record and its arrays are replaced only when
their successors are on disk.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from filelock import AcquireReturnProxy, FileLock, Timeout

from experiments.common.config import without_places
from experiments.common.records.record import (
    ARRAYS,
    FIELDS,
    Record,
    read_record,
    stamp,
    write_record,
)
from experiments.common.study import Result
from experiments.runner.jobs.request import Request
from mvest.errors import InputError
from mvest.files import PREFIX, remove_parts, sha256_of, write_atomically
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping

DONE, RESULT, CONFIG, LOG, LOCK = "done", "result.json", "config.json", "log.txt", ".lock"
"""Files of a job: its marker, record, configuration, output, and lock."""

UNWRITTEN = f"the estimate is in {{}}/{RESULT}, and the same command writes what is missing"
"""What to say where the numbers of a job are on disk and something else could not be written."""

HYDRA = ".hydra"
"""Folder of the configuration as Hydra's users know it."""

NEW_FIELDS = f"{PREFIX}{FIELDS}"
"""Arrays that belong to the next record."""


class FailedRunError(Exception):
    """A run ended without an estimate; it is recorded, with its reason, in its output folder."""


def lock(folder: Path) -> AcquireReturnProxy[FileLock]:
    """Keep other processes out of the folder until the context is left or this process ends.

    Says so if it has to wait for another process.

    Raises
    ------
    InputError
        If the folder cannot be locked.
    """
    held = FileLock(folder / LOCK)
    try:
        try:
            return held.acquire(timeout=0)
        except Timeout:
            print(f"waiting for another process that works in {folder}", file=sys.stderr)
            return held.acquire()
    except OSError as error:
        raise InputError(f"cannot lock {folder / LOCK}: {error.strerror or error}") from error


def read_result(folder: Path, config_hash: str) -> Record | None:
    """The record in a folder if it is of this version and configuration, and as it was written."""
    try:
        record = read_record(folder / RESULT)
    except InputError:
        return None
    return record if record.provenance.config_hash == config_hash else None


def is_done(folder: Path) -> bool:
    """Whether everything that belongs to the present record is on disk."""
    try:
        return (folder / DONE).read_text(encoding="ascii") == sha256_of(folder / RESULT)
    except (OSError, ValueError):
        return False


def result_time(folder: Path) -> int | None:
    """When the record in a folder was written, in ns; None if there is none."""
    try:
        return (folder / RESULT).stat().st_mtime_ns
    except OSError:
        return None


def finished_record(folder: Path, config_hash: str) -> Record | None:
    """The record of a job that is done; None if it has to be run."""
    return read_result(folder, config_hash) if is_done(folder) else None


def usable_record(request: Request, asked_ns: int | None = None) -> Record | None:
    """The record that makes a run superfluous; None if the job has to be run.

    With ``force`` it must have been written after ``asked_ns``, when the job was requested.
    """
    written = result_time(request.folder) or 0
    if request.values["force"] and (asked_ns is None or written <= asked_ns):
        return None
    return finished_record(request.folder, request.config_hash)


def last_record(folder: Path, config_hash: str) -> Record | None:
    """The record of the last attempt; None if that was cut off before everything was on disk."""
    record = read_result(folder, config_hash)
    cut_off = record is not None and is_done(folder) != record.converged
    return None if cut_off else record


def computed_record(folder: Path, config_hash: str) -> Record | None:
    """A record of success that is not done: what follows from it could not all be written."""
    record = None if is_done(folder) else read_result(folder, config_hash)
    return record if record is not None and record.converged else None


def mark_done(folder: Path) -> None:
    """Say that everything that belongs to the present record is on disk."""
    write_atomically(folder / DONE, sha256_of(folder / RESULT))


def make_way(request: Request) -> None:
    """Remove what an unfinished attempt left, except a record whose outputs are missing.

    A finished record stays until its replacement is whole. A note says if it was changed since it
    was written.
    """
    folder = request.folder
    _adopt_arrays(folder)
    remove_parts(folder)
    if is_done(folder):
        return
    if (folder / DONE).exists() and (folder / RESULT).exists():
        try:
            read_record(folder / RESULT)
        except InputError as error:
            print(f"note: {error}; it is computed again", file=sys.stderr)
    if request.values["force"] or computed_record(folder, request.config_hash) is None:
        for name in (DONE, RESULT):
            (folder / name).unlink(missing_ok=True)


def replace_record(folder: Path, record: Record, arrays: Mapping[str, Any] | None = None) -> None:
    """Replace the record of a job, and its arrays.

    Raises
    ------
    InputError
        If they cannot be written; the former ones are then still there.
    """
    new = folder / NEW_FIELDS
    new.unlink(missing_ok=True)
    if arrays:
        write_atomically(new, partial(np.savez_compressed, **arrays))
    write_record(folder / RESULT, record, new)
    _adopt_arrays(folder)
    (folder / DONE).unlink(missing_ok=True)


def _adopt_arrays(folder: Path) -> None:
    """Give the arrays that the record was written with their name, also after a kill."""
    try:
        digest = read_mapping(folder / RESULT)[ARRAYS]
    except (InputError, KeyError):
        return
    new = folder / NEW_FIELDS
    if digest is None:
        (folder / FIELDS).unlink(missing_ok=True)
    elif new.is_file() and sha256_of(new) == digest:
        new.replace(folder / FIELDS)


def write_hydra(request: Request) -> None:
    """Write the resolved configuration and the overrides where Hydra's users expect them.

    Raises
    ------
    InputError
        If they cannot be written.
    """
    place = request.folder / HYDRA
    place.mkdir(exist_ok=True)
    for name, data in (("config", request.values), ("overrides", list(request.overrides))):
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
        write_atomically(place / f"{name}.yaml", text)


def require_writable(folder: Path) -> None:
    """Refuse a folder that cannot be written, before anything is computed.

    Raises
    ------
    InputError
        If it cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from error


@contextmanager
def nothing_empty(folder: Path, outputs: Path) -> Iterator[None]:
    """Remove a job's folder, and those of the outputs above it, if nothing was written there.

    Hydra makes the folder before anyone has checked the request.
    """
    try:
        yield
    finally:
        outputs = outputs.resolve()
        above = [place for place in folder.resolve().parents if outputs in (place, *place.parents)]
        with suppress(OSError):  # something else is there
            if {path.name for path in folder.iterdir()} <= {LOCK, HYDRA}:
                # Whoever holds the lock is at work there.
                with FileLock(folder / LOCK).acquire(timeout=0):
                    shutil.rmtree(folder / HYDRA, ignore_errors=True)
                    (folder / LOCK).unlink()
                for place in (folder, *above):
                    place.rmdir()


def write_failure(request: Request, reason: str, started: float) -> Record:
    """Record why a job that ``started`` (s since the epoch) ended, and return that record.

    If it had already computed its estimate, that record stays, and a warning says so.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    computed = computed_record(request.folder, request.config_hash)
    if computed is not None:
        print(f"warning: {reason}; {UNWRITTEN.format(request.folder)}", file=sys.stderr)
        return computed
    failure = Result(status="failed", reason=reason)
    record = stamp(request.values, request.config_hash, failure, started)
    replace_record(request.folder, record)
    write_json(request.folder / CONFIG, without_places(request.values))
    return record
