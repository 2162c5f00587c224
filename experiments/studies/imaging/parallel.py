"""One function for many arguments, in processes or here, with the CPU time of each call."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import joblib

__all__ = ["in_processes"]

T = TypeVar("T")


def in_processes(
    function: Callable[..., T], calls: Iterable[tuple[Any, ...]], processes: int
) -> Iterator[tuple[T, float]]:
    """What each call returns, in order, and the CPU seconds that it took.

    Parameters
    ----------
    function : callable
        Of a module, so that another process can import it.
    calls : iterable of tuple
        Arguments of each call; taken as they are needed.
    processes : int
        1 computes here, without further processes.
    """
    if processes == 1:
        for arguments in calls:
            yield _timed(function, arguments)
        return
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=processes, return_as="generator")
        yield from parallel(joblib.delayed(_timed)(function, arguments) for arguments in calls)


def _timed(function: Callable[..., T], arguments: tuple[Any, ...]) -> tuple[T, float]:
    began = time.process_time()
    made = function(*arguments)
    return made, time.process_time() - began
