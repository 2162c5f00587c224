"""Uploading what is on disk: ``python -m experiments.sync [FOLDER ...]``, and during a sweep.

The folders are the truth, and the tracking store is brought to their state: what is missing is
uploaded, what is there stays. So it may be called at any time and again, uploads what a server
that was away has missed, and rebuilds a database that was lost.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from tqdm import tqdm

from experiments.runner.folder import is_done
from experiments.runner.tracking import (
    RECEIPT,
    REMEDY,
    SWEEP_UPLOADS,
    Store,
    first_line,
    is_tracked,
    open_store,
    read_json,
    upload,
)
from mvest.errors import InputError, MvestError
from mvest.provenance import write_json

__all__ = ["LAST_SWEEP", "UploadSweep", "jobs_in", "main"]

LAST_SWEEP = "last_sweep.json"
"""File in an experiment's folder that names its last sweep and the folders of its jobs."""

PLAN = "plan.json"
"""File in a sweep's folder with the jobs that it consists of."""

INTERVAL = 1.0
"""Seconds between two looks for new results."""

PAUSE = 30.0
"""Seconds after which a store that failed is tried again."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Upload every job in the folders given (``outputs`` if none); returns the exit status.

    0: the stores have everything; 1: a store could not be written, or a job could not be read.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    folders = [Path(text) for text in given or ["outputs"]]
    missing = [folder for folder in folders if not folder.is_dir()]
    if missing:
        print(f"error: {missing[0]} is no folder", file=sys.stderr)
        return 2
    status = 0
    for folder in folders:
        groups: dict[tuple[str | None, str], list[Path]] = {}
        for job in jobs_in(folder):
            try:
                config = read_json(job / "config.json")
                if config["tracking"]["enabled"] and is_complete(job):
                    key = config["tracking"]["uri"], str(config["name"])
                    groups.setdefault(key, []).append(job)
            except (MvestError, KeyError) as error:
                print(f"warning: {job} left out: {first_line(error)}", file=sys.stderr)
                status = 1
        for (uri, name), jobs in groups.items():
            try:
                status = max(status, _sync_experiment(uri, folder, name, jobs))
            except MvestError as error:
                print(f"error: {name}: {error}; nothing is lost, try again later", file=sys.stderr)
                status = 1
    return status


def jobs_in(folder: Path) -> list[Path]:
    """Folders of finished jobs: this one, its folders, or theirs (``outputs/EXPERIMENT/JOB``)."""
    found = {
        path.parent
        for depth in ("", "*/", "*/*/")
        for path in folder.glob(f"{depth}result.json")
        if (path.parent / "config.json").is_file()
    }
    return sorted(found)


def is_complete(job: Path) -> bool:
    """Whether a job has ended: it has failed, or its marker says that everything is on disk."""
    return is_done(job) or read_json(job / "result.json").get("status") != "converged"


def _sync_experiment(uri: str | None, outputs: Path, name: str, jobs: Sequence[Path]) -> int:
    store = open_store(uri, outputs, name)
    store.list_runs()
    added, unreadable = 0, 0
    for job in tqdm(jobs, desc=name, unit="job", disable=None, leave=False):
        try:
            added += upload(store, job, _sweep_of(job))
        except InputError as error:
            tqdm.write(f"warning: {job} left out: {error}", file=sys.stderr)
            unreadable += 1
    there = len(jobs) - added - unreadable
    print(f"{name}: {added} uploaded, {there} already there, in {store.place}")
    return int(unreadable > 0)


def _sweep_of(job: Path) -> str | None:
    """The sweep that a job belongs to, as far as the folders know."""
    last = job.parent / LAST_SWEEP
    if last.is_file():
        sweep = read_json(last)
        if job.name in sweep["jobs"]:
            return str(sweep["sweep_id"])
    return None


class UploadSweep(Callback):
    """Uploads a sweep's results while it runs, from the process that started it.

    The store and the experiment are made before the launcher starts. A store that fails costs one
    line of warning; it is tried again until the sweep ends.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Create the store and begin to look for results."""
        if config.tracking.enabled and not config.get("dry_run", False):
            os.environ[SWEEP_UPLOADS] = "1"
            uploader = SweepUploader(
                config.tracking.uri, Path(config.paths.outputs), str(config.name)
            )
            UPLOADER.set(uploader)
            uploader.start()

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Upload the rest and say where everything is."""
        uploader = UPLOADER.get()
        if uploader is not None:
            UPLOADER.set(None)
            del os.environ[SWEEP_UPLOADS]
            uploader.finish()


