"""The folder of a job: whether it is done, who is at work in it, and why it has no estimate.

A job is done when its marker is there and its result belongs to the asked configuration. The marker
is made last, after everything else is on disk.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock

from experiments.common.config import without_places
from experiments.common.records.record import Record, read_record, stamp, write_record
from experiments.common.study import Result
from experiments.runner.jobs.request import Request
from mvest.errors import InputError
from mvest.files import remove_parts
from mvest.provenance import write_json

DONE, RESULT, CONFIG, LOG, LOCK = "done", "result.json", "config.json", "log.txt", ".lock"
"""Files of a job: its marker, its record, its configuration, what it said, who is at work."""


class FailedRunError(Exception):
    """A run ended without an estimate; it is recorded, with its reason, in its output folder."""

    def __init__(self, reason: str, folder: Path) -> None:
        super().__init__(reason, folder)
        self.reason = reason
        self.folder = folder

    def __str__(self) -> str:
        return f"{self.reason} (recorded in {self.folder / RESULT})"


def lock(folder: Path) -> FileLock:
    """Keeps a second process out of the folder; falls with the process that holds it."""
    return FileLock(folder / LOCK)


def read_result(folder: Path, config_hash: str) -> Record | None:
    """The record in a folder if it is of this version and configuration, and as it was written."""
    try:
        record = read_record(folder / RESULT)
    except InputError:
        return None
    return record if record.provenance.config_hash == config_hash else None


def is_done(folder: Path) -> bool:
    """Whether the job's marker is there."""
    return (folder / DONE).exists()


def result_time(folder: Path) -> int | None:
    """When the record in a folder was written, in ns; None if there is none."""
    try:
        return (folder / RESULT).stat().st_mtime_ns
    except OSError:
        return None


def finished_record(folder: Path, config_hash: str) -> Record | None:
    """The record of a job that is done; None if it has to be run."""
    return read_result(folder, config_hash) if is_done(folder) else None


def last_record(folder: Path, config_hash: str) -> Record | None:
    """What the last attempt ended with; None if it did not get to its end.

    A record of success without the marker comes from a process that died before everything else was
    on disk.
    """
    record = read_result(folder, config_hash)
    if record is None or is_done(folder) == record.converged:
        return record
    return None


def computed_record(folder: Path, config_hash: str) -> Record | None:
    """A record of success without the marker: computed, but not all of it could be written."""
    record = None if is_done(folder) else read_result(folder, config_hash)
    return record if record is not None and record.converged else None


def mark_done(folder: Path) -> None:
    """Say that everything of the job is on disk."""
    (folder / DONE).touch()


def clear(folder: Path) -> None:
    """Take away what an earlier attempt left, its marker first; say so if it was changed since."""
    if is_done(folder) and (folder / RESULT).exists():
        try:
            read_record(folder / RESULT)
        except InputError as error:
            print(f"note: {error}; it is computed again", file=sys.stderr)
    for name in (DONE, RESULT):
        (folder / name).unlink(missing_ok=True)
    remove_parts(folder)


def make_way(request: Request) -> None:
    """Take away what an earlier attempt left, but for what it computed, unless that is forced."""
    if request.values["force"] or computed_record(request.folder, request.config_hash) is None:
        clear(request.folder)
    remove_parts(request.folder)


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
    """Take a job's folder away again, and those of the outputs above it, if nothing was kept in it.

    Hydra makes the folder before anyone has seen whether the request is right.
    """
    try:
        yield
    finally:
        outputs = outputs.resolve()
        above = [place for place in folder.resolve().parents if outputs in (place, *place.parents)]
        try:
            if {path.name for path in folder.iterdir()} <= {LOCK}:
                # Whoever holds the lock is at work there.
                with lock(folder).acquire(timeout=0):
                    (folder / LOCK).unlink()
                for place in (folder, *above):
                    place.rmdir()
        except OSError:
            # Something else is kept there.
            pass


def unwritten(folder: Path) -> str:
    """What to say where the numbers of a job are on disk and something else could not be."""
    return f"the estimate is in {folder / RESULT}, and the same command writes what is missing"


def write_failure(request: Request, reason: str, started: float) -> Record:
    """Record that a job ended without anyone left to record it, and why.

    What it had computed before it ended is not lost: that record stays, and the reason is said.

    Parameters
    ----------
    request : Request
    reason : str
    started : float
        Seconds since the epoch.

    Returns
    -------
    Record
        The record that is there now.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    computed = computed_record(request.folder, request.config_hash)
    if computed is not None:
        print(f"warning: {reason}; {unwritten(request.folder)}", file=sys.stderr)
        return computed
    record = stamp(
        request.values,
        request.config_hash,
        Result(status="failed", reason=reason),
        started,
    )
    write_json(request.folder / CONFIG, without_places(request.values))
    write_record(request.folder / RESULT, record)
    return record
