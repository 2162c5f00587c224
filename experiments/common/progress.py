"""Progress of a single run: steps of a filter, forward solves, elapsed time.

A terminal shows a bar. Elsewhere, and for events that matter, lines go to standard error, which in
a sweep is the job's log. There is a line at least every ten seconds.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from mvest.typing import FloatArray

if TYPE_CHECKING:
    from mvest.closure.model import ClosureModel

SILENCE_S = 10.0  # longest time without a sign of life
WIDTH = 100  # characters of a line of a terminal


def duration(seconds: float) -> str:
    """Seconds, minutes and hours as a clock shows them."""
    return str(tqdm.format_interval(max(0.0, seconds)))


def wrapped(text: str) -> str:
    """Text with its sentences broken at spaces to lines of at most `WIDTH`; not rows of tables."""
    fill = TextWrapper(
        WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    ).fill
    lines = text.splitlines()
    long = [len(line) > WIDTH and "  " not in line.strip() for line in lines]
    return "\n".join(fill(line) if one else line for line, one in zip(lines, long, strict=True))


def say(text: str) -> None:
    """Write a line to standard error, above a bar if there is one."""
    tqdm.write(wrapped(text), file=sys.stderr)
    sys.stderr.flush()


class Heartbeat:
    """A bar, and a line with the status whenever nothing was written for `SILENCE_S`."""

    def __init__(self, status: Callable[[], str], **bar: Any) -> None:
        self.bar = tqdm(leave=False, **bar)
        self._status, self._ended = status, threading.Event()
        self.last = self.began = time.monotonic()
        threading.Thread(target=self._beat, daemon=True).start()

    def say(self, text: str) -> None:
        """Write a line."""
        self.last = time.monotonic()
        say(text)

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self.began

    def end(self) -> None:
        """Stop, and remove the bar."""
        self._ended.set()
        self.bar.close()

    def _beat(self) -> None:
        while not self._ended.wait(1.0):
            if not self.bar.disable:
                self.bar.refresh()
            elif time.monotonic() - self.last >= SILENCE_S - 1.0:
                self.say(self._status())


class SolveBar:
    """Reports steps of a filter; a bar moves with the time steps of a forward solve.

    ``steps`` is the number of time steps of one solve; 0 for a model that reports none, which gets
    no bar. ``names`` are those of the parameters of :meth:`iterate`.
    """

    def __init__(self, title: str, steps: int, names: Sequence[str] = ()) -> None:
        self._title, self._steps, self._names = title, steps, list(names)
        self._made, self._reached = 0, math.inf  # steps of the present solve, and its time
        self._solve = 1  # number of the present solve
        bar = {"total": steps, "desc": title, "unit": "step", "disable": None if steps else True}
        self._lines = Heartbeat(self._status, **bar)

    def __enter__(self) -> SolveBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.end()

    def step(self, time_s: float, newton_iterations: int) -> None:
        """One more time step, reached at ``time_s``; the time falls when a new solve begins."""
        if time_s <= self._reached:
            self._end_solve()
            self._lines.bar.reset()
            self._lines.bar.set_description(
                f"{self._title}, forward solve {self._solve}", refresh=False
            )
        self._reached = time_s
        self._made += 1
        self._lines.bar.update(1)

    def iterate(self, number: int, m: FloatArray, objective: float) -> None:
        """One more iterate of a filter: its number, the parameters (p,) and the objective."""
        self._end_solve()
        names = self._names
        if len(names) != len(m):  # a first stage estimates the moduli alone
            names = [name for name in names if name.startswith("E_f.")]
        values = [f"{name} {value:.4g}" for name, value in zip(names, m, strict=False)]
        step = f"step {number}: objective {objective:.4g}"
        self._lines.say(", ".join([self._title, step, *values, self._elapsed()]))

    def _end_solve(self) -> None:
        if self._made:
            self._solve, self._made, self._reached = self._solve + 1, 0, math.inf

    def _status(self) -> str:
        """Progress within a solve."""
        of = f" of {self._steps}" if self._steps >= self._made else ""
        solve = f"forward solve {self._solve}: {self._made} time steps{of}"
        return ", ".join([self._title, solve, self._elapsed()])

    def _elapsed(self) -> str:
        return f"{duration(self._lines.elapsed)} elapsed"


@contextmanager
def solving(title: str, model: ClosureModel, names: Sequence[str] = ()) -> Iterator[SolveBar]:
    """A bar that a model of the closure moves; ``names`` as in `SolveBar`."""
    with SolveBar(title, len(model.settings.protocol.steps()), names) as bar:
        model.on_step = bar.step
        try:
            yield bar
        finally:
            model.on_step = None


class PartBar:
    """A bar over the equal pieces of one part of a study, and a line when the part is done.

    ``total`` is the number of pieces, 0 if it is known only after the first one. ``quiet`` writes
    no line at the end. The time left follows from the mean rate since the beginning.
    """

    def __init__(self, title: str, total: int, unit: str, *, quiet: bool = False) -> None:
        self._title, self._total, self._unit = title, total, unit
        self._quiet, self._done = quiet, 0
        bar = {"total": total, "desc": title, "unit": unit, "disable": None, "smoothing": 0.0}
        self._lines = Heartbeat(self._status, **bar)

    def __enter__(self) -> PartBar:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._lines.end()
        if kind is None and not self._quiet:
            say(f"{self._title}: done in {duration(self._lines.elapsed)}")

    def step(self, total: int | None = None) -> None:
        """One more piece is done, of ``total`` if given."""
        self._done += 1
        if total is not None:
            self._total = self._lines.bar.total = total
        self._lines.bar.update(1)

    def _status(self) -> str:
        elapsed, done, total = self._lines.elapsed, self._done, self._total
        left = [f"about {duration(elapsed * (total - done) / done)} left"] if done else []
        count = f"{self._title}: {done} of {total or '?'} {self._unit}s"
        return ", ".join([count, f"{duration(elapsed)} elapsed", *left])
