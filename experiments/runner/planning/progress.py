"""One progress bar for a sweep, and the time that is left."""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager
from statistics import fmean

from tqdm import tqdm

from experiments.common.progress import duration
from experiments.common.records.record import Record
from experiments.runner.planning.plan import PlannedJob

SAY = 30.0
"""Seconds between two lines about a sweep where no terminal shows its bar."""


class SweepBar(AbstractContextManager["SweepBar"]):
    """A bar with counts and the time left, and a line for each failure.

    Where no terminal is there for a bar, a line is printed now and then.

    Parameters
    ----------
    name : str
        Of the sweep.
    skipped, total : int
        Jobs that were done before, and jobs that will run.
    workers : int
        Jobs that run at a time.
    """

    def __init__(self, name: str, skipped: int, total: int, workers: int) -> None:
        self._name, self._skipped, self._total, self._workers = name, skipped, total, workers
        self._done = self._failed = 0
        self._seconds: list[float] = []
        self._said = time.monotonic() - SAY
        self._bar = tqdm(
            total=total,
            desc=name,
            disable=None,
            # A bar knows no workers: the first job of eight would be an eighth of the pace.
            bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]",
        )

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def ended(self, job: PlannedJob, record: Record) -> None:
        """Count a job that has ended."""
        self._seconds.append(record.seconds_total)
        if record.converged:
            self._done += 1
        else:
            self._failed += 1
            text = f"failed: {job.label}: {record.reason} ({job.folder})"
            tqdm.write(text, file=sys.stderr)
        self._bar.set_postfix_str(self.state(), refresh=False)
        self._bar.update(1)
        now = time.monotonic()
        if self._bar.disable and len(self._seconds) < self._total and now - self._said > SAY:
            self._said = now
            print(f"{self._name}: {self.state()}", file=sys.stderr)

    def state(self) -> str:
        """How many jobs have ended, and how long the others will take."""
        counts = f"{self._done} done, {self._failed} failed, {self._skipped} skipped"
        return f"{counts}, about {duration(self.left())} left"

    def left(self) -> float:
        """Seconds until the last job ends.

        The others take as long as those that have ended, one by one at each worker. The jobs that
        run now are partly done, and at the end workers wait for the last job: half a job each.
        """
        left = self._total - len(self._seconds)
        return left / max(1, min(self._workers, left)) * fmean(self._seconds)
