"""From a sweep's plan to its file of results: skip what is done, launch the rest, collect, log."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext
from omegaconf import DictConfig

from experiments.common.progress import announce_compilation
from experiments.common.study import load_study
from experiments.results.page import write_report
from experiments.runner.check import require_admissible
from experiments.runner.collect import NOT_RUN, collect
from experiments.runner.folder import is_done, nothing_empty, require_writable, write_failure
from experiments.runner.guard import run_guarded
from experiments.runner.job import FailedRunError, run_job
from experiments.runner.plan import Plan, PlannedJob, make_plan
from experiments.runner.progress import SweepBar
from experiments.runner.request import Request, as_published
from experiments.runner.sync import log_sweep, open_early
from experiments.sweeps.collected import Sweep
from experiments.sweeps.report import write_sweep
from mvest.errors import ConfigurationError, MvestError
from mvest.provenance import THREAD_VARIABLES, write_json

__all__ = ["run_sweep", "sweep_task"]

FILE = "sweep.json"
"""The results of a sweep, in its folder."""


def run_sweep(context: HydraContext, config: DictConfig, arguments: Sequence[str]) -> int:
    """Find out what a request means, refuse a wrong one before anything is written, and run it.

    Parameters
    ----------
    context : HydraContext
    config : DictConfig
        The sweep's own, with Hydra's part.
    arguments : sequence of str
        Of the command line.

    Returns
    -------
    int
        Exit status: 1 if a job has no estimate.

    Raises
    ------
    MvestError, HydraException, OmegaConfBaseException
        If the request is wrong.
    """
    plan = make_plan(config, context.config_loader, arguments)
    for job in plan.jobs:
        _check(job.values, job.overrides)
    if config.dry_run:
        _tell(plan)
        return 0
    if config.check:
        _run_checks(plan)
        return 0
    with nothing_empty(plan.folder, Path(config.paths.outputs)):
        require_writable(plan.folder)
        plan.write()
    print(plan.summary())
    return run_plan(config, plan, context)


def run_plan(config: DictConfig, plan: Plan, context: HydraContext) -> int:
    """Launch the jobs that are not done, and write and log what became of all of them.

    Returns
    -------
    int
        Exit status: 1 if a job has no estimate.

    Raises
    ------
    MvestError
        If the results cannot be written.
    KeyboardInterrupt
        If the sweep was interrupted; what was done by then is collected.
    """
    returned: dict[str, dict[str, Any]] = {}
    left = plan.to_run
    lost = interrupted = None
    # Before any worker starts: the store is made by one process, and a wrong address is seen now.
    store = open_early(config, plan) if config.tracking.enabled else None
    if left:
        announce_compilation("the first jobs")
        try:
            with SweepBar(plan):
                returned = _launch(config, left, context)
        except KeyboardInterrupt as error:
            interrupted = error
        except ConfigurationError:
            # Refused before any job was launched.
            raise
        except Exception as error:
            # A launcher raises whatever its system tells it; the jobs that ended are on disk.
            lost = f"{type(error).__name__}: {_first_sentence(error)}"
    path = plan.folder / FILE
    found = collect(plan, returned, _measured(path))
    write_json(path, asdict(found))
    if lost is not None:
        print(
            f"error: the launcher lost its jobs ({lost}); run the same command again to go on",
            file=sys.stderr,
        )
    print(_outcome(plan, found))
    print(f"Written to {path}")
    if interrupted is not None:
        raise interrupted
    if config.tracking.enabled:
        log_sweep(config, plan, store)
    if lost is None:
        _publish(config, plan, found)
    done = all(job.converged for job in found.jobs)
    return 0 if done and lost is None else 1


def _launch(
    config: DictConfig, jobs: Sequence[PlannedJob], context: HydraContext
) -> dict[str, dict[str, Any]]:
    """Hand jobs to the configured launcher; short hash -> how the job ended.

    A job of which the launcher says that it died is recorded here: no one else is left to do it.
    """
    began = time.time()
    # Whatever the user has set: a launcher's workers share the machine's cores.
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    task = run_guarded if config.isolate else sweep_task
    launcher = Plugins.instance().instantiate_launcher(
        hydra_context=context, task_function=task, config=config
    )
    ends = launcher.launch([list(job.overrides) for job in jobs], initial_job_idx=0)
    for job, end in zip(jobs, ends, strict=True):
        if not _completed(end) and not is_done(job.folder):
            require_writable(job.folder)
            reason = _first_sentence(end._return_value)
            write_failure(Request(job.values, job.config_hash, job.folder), reason, began)
    values = [end.return_value for end in ends if _completed(end)]
    return {value["hash"]: value for value in values if value is not None}


def _measured(path: Path) -> dict[str, float]:
    """The overheads that an earlier run of the sweep measured; none if there was none."""
    try:
        costs = json.loads(path.read_text(encoding="utf-8"))["cost"]
    except (OSError, ValueError, KeyError):
        return {}
    return {cost["hash"]: cost["overhead"] for cost in costs if cost["overhead"] is not None}


def _completed(end: JobReturn) -> bool:
    return end.status == JobStatus.COMPLETED


def _outcome(plan: Plan, found: Sweep) -> str:
    """How a sweep ended, in one line."""
    total, ran = len(plan.jobs), len(plan.to_run)
    failed = [job for job in found.jobs if not job.converged]
    missing = sum(job.reason == NOT_RUN for job in failed)
    text = f"{plan.name}: {total - len(failed)} of {total} jobs done ({total - ran} before), "
    text += f"{len(failed) - missing} without an estimate"
    if missing:
        text += f", {missing} not finished"
    text += f"; stored truths used {found.truth_hits} times, {found.truth_misses} simulated"
    overheads = [cost.overhead for cost in found.cost if cost.overhead is not None]
    if overheads:
        text += f"; overhead {median(overheads):.2f} s per job"
    return text


def _publish(config: DictConfig, plan: Plan, found: Sweep) -> None:
    """Let the results take over a sweep that was run as it is configured."""
    if not config.publish or not plan.sweep:
        return
    results = Path(config.paths.results)
    # The size is chosen on the command line; anything else that is swept or changed is another one.
    changed = [line for line in config.hydra.overrides.task if line.startswith("sweep.")]
    sized = all(line.startswith("sweep.size=") for line in changed)
    if not (sized and as_published(config.hydra.overrides.task, None)):
        print(f"{results} left as it is: this sweep has overrides")
        return
    folder = results / "sweeps"
    require_writable(folder)
    write_json(folder / f"{found.name}.json", asdict(found))
    write_sweep(results, found)
    write_report(results)
    print(f"Results in {results}")


def _check(values: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Refuse a job that could not run, saying which one it is."""
    try:
        require_admissible(values)
    except MvestError as error:
        raise ConfigurationError(f"{error} (job {' '.join(overrides)})") from error


def _tell(plan: Plan) -> None:
    """Say what would run."""
    print(plan.summary())
    print(plan.listing())


def _run_checks(plan: Plan) -> None:
    """Say what the data of each job will tell."""
    checks = load_study(plan.jobs[0].values["study"]).checks()
    for job in plan.jobs:
        if not checks or job.values["study"] != plan.jobs[0].values["study"]:
            raise ConfigurationError(f"check=true has nothing to say of the job {job.label}")
        print(job.label, *(check(job.values, job.folder) for check in checks), "", sep="\n")


def _first_sentence(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [""])[0].split(". ")[0]


def sweep_task(config: DictConfig) -> dict[str, Any] | None:
    """A job of a sweep in the launcher's own process, for debuggers; its death ends the sweep."""
    try:
        run_job(config)
    except (MvestError, FailedRunError) as error:
        print(f"failed: {error}", file=sys.stderr)
    return None