class SweepUploader:
    """Uploads new results of one experiment from a thread of the sweep's parent.

    Parameters
    ----------
    uri : str or None
        The tracking store, as configured.
    outputs : Path
        The outputs folder; the experiment's jobs are in its folder ``name``.
    name : str
        The experiment.
    """

    def __init__(self, uri: str | None, outputs: Path, name: str) -> None:
        self._uri, self._outputs, self._name = uri, outputs, name
        self._folder = outputs / name
        self._began = time.time()
        self._sweep_id: str | None = None
        self._store: Store | None = None
        self._seen: dict[Path, int] = {}
        self._warned = False
        self._stop = threading.Event()
        # A daemon, so that an interrupted sweep ends at once; a half-written run is replaced later.
        self._thread = threading.Thread(target=self._watch, name="mlflow-uploads", daemon=True)

    def start(self) -> None:
        """Open the store and begin to upload."""
        self._folder.mkdir(parents=True, exist_ok=True)
        try:
            self._open()
        except MvestError as error:
            self._warn(error)
        self._thread.start()

    def finish(self) -> None:
        """Upload the rest, mark every job as part of this sweep, and say what is not uploaded."""
        self._stop.set()
        self._thread.join()
        jobs = self._members()
        sweep_id = self._identify(jobs)
        try:
            self._upload_pending()
            store = self._open()
            for job in jobs:
                # Jobs that were done before belong to the sweep that listed them last, also those
                # that were not to be tracked then.
                receipt = job / RECEIPT
                known = read_json(receipt) if receipt.is_file() else {}
                if known.get("sweep_id") != sweep_id:
                    upload(store, job, sweep_id)
        except MvestError as error:
            self._warn(error)
            left = sum(not (job / RECEIPT).is_file() for job in jobs)
            tqdm.write(f"warning: {left} of {len(jobs)} runs are not in MLflow", file=sys.stderr)

    def _watch(self) -> None:
        wait = INTERVAL
        while not self._stop.wait(wait):
            began = time.monotonic()
            try:
                self._upload_pending()
            except MvestError as error:
                self._warn(error)
                wait = PAUSE
            else:
                # Looking through ten thousand folders must not keep a file server busy.
                wait = max(INTERVAL, 10.0 * (time.monotonic() - began))

    def _open(self) -> Store:
        if self._store is None:
            store = open_store(self._uri, self._outputs, self._name)
            store.list_runs()
            self._store = store
        return self._store

    def _upload_pending(self) -> None:
        pending = list(self._pending())
        if not pending:
            return
        members = self._members()
        sweep_id, names = self._identify(members), {job.name for job in members}
        for job, changed in pending:
            try:
                upload(self._open(), job, sweep_id if job.name in names else None)
            except InputError as error:
                tqdm.write(f"warning: not in MLflow: {error}", file=sys.stderr)
            self._seen[job] = changed

    def _pending(self) -> Iterator[tuple[Path, int]]:
        for job in jobs_in(self._folder):
            changed = (job / "result.json").stat().st_mtime_ns
            if self._seen.get(job) == changed:
                continue
            try:
                if is_tracked(job) or not read_json(job / "config.json")["tracking"]["enabled"]:
                    self._seen[job] = changed
                    continue
                if not is_complete(job):
                    continue
            except InputError as error:
                tqdm.write(f"warning: not in MLflow: {error}", file=sys.stderr)
                self._seen[job] = changed
                continue
            yield job, changed

    def _members(self) -> list[Path]:
        """Finished jobs of this sweep: those of its plan, or those that ended since it began."""
        plan = self._folder / PLAN
        planned = None
        if plan.is_file():
            planned = {Path(job["folder"]).name for job in read_json(plan)["jobs"]}
        return [
            job
            for job in jobs_in(self._folder)
            if (
                (job / "result.json").stat().st_mtime >= self._began - 1.0
                if planned is None
                else job.name in planned
            )
        ]

    def _identify(self, jobs: Sequence[Path]) -> str:
        """Name the sweep, as before if it is the same plan resumed, and write down its jobs."""
        names = sorted(job.name for job in jobs)
        path = self._folder / LAST_SWEEP
        if self._sweep_id is None:
            began = time.strftime("%Y%m%d-%H%M%S", time.gmtime(self._began))
            self._sweep_id = f"{began}-{uuid.uuid4().hex[:4]}"
            if (self._folder / PLAN).is_file() and path.is_file():
                before = read_json(path)
                if set(before["jobs"]) <= {
                    Path(job["folder"]).name for job in read_json(self._folder / PLAN)["jobs"]
                }:
                    self._sweep_id = str(before["sweep_id"])
        write_json(path, {"sweep_id": self._sweep_id, "began": self._began, "jobs": names})
        return self._sweep_id

    def _warn(self, error: MvestError) -> None:
        if not self._warned:
            tqdm.write(f"warning: {error}; {REMEDY}", file=sys.stderr)
        self._warned = True


UPLOADER: ContextVar[SweepUploader | None] = ContextVar("UPLOADER", default=None)
"""The running sweep's: the end of a sweep may be told to another object than its start."""


if __name__ == "__main__":
    sys.exit(main())
