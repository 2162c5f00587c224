"""One job of the runner: its request, its folder, and its limits of memory (Linux).

A request is plain data, so that another process can get it. A job is done when the marker in its
folder holds the digest of its record, and the record belongs to the requested configuration. The
marker is written last. A record and its arrays are replaced only when the new ones are on disk.
"""

import os
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml
from filelock import AcquireReturnProxy, FileLock, Timeout

from experiments.common.config import require_in_range, without_places
from experiments.common.records.record import Record, adopt_arrays, read_record, stamp, write_record
from experiments.common.study import Result, is_present
from mvest.errors import InputError, message_of
from mvest.files import remove_parts, require_writable, sha256_of, write_atomically
from mvest.provenance import write_json

DONE, RESULT, CONFIG, LOG, LOCK = "done", "result.json", "config.json", "log.txt", ".lock"
# Files of a job: marker, record, configuration, output, lock, and folder of Hydra's settings.
HYDRA = ".hydra"
# Message for a job whose record is on disk while another file could not be written.
UNWRITTEN = f"the estimate is in {{}}/{RESULT}, and the same command writes what is missing"
HASH_DIGITS = 16  # digits of its hash by which a job is named
# s, default for jobs of sweeps: 50 times the longest of those in ``results/`` (269 s).
TIME_LIMIT_S = 14_400.0
# Share of the machine's memory that all jobs get; and bytes, as Slurm counts them.
SHARE, GB = 0.8, 2**30

PROCESS, CGROUPS = Path("/proc/self"), Path("/sys/fs/cgroup")


@dataclass(frozen=True, slots=True)
class Request:
    """One configuration in its ranges (or a `ConfigurationError`), and its output folder."""

    values: dict[str, Any]
    config_hash: str  # SHA-256 of everything in the configuration that can change the result
    folder: Path
    publish_as: str | None = None  # name of its record in the results; None: do not publish it
    overrides: tuple[str, ...] = ()  # the request in Hydra's syntax

    def __post_init__(self) -> None:
        require_in_range(self.values)

    def to_json(self) -> dict[str, Any]:
        """Plain data, from which `experiments.common.schema.build` makes the request again."""
        data = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**data, "folder": str(self.folder)}

    @property
    def short_hash(self) -> str:
        """First digits of the hash of the configuration, by which files name the job."""
        return self.config_hash[:HASH_DIGITS]

    @property
    def label(self) -> str:
        """What distinguishes the job, in a line of text."""
        factors = (f"{name}={value}" for name, value in self.values["factors"].items())
        return ", ".join(factors) or " ".join(self.overrides)


class FailedRunError(Exception):
    """A run ended without an estimate; its record, with the reason, is in its output folder."""


def is_done(folder: Path) -> bool:
    """Whether the record and all files that follow from it are on disk."""
    try:
        return (folder / DONE).read_text(encoding="ascii") == sha256_of(folder / RESULT)
    except (OSError, ValueError):
        return False


def mark_done(folder: Path) -> None:
    """Write the marker: the record and all files that follow from it are on disk."""
    write_atomically(folder / DONE, sha256_of(folder / RESULT))


def last_record(folder: Path, config_hash: str, *, cut_off: bool = False) -> Record | None:
    """The record of the last attempt; None if there is none of this configuration and version.

    The numbers of a version are those of `mvest.provenance.NUMBERS`.

    It is a failure, or a success that is done; with ``cut_off`` it is a success that is not done,
    because a file that follows from it could not be written.
    """
    try:
        record = read_record(folder / RESULT)
    except InputError:
        return None
    matches = record.provenance.config_hash == config_hash and is_present(record)
    return record if matches and cut_off == (record.converged > is_done(folder)) else None


def usable_record(request: Request, requested_ns: int | None = None) -> Record | None:
    """The record that makes a run superfluous; None if the job has to be run.

    With ``force`` it must have been written after ``requested_ns``, when the job was requested.
    """
    record = last_record(request.folder, request.config_hash)
    if record is None or not record.converged:
        return None
    if request.values["force"]:
        written_ns = (request.folder / RESULT).stat().st_mtime_ns
        return record if requested_ns is not None and written_ns > requested_ns else None
    return record


def attempt(
    request: Request, run: Callable[[], str | None], requested_ns: int | None = None
) -> Record:
    """Run a job unless it is done; returns its record, of a success or a failure.

    ``run`` returns why it wrote no record of the job, or None; for ``requested_ns`` see
    `usable_record`. Raises an `MvestError` if nothing can be recorded, or ``run`` raises one.
    """
    folder = request.folder
    require_writable(folder)
    with lock(folder):
        record = usable_record(request, requested_ns)
        if record is None:
            started = time.time()
            make_way(request)
            try:
                reason = run()
            except MemoryError as error:
                reason = message_of(error)
            record = None if reason else last_record(folder, request.config_hash)
            record = record or write_failure(request, reason or "it left no record", started)
        return record


