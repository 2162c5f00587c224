"""Progress bars over forward solves and over sweeps, with the time that is left."""

from __future__ import annotations

import math
import sys
import time
from functools import cache
from types import TracebackType

from tqdm import tqdm

from mvest.mechanics.solid import kernels_are_compiled

__all__ = ["PartBar", "SolveBar", "announce_compilation"]


@cache
def announce_compilation(following: str = "the computation") -> None:
    """Say once that the first run after an installation takes longer, why, and what follows."""
    if not kernels_are_compiled():
        print(
            f"compiling on first use; this takes about a minute once, then {following} goes on",
            file=sys.stderr,
        )


class SolveBar:
    """A bar that moves with the time steps of forward solves.

    How many solves a filter will need is not known beforehand: the bar starts from a typical number
    and grows with each solve beyond it. Nothing is drawn where no one is looking at a terminal.

    Parameters
    ----------
    title : str
    steps : int
        Time steps of one solve.
    solves : int
        Expected number of solves.
    """

    def __init__(self, title: str, steps: int, solves: int) -> None:
        self._title = title
        self._steps = steps
        self._last = math.inf
        self._solve = 0
        self._bar = tqdm(total=steps * solves, desc=title, unit="step", disable=None, leave=False)

    def __enter__(self) -> SolveBar:
        announce_compilation()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.close()

    def step(self, time: float, newton_iterations: int) -> None:
        """One more time step, reached at ``time`` s; the time falls when a new solve begins."""
        if time <= self._last:
            self._solve += 1
            # A solve that stopped early has skipped the steps it did not make.
            self._bar.update((self._solve - 1) * self._steps - self._bar.n)
        self._last = time
        if self._bar.total is not None and self._bar.n >= self._bar.total:
            self._bar.total += self._steps
        self._bar.set_description(f"{self._title}, forward solve {self._solve}", refresh=False)
        self._bar.update(1)


class PartBar:
    """A bar over the equal pieces of one part of a study, and a line when the part is done.

    Parameters
    ----------
    title : str
    total : int
        Pieces.
    unit : str
    """

    def __init__(self, title: str, total: int, unit: str) -> None:
        self._title = title
        self._began = time.monotonic()
        self._bar = tqdm(total=total, desc=title, unit=unit, disable=None, leave=False)

    def __enter__(self) -> PartBar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.close()
        if kind is None:
            spent = tqdm.format_interval(time.monotonic() - self._began)
            print(f"{self._title}: done in {spent}", file=sys.stderr, flush=True)

    def step(self) -> None:
        """One more piece is done."""
        self._bar.update(1)
