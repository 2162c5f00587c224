"""One function for many arguments, in processes or here, with the CPU time of each call."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from mvest.processes import side_by_side

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
    return side_by_side(_timed, ((function, arguments) for arguments in calls), processes)


def _timed(function: Callable[..., T], arguments: tuple[Any, ...]) -> tuple[T, float]:
    began = time.process_time()
    made = function(*arguments)
    return made, time.process_time() - began