def lock(folder: Path) -> AcquireReturnProxy[FileLock]:
    """Lock a folder, or raise an `InputError`; prints a note if it has to wait."""
    held = FileLock(folder / LOCK)
    try:
        try:
            return held.acquire(timeout=0)
        except Timeout:
            print(f"waiting for another process that works in {folder}", file=sys.stderr)
            return held.acquire()
    except OSError as error:
        raise InputError(f"cannot lock {folder / LOCK}: {error.strerror or error}") from error


def make_way(request: Request) -> None:
    """Remove what an unfinished attempt left, except a record whose outputs are missing."""
    folder = request.folder
    adopt_arrays(folder / RESULT)
    remove_parts(folder)
    if is_done(folder):
        return
    if request.values["force"] or not last_record(folder, request.config_hash, cut_off=True):
        for name in (DONE, RESULT):
            (folder / name).unlink(missing_ok=True)


def replace_record(request: Request, result: Result, started: float) -> Record:
    """Replace the record of a job, its arrays and its configuration; returns the new record.

    The job ``started`` so many seconds after the epoch.

    Raises an `InputError` if they cannot be written; the former record and arrays are then still
    there.
    """
    folder = request.folder
    record = stamp(request.values, request.config_hash, result, started)
    write_json(folder / CONFIG, without_places(request.values))
    write_record(folder / RESULT, record, result.arrays)
    (folder / DONE).unlink(missing_ok=True)
    return record


def write_failure(request: Request, reason: str, started: float) -> Record:
    """Record why a job has no estimate; an estimate that was computed stays, with a warning."""
    computed = last_record(request.folder, request.config_hash, cut_off=True)
    if computed is not None:
        remedy = UNWRITTEN.format(request.folder)
        print(f"warning: {reason if remedy in reason else f'{reason}; {remedy}'}", file=sys.stderr)
        return computed
    return replace_record(request, Result(status="failed", reason=reason), started)


def failed_record(request: Request, reason: str) -> Record:
    """The record of a job without an estimate; it is not written."""
    result = Result(status="failed", reason=reason)
    return stamp(request.values, request.config_hash, result, time.time())


def write_hydra(request: Request) -> None:
    """Write configuration and overrides where users of Hydra expect them."""
    place = request.folder / HYDRA
    place.mkdir(exist_ok=True)
    for name, data in (("config", request.values), ("overrides", list(request.overrides))):
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
        write_atomically(place / f"{name}.yaml", text)


@contextmanager
def nothing_empty(folder: Path, outputs: Path) -> Iterator[None]:
    """Remove a job's folder, which Hydra made, and its parents, if nothing was written there."""
    try:
        yield
    finally:
        above = [p for p in folder.resolve().parents if p.is_relative_to(outputs.resolve())]
        with suppress(OSError):  # not empty, or another process works there and holds the lock
            if {path.name for path in folder.iterdir()} <= {LOCK, HYDRA}:
                with FileLock(folder / LOCK).acquire(timeout=0):
                    shutil.rmtree(folder / HYDRA, ignore_errors=True)
                    (folder / LOCK).unlink()
                for place in (folder, *above):
                    place.rmdir()


def default_memory_gb(jobs: int = 1) -> float:
    """Memory limit (GB) of each of ``jobs`` that run on this machine or in this container."""
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with suppress(OSError):
        for group in (PROCESS / "cgroup").read_text(encoding="utf-8").splitlines():
            own = CGROUPS / group.rpartition(":")[2].lstrip("/")
            for place in (own, *own.parents):
                with suppress(OSError, ValueError):  # no limit there, or "max"
                    limits.append(int((place / "memory.max").read_text(encoding="ascii")))
    return SHARE * min(limits) / max(1, jobs) / GB


@contextmanager
def held_memory(limit_gb: float) -> Iterator[None]:
    """Limit the memory of this process, and of each program that it starts meanwhile.

    The process may allocate what it has left of the limit (``RLIMIT_DATA``). Beyond that it raises
    a `MemoryError` that states the limit and the peak.
    """
    before, hard = resource.getrlimit(resource.RLIMIT_DATA)
    # Arrow's own allocator would reserve 1 GB for its first string.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    with suppress(OSError):
        pages = (PROCESS / "statm").read_text(encoding="ascii").split()
        resident, reserved = (int(pages[k]) * resource.getpagesize() for k in (1, 5))
        allowed = reserved + max(0, int(limit_gb * GB) - resident)
        soft = allowed if hard == resource.RLIM_INFINITY else min(allowed, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
        # Resets the peak; if that is not permitted, it is the peak of all jobs so far.
        (PROCESS / "clear_refs").write_text("5", encoding="ascii")
    try:
        yield
    except MemoryError as error:
        resource.setrlimit(resource.RLIMIT_DATA, (before, hard))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GB
        text = f"memory limit of {limit_gb:.3g} GB (used: up to {peak:.3g} GB)"
        raise MemoryError(": ".join(filter(None, [text, str(error).strip()]))) from error
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (before, hard))
