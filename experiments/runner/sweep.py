"""From a sweep's plan to its file of results: skip what is done, launch the rest, collect.

Hydra's own sweeper would launch every job, also those that are done. So the jobs are planned before
anything is launched, handed to the configured launcher here, and Hydra's sweeper is not reached.
Hydra turns exceptions of its callbacks into warnings; what has to end the application is therefore
no ``Exception``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from statistics import median
from typing import Any, NoReturn

from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import HydraContext
from omegaconf import DictConfig

from experiments.common.progress import SweepBar, announce_compilation
from experiments.results.page import write_report
from experiments.runner.check import require_admissible
from experiments.runner.collect import collect
from experiments.runner.folder import is_done, require_writable, write_failure
from experiments.runner.guard import run_guarded
from experiments.runner.job import FailedRunError, require_study, run_job
from experiments.runner.plan import Plan, PlannedJob, make_plan, plan_run
from experiments.runner.request import Request, as_published
from experiments.sweeps.report import write_sweep
from mvest.errors import ConfigurationError, MvestError
from mvest.provenance import THREAD_VARIABLES, write_json

__all__ = ["LaunchSweep", "PlanRuns", "StopApplication", "sweep_task"]

FILE = "sweep.json"
"""The results of a sweep, in its folder."""


PLANNED: ContextVar[Plan] = ContextVar("PLANNED")
"""The plan of the sweep that is being started: Hydra lets callbacks share nothing else."""


class StopApplication(BaseException):
    """Ends the application from within a callback of Hydra's.

    Attributes
    ----------
    status : int
        Exit status.
    error : Exception or None
        What went wrong.
    """

    def __init__(self, status: int, error: Exception | None = None) -> None:
        super().__init__(status, error)
        self.status = status
        self.error = error


@contextmanager
def _nothing_goes_on() -> Iterator[None]:
    """Whatever is raised ends the application: Hydra would warn, and launch every job itself."""
    try:
        yield
    except Exception as error:
        raise StopApplication(2, error) from error


class PlanRuns(Callback):
    """Finds out what a request means, and refuses a wrong one, before anything is written."""

    @_nothing_goes_on()
    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Say what would run, if that is all that is asked."""
        if config.dry_run:
            plan = plan_run(config)
            require_admissible(plan.jobs[0].values)
            _tell(plan)

    @_nothing_goes_on()
    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Compose and check every job; say what is done and what is left."""
        plan = make_plan(config, GlobalHydra.instance().config_loader())
        for job in plan.jobs:
            _check(job.values, job.overrides)
        if config.dry_run:
            _tell(plan)
        if config.check:
            _foresee(plan)
        require_writable(plan.folder)
        plan.write()
        print(plan.summary())
        PLANNED.set(plan)


class LaunchSweep(Callback):
    """Runs a planned sweep and collects its results."""

    @_nothing_goes_on()
    def on_multirun_start(self, config: DictConfig, **more: Any) -> None:
        """Launch what is to be run, collect, and end the application."""
        callbacks = Callbacks(config)
        context = HydraContext(GlobalHydra.instance().config_loader(), callbacks)
        try:
            status = run_sweep(config, PLANNED.get(), context)
        finally:
            callbacks.on_multirun_end(config=config, **more)
        raise StopApplication(status)


def run_sweep(config: DictConfig, plan: Plan, context: HydraContext) -> int:
    """Launch the jobs that are not done and write ``sweep.json``, whatever becomes of them.

    Parameters
    ----------
    config : DictConfig
        The sweep's own, with Hydra's part.
    plan : Plan
    context : HydraContext

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
    if left:
        announce_compilation()
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
    write_json(path, found)
    failed = [job for job in found["jobs"] if job["status"] != "converged"]
    if lost is not None:
        print(
            f"error: the launcher lost its jobs ({lost}); run the same command again to go on",
            file=sys.stderr,
        )
    print(_outcome(plan, found, len(failed)))
    print(f"Written to {path}")
    if interrupted is not None:
        raise interrupted
    if lost is None:
        _publish(config, plan, found)
    return 1 if failed or lost is not None else 0


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


def _outcome(plan: Plan, found: Mapping[str, Any], failed: int) -> str:
    """How a sweep ended, in one line."""
    total, ran = len(plan.jobs), len(plan.to_run)
    text = f"{plan.name}: {total - failed} of {total} jobs done ({total - ran} before), "
    text += f"{failed} without an estimate; "
    text += f"stored truths used {found['truth_hits']} times, {found['truth_misses']} simulated"
    overheads = [cost["overhead"] for cost in found["cost"] if cost["overhead"] is not None]
    if overheads:
        text += f"; overhead {median(overheads):.2f} s per job"
    return text


def _publish(config: DictConfig, plan: Plan, found: Mapping[str, Any]) -> None:
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
    write_json(folder / f"{plan.sweep['name']}.json", found)
    write_sweep(results, found)
    write_report(results)
    print(f"Results in {results}")


def _check(values: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Refuse a job that could not run, saying which one it is."""
    try:
        require_admissible(values)
    except MvestError as error:
        raise ConfigurationError(f"{error} (job {' '.join(overrides)})") from error


def _tell(plan: Plan) -> NoReturn:
    """Say what would run, and end."""
    print(plan.summary())
    print(plan.listing())
    raise StopApplication(0)


def _foresee(plan: Plan) -> NoReturn:
    """Say what the data of each job will tell, and end."""
    checks = require_study(plan.jobs[0].values).checks()
    for job in plan.jobs:
        if not checks or job.values["study"] != plan.jobs[0].values["study"]:
            raise ConfigurationError(f"check=true has nothing to say of the job {job.label}")
        print(job.label, *(check(job.values, job.folder) for check in checks), "", sep="\n")
    raise StopApplication(0)


def _first_sentence(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [""])[0].split(". ")[0]


def sweep_task(config: DictConfig) -> dict[str, Any] | None:
    """A job of a sweep in the launcher's own process, for debuggers; its death ends the sweep."""
    try:
        run_job(config)
    except (MvestError, FailedRunError) as error:
        print(f"failed: {error}", file=sys.stderr)
    return None
