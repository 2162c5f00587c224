"""How long a job may take, and how much memory it may use (Linux only)."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

TIME_LIMIT_S = 14_400.0
"""s, default for jobs of sweeps: 50 times the longest of those in ``results/`` (269 s)."""

SHARE, GB = 0.8, 2**30
"""Of the machine's memory, for all jobs at a time; and bytes, as Slurm counts them."""

PROCESS, CGROUPS = Path("/proc/self"), Path("/sys/fs/cgroup")


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

    What it has left of its limit at the start may be allocated (``RLIMIT_DATA``). Beyond that it
    raises a `MemoryError` that states the limit and the peak.
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
        # The peak is counted anew; where that is not allowed it is that of all jobs so far.
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
