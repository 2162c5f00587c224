"""One progress bar for a sweep, whichever launcher runs its jobs, and the time that is left."""

from __future__ import annotations

import sys
import threading
import time

from tqdm import tqdm

from experiments.common.progress import duration
from experiments.runner.jobs.folder import last_record, result_time
from experiments.runner.planning.plan import Plan, PlannedJob

LOOK = 0.5
"""Seconds between two looks at the folders of a sweep."""

SAY = 30.0
"""Seconds between two lines about a sweep where no terminal shows its bar."""


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
        self._workers = plan.workers
        self._began = self._last = time.monotonic()
        self._said: float | None = None
        self._ended = threading.Event()
        self._watching = threading.Thread(target=self._watch, daemon=True)
        self._bar = tqdm(
            total=self._total,
            desc=plan.name,
            disable=None,
            # A bar knows no workers: the first job of eight would be an eighth of the pace.
            bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]",
        )

    def __enter__(self) -> SweepBar:
        self._bar.set_postfix_str(self.said())
        self._watching.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
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
            if record.converged:
                self._done += 1
            else:
                self._failed += 1
                self._tell(job, record.reason)
            self._last = time.monotonic()
            self._bar.set_postfix_str(self.said(), refresh=False)
            self._bar.update(1)

    def _watch(self) -> None:
        pause = LOOK
        while not self._ended.wait(pause):
            looked = time.monotonic()
            self.look()
            self._bar.set_postfix_str(self.said())
            # Many folders, or a slow disk, are looked at less often.
            pause = max(LOOK, 50.0 * (time.monotonic() - looked))
            going_on = 0 < self._done + self._failed < self._total
            if self._bar.disable and going_on and looked - (self._said or -SAY) > SAY:
                self._said = looked
                print(f"{self._name}: {self.said()}", file=sys.stderr)

    def said(self) -> str:
        """How many jobs have ended, and from the first one on how long the others will take."""
        counts = f"{self._done} done, {self._failed} failed, {self._skipped} skipped"
        ended = self._done + self._failed
        if not ended:
            return f"{counts}, {self._total} to go"
        # Those under way are half done, the worker aside that has just ended one.
        under_way = 0.5 * (min(self._workers, self._total - ended + 1) - 1)
        each = (self._last - self._began) / (ended + under_way)
        left = each * (self._total - ended - under_way) - (time.monotonic() - self._last)
        return f"{counts}, about {duration(left)} left"

    def _tell(self, job: PlannedJob, reason: str) -> None:
        tqdm.write(f"failed: {job.label}: {reason} ({job.folder})", file=sys.stderr)
