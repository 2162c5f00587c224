"""Logging what is on disk: ``make sync``, and a sweep's end.

The folders are the truth, and the tracking store is brought to their state: what is missing is
logged, what is there stays. So it may be called at any time, also while a sweep runs, and again. It
logs what a server that was away has missed, and rebuilds a database that was lost.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.runner.jobs.interruption import interruptible
from experiments.runner.planning.plan import PLAN, Plan
from experiments.runner.tracking.store import Store, first_line, open_store
from experiments.runner.tracking.summary import SWEEP, log_summary
from experiments.runner.tracking.upload import REMEDY, is_complete, is_tracked, upload
from mvest.errors import InputError, MvestError
from mvest.reading.documents import read_mapping

MANY = 1000
"""Jobs of a sweep above which each is a run of its own only where that is asked for."""


@interruptible
def main(arguments: Sequence[str] | None = None) -> int:
    """Log every job in the folders given (``outputs`` if none); returns the exit status.

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
        groups: dict[tuple[str | None, str, bool | None], list[Path]] = {}
        for job in jobs_in(folder):
            try:
                config = read_mapping(job / "config.json")
                if config["tracking"]["enabled"] and is_complete(job):
                    tracking = config["tracking"]
                    key = tracking["uri"], str(config["name"]), tracking.get("runs")
                    groups.setdefault(key, []).append(job)
            except (MvestError, KeyError) as error:
                print(f"warning: {job} left out: {first_line(error)}", file=sys.stderr)
                status = 1
        for (uri, name, each), jobs in groups.items():
            try:
                store = open_store(uri, folder, name)
                added, there, unreadable = _log(store, name, jobs, each)
            except MvestError as error:
                print(f"error: {name}: {error}; nothing is lost, try again later", file=sys.stderr)
                status = 1
                continue
            print(f"{name}: {added} uploaded, {there} already there, in {store.place}")
            status = max(status, int(unreadable > 0))
    return status


def open_early(config: Mapping[str, Any], plan: Plan) -> Store | None:
    """Make the store and the experiment of a sweep; None, with a warning, if that cannot be."""
    try:
        return open_store(config["tracking"]["uri"], Path(config["paths"]["outputs"]), plan.name)
    except MvestError as error:
        print(f"warning: {error}; {REMEDY}", file=sys.stderr)
        return None


def log_sweep(config: Mapping[str, Any], plan: Plan, store: Store | None) -> None:
    """Log all finished jobs of a sweep, also those that were done before; say what is not logged.

    One run sums the sweep up; each job is a run of its own as well, unless they are very many. A
    store that fails costs a line of warning: the results are on disk, to be logged later.
    """
    jobs = [job.folder for job in plan.jobs if (job.folder / "result.json").is_file()]
    try:
        tracking, outputs = config["tracking"], Path(config["paths"]["outputs"])
        store = store or open_store(tracking["uri"], outputs, plan.name)
        complete = [job for job in jobs if is_complete(job)]
        _log(store, plan.name, complete, tracking.get("runs"))
    except MvestError as error:
        left = sum(not is_tracked(job) for job in jobs)
        tqdm.write(
            f"warning: {left} of {len(jobs)} runs are not in MLflow: {error}; {REMEDY}",
            file=sys.stderr,
        )


def jobs_in(folder: Path) -> list[Path]:
    """Folders of finished jobs: this one, its folders, or theirs (``outputs/EXPERIMENT/JOB``)."""
    found = {
        path.parent
        for depth in ("", "*/", "*/*/")
        for path in folder.glob(f"{depth}result.json")
        if (path.parent / "config.json").is_file()
    }
    return sorted(found)


def _log(
    store: Store, name: str, jobs: Sequence[Path], each: bool | None = None
) -> tuple[int, int, int]:
    """Log jobs of one experiment; how many were added, were there, and could not be read.

    ``each`` says whether those of a sweep are runs of their own; None: unless they are many.
    """
    plans = {folder: _sweep_in(folder) for folder in {job.parent for job in jobs}}
    added = unreadable = 0
    own = []
    for job in jobs:
        _, names = plans[job.parent]
        if job.name not in names or (len(names) <= MANY if each is None else each):
            own.append(job)
    if own:
        store.list_runs()
    for job in tqdm(own, desc=f"{name} to MLflow", unit="job", disable=None, leave=False):
        try:
            sweep_id, names = plans[job.parent]
            within = job.name in names
            added += upload(store, job, sweep_id if within else None, names.get(job.name))
        except InputError as error:
            tqdm.write(f"warning: {job} left out: {error}", file=sys.stderr)
            unreadable += 1
    for folder, (sweep_id, _) in plans.items():
        if sweep_id is not None and (folder / SWEEP).is_file():
            log_summary(store, folder, sweep_id)
    return added, len(own) - added - unreadable, unreadable


def _sweep_in(folder: Path) -> tuple[str | None, dict[str, str]]:
    """The sweep that a folder was last used for: its id, and folder -> name of its jobs."""
    if not (folder / PLAN).is_file():
        return None, {}
    plan = read_mapping(folder / PLAN)
    names = {Path(job["folder"]).name: str(job.get("name", "")) for job in plan["jobs"]}
    return plan.get("sweep_id"), names


if __name__ == "__main__":
    sys.exit(main())
