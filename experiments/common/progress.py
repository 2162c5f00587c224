"""Progress of a single run: forward solves, steps of a filter, time left.

On a terminal a bar moves as well. Lines go to standard error, which in a sweep is the job's log.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from functools import cache

from tqdm import tqdm

from mvest.mechanics.solid import kernels_are_compiled
from mvest.typing import FloatArray

SAY = 30.0
"""Seconds between two lines about the pieces of a part where no terminal shows its bar."""

TYPICAL_SOLVES = 6
"""Forward solves that a filter usually needs; only the first guess of what is left."""

QUICK = 1.0
"""A forward solve that ends sooner than this (s) after the last line gets no line."""


@cache
def announce_compilation(following: str = "the computation") -> None:
    """Say once that the first run after an installation takes longer, why, and what follows."""
    if not kernels_are_compiled():
        say(f"compiling on first use; this takes about a minute once, then {following} goes on")


def duration(seconds: float) -> str:
    """Seconds, minutes and hours as a clock shows them."""
    return str(tqdm.format_interval(max(0.0, seconds)))


class SolveBar:
    """Reports forward solves and steps of a filter; a bar moves with the time steps of a solve.

    How many solves a filter will need is not known beforehand: a typical number is expected, and
    after that one more at a time.

    Parameters
    ----------
    title : str
    steps : int
        Time steps of one solve; 0 where a model reports none, and no bar is drawn.
    solves : int
        Expected number of solves.
    names : sequence of str, optional
        Of the parameters, in the order in which :meth:`iterate` is given them.
    """

    def __init__(self, title: str, steps: int, solves: int, names: Sequence[str] = ()) -> None:
        self._title, self._names, self._expected = title, tuple(names), solves
        self._solve, self._solving, self._last = 0, 0.0, math.inf
        self._before: tuple[FloatArray, float] | None = None
        self._began = self._solve_began = self._now = self._said = time.monotonic()
        hidden = None if steps else True
        self._bar = tqdm(total=steps, desc=title, unit="step", disable=hidden, leave=False)
        self._steps_made = 0

    def __enter__(self) -> SolveBar:
        announce_compilation(f"the {self._title}")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._end_solve()
        self._bar.close()

    def step(self, time_s: float, newton_iterations: int) -> None:
        """One more time step, reached at ``time_s``; the time falls when a new solve begins."""
        if time_s <= self._last:
            self._end_solve()
            self._solve += 1
            self._bar.reset()
            self._bar.set_description(f"{self._title}, forward solve {self._solve}", refresh=False)
        self._last, self._now = time_s, time.monotonic()
        self._steps_made += 1
        self._bar.update(1)

    def iterate(self, number: int, m: FloatArray, objective: float) -> None:
        """One more iterate of a filter: its number, the parameters (p,) and the objective."""
        self._end_solve()
        self._solve_began = self._said = time.monotonic()
        before = self._before if number else None
        self._before = m, objective
        change = "" if before is None else f" ({objective - before[1]:+.2g})"
        values, names = [], list(self._names)
        if len(names) != len(m):
            # A part of an estimation is of the moduli alone.
            names = [name for name in names if name.startswith("E_f.")]
        for k, (name, value) in enumerate(zip(names, m, strict=False)):
            moved = "" if before is None else f" ({value - before[0][k]:+.2g})"
            values.append(f"{name} {value:.4g}{moved}")
        say(
            f"{self._title}, step {number} of the filter: objective {objective:.4g}{change}; "
            f"{', '.join(values)}; {self._left()}"
        )

    def _end_solve(self) -> None:
        """Report the forward solve that has ended, if there is one that was not reported."""
        if not self._steps_made:
            return
        spent = self._now - self._solve_began
        self._solving += spent
        if self._now - self._said >= QUICK:
            self._said = self._now
            say(
                f"{self._title}, forward solve {self._solve}: {self._steps_made} time steps in "
                f"{spent:.1f} s; {self._left()}"
            )
        self._solve_began, self._steps_made, self._last = self._now, 0, math.inf

    def _left(self) -> str:
        """What has passed, and what is still to be expected."""
        text = f"{duration(time.monotonic() - self._began)} elapsed"
        more = self._expected - self._solve
        if not self._solve or (more <= 0 and self._expected <= 1):
            return text
        each = self._solving / self._solve
        if more > 0:
            return f"{text}, about {duration(each * more)} left if {self._expected} solves do"
        return f"{text}, about {duration(each)} for each further solve"


class PartBar:
    """A bar over the equal pieces of one part of a study, and a line when the part is done.

    Where no terminal shows the bar, a line is printed now and then.

    Parameters
    ----------
    title : str
    total : int
        Pieces; 0 where only the first one that is done says how many there are.
    unit : str
    workers : int
        Pieces that are worked on at a time.
    """

    def __init__(self, title: str, total: int, unit: str, workers: int = 1) -> None:
        self._title, self._total, self._unit, self._workers = title, total, unit, workers
        self._done, self._spent = 0, 0.0
        self._began = self._said = self._last = time.monotonic()
        # tqdm knows no workers: the first piece of eight would be an eighth of the pace.
        form = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
        self._bar = tqdm(total=total, desc=title, disable=None, leave=False, bar_format=form)

    def __enter__(self) -> PartBar:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._bar.close()
        if kind is None:
            say(f"{self._title}: done in {duration(time.monotonic() - self._began)}")

    def step(self, total: int | None = None, seconds: float | None = None) -> None:
        """One more piece is done, of ``total`` if that is given; it took ``seconds``, if given."""
        now = time.monotonic()
        self._spent += now - self._last if seconds is None else seconds
        self._last = now
        self._done += 1
        if total is not None:
            self._total = self._bar.total = total
        left = f"about {duration(self.left())} left"
        self._bar.set_postfix_str(left, refresh=False)
        self._bar.update(1)
        if self._bar.disable and now - self._said > SAY:
            self._said = now
            elapsed = duration(now - self._began)
            say(
                f"{self._title}: {self._done} of {self._total} {self._unit}s, {elapsed} elapsed, "
                f"{left}"
            )

    def left(self) -> float:
        """Seconds until the last piece is done.

        The others take as long as those that are done, one by one at each worker. The pieces that
        are under way are partly done, and at the end workers wait for the last one: half a piece
        each.
        """
        left = self._total - self._done
        return left / max(1, min(self._workers, left)) * self._spent / self._done


def say(text: str) -> None:
    """Write a line to standard error, above a bar if there is one."""
    tqdm.write(text, file=sys.stderr)
    sys.stderr.flush()
