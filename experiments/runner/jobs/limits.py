"""How long a job may take and how much memory, and how the memory is held.

Libraries reserve memory that they never touch (a job of 0.5 GB has 1.5 GB of it), so that a fixed
limit on what is reserved (``RLIMIT_DATA``) says little about what is used. It is therefore set
anew every tenth of a second, to what is reserved plus what is left to use: what is beyond the limit
cannot be allocated, and the job ends with a ``MemoryError`` as its own failure, whoever else is at
work in the process. Linux only; elsewhere nothing is held.
"""

from __future__ import annotations

import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MEMORY_LIMIT = "memory_limit_gb"
"""The setting, and what stands beside a request in what a process that runs jobs reads."""

TIME_LIMIT_S = 14_400.0
"""s, of a job of a sweep that is given no limit: fifty times the longest job of the sweeps in
``results/`` (269 s), so that what is stopped by it has run away."""

SHARE = 0.8
"""Of the machine's memory, for all jobs that run on it at a time."""

GB = 2**30
"""Bytes, as Slurm counts them."""
POLL_S = 0.1
MEMORY = Path("/proc/self/statm")
PEAK = Path("/proc/self/clear_refs")
CGROUPS = Path("/sys/fs/cgroup")


class HeldMemory:
    """What a job may use of memory and what it has used.

    Attributes
    ----------
    limit_gb : float
    """

    def __init__(self, limit_gb: float) -> None:
        self.limit_gb = limit_gb

    def __str__(self) -> str:
        return f"memory limit of {self.limit_gb:.3g} GB (used: up to {peak_gb():.3g} GB)"


def peak_gb() -> float:
    """The most that this process has had in memory since its job began."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GB


def default_memory_gb(jobs: int = 1) -> float:
    """Limit of each of so many jobs that run on this machine at a time: their part of ``SHARE``."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return SHARE * min([total, *_of_groups()]) / max(1, jobs) / GB


def _of_groups() -> Iterator[int]:
    """Limits in bytes of the control groups that this process is in, as containers have them."""
    try:
        groups = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for group in groups:
        own = CGROUPS / group.rpartition(":")[2].lstrip("/")
        for place in (own, *own.parents):
            try:
                text = (place / "memory.max").read_text(encoding="ascii").strip()
            except OSError:
                continue
            if text.isdecimal():
                yield int(text)


@contextmanager
def held_memory(limit_gb: float) -> Iterator[HeldMemory]:
    """Let this process have no more in memory; what is beyond raises ``MemoryError``.

    Programs that it starts meanwhile are held to the same, each by itself.
    """
    watch = HeldMemory(limit_gb)
    if not MEMORY.exists():
        yield watch
        return
    before, hard = resource.getrlimit(resource.RLIMIT_DATA)
    ended = threading.Event()

    def hold() -> None:
        while True:
            # At the limit not even this may find room; what was set before then stays.
            with suppress(MemoryError):
                resident, reserved = _resident_and_reserved()
                allowed = reserved + max(0, int(limit_gb * GB) - resident)
                if hard != resource.RLIM_INFINITY:
                    allowed = min(allowed, hard)
                resource.setrlimit(resource.RLIMIT_DATA, (allowed, hard))
            if ended.wait(POLL_S):
                return

    # Begins to count the peak anew; where that is not allowed it is that of all jobs so far.
    with suppress(OSError):
        PEAK.write_text("5", encoding="ascii")
    thread = threading.Thread(target=hold, daemon=True)
    thread.start()
    try:
        yield watch
    finally:
        ended.set()
        thread.join()
        resource.setrlimit(resource.RLIMIT_DATA, (before, hard))


def _resident_and_reserved() -> tuple[int, int]:
    """Bytes that this process has in memory, and bytes of its own that it has reserved."""
    pages = [int(number) for number in MEMORY.read_text(encoding="ascii").split()]
    size = os.sysconf("SC_PAGE_SIZE")
    return pages[1] * size, pages[5] * size
