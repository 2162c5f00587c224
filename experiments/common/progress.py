"""Progress bars over forward solves and over sweeps, with the time that is left."""

from __future__ import annotations

import math
import sys
import threading
import time
from functools import cache
from types import TracebackType

from tqdm import tqdm

from experiments.runner.folder import last_record, result_time
from experiments.runner.plan import Plan, PlannedJob
from mvest.mechanics.solid import kernels_are_compiled

__all__ = ["PartBar", "SolveBar", "SweepBar", "announce_compilation"]

LOOK = 0.5
"""Seconds between two looks at the folders of a sweep."""

SAY = 30.0
"""Seconds between two lines about a sweep where no terminal shows its bar."""


@cache
def announce_compilation() -> None:
    """Say once that the first run after an installation takes longer, and why."""
    if not kernels_are_compiled():
        print("compiling on first use; this takes about a minute once", file=sys.stderr)


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


class SweepBar:
    """One bar for a sweep, with counts and the time left, and a line for each failure.

    It looks at the folders of the jobs, so it does not matter which launcher runs them, or on which
    machine. Where no terminal is there for a bar, a line is printed now and then.

    Parameters
    ----------
    plan : Plan
    """

    def __init__(self, plan: Plan) -> None:
        self._name = plan.name
        self._waiting = {job: result_time(job.folder) for job in plan.to_run}
        self._skipped = len(plan.jobs) - len(self._waiting)
        self._total = len(self._waiting)
        self._done = 0
        self._failed = 0
        self._began = self._said = time.monotonic()
        self._ended = threading.Event()
        self._watching = threading.Thread(target=self._watch, daemon=True)
        self._bar = tqdm(total=self._total, desc=plan.name, unit="job", disable=None)

    def __enter__(self) -> SweepBar:
        self._bar.set_postfix_str(self._counts())
        self._watching.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._watching.join()
        self.look()
        self._bar.close()

    def look(self) -> None:
        """See which jobs have ended since the last look."""
        for job, before in list(self._waiting.items()):
            if result_time(job.folder) in (None, before):
                continue
            record = last_record(job.folder, job.config_hash)
            if record is None:
                continue
            del self._waiting[job]
            if record["status"] == "converged":
                self._done += 1
            else:
                self._failed += 1
                self._tell(job, record["reason"])
            self._bar.set_postfix_str(self._counts(), refresh=False)
            self._bar.update(1)

    def _watch(self) -> None:
        pause = LOOK
        while not self._ended.wait(pause):
            looked = time.monotonic()
            self.look()
            self._bar.refresh()
            # Many folders on a slow disk are looked at less often.
            pause = max(LOOK, 10.0 * (time.monotonic() - looked))
            if self._bar.disable and looked - self._said > SAY:
                self._said = looked
                print(f"{self._name}: {self._counts()}, {self._left()}", file=sys.stderr)

    def _tell(self, job: PlannedJob, reason: str) -> None:
        tqdm.write(f"failed: {job.label}: {reason} ({job.folder})", file=sys.stderr)

    def _counts(self) -> str:
        return f"{self._done} done, {self._failed} failed, {self._skipped} skipped"

    def _left(self) -> str:
        """The time left, as a bar would show it."""
        ended = self._done + self._failed
        if not ended:
            return f"{self._total} to go"
        spent = time.monotonic() - self._began
        return f"{tqdm.format_interval(spent / ended * (self._total - ended))} left"
