"""From the jobs of a sweep to its results: skip what is done, run the rest, collect, log."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig, OmegaConf

from experiments.common.progress import announce_compilation
from experiments.common.records.metrics import metrics
from experiments.common.records.record import Record
from experiments.common.schema import build, require_admissible_values
from experiments.common.study import load_study
from experiments.results.estimates import sweep_table
from experiments.results.publish import publish_runs, publish_sweep
from experiments.runner.collecting.collect import NOT_RUN, collect
from experiments.runner.execution.check import require_admissible
from experiments.runner.execution.engine import EngineSettings, require_engine, run_jobs
from experiments.runner.jobs.folder import (
    FailedRunError,
    last_record,
    nothing_empty,
    require_writable,
)
from experiments.runner.planning.compose import make_plan
from experiments.runner.planning.plan import Plan, PlannedJob
from experiments.runner.planning.progress import SweepBar
from experiments.runner.tracking.log import SWEEP, log_sweep
from experiments.sweeps.collected import Sweep, write_sweep_file
from experiments.sweeps.report import text_of, write_sweep
from mvest.errors import ConfigurationError, MvestError
from mvest.files import write_atomically

MULTIRUN, TABLE = "multirun.yaml", "jobs.parquet"
"""Files in a sweep's folder: its configuration as Hydra writes it, and all its jobs as a table."""

GIVEN_ONCE = ("planned", "basic")
"""Sweepers that know all their jobs beforehand; others may try a job twice."""


class SweepRun:
    """A sweep, whose jobs come in one batch or in several.

    Parameters
    ----------
    loader : ConfigLoader
        Hydra's.
    config : DictConfig
        The sweep's own configuration, with Hydra's part.
    """

    def __init__(self, loader: ConfigLoader, config: DictConfig) -> None:
        self._loader, self._config = loader, config
        self._jobs: dict[str, PlannedJob] = {}
        self._ended: dict[str, Record] = {}

    def launch(self, overrides: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        """Find out what jobs mean, refuse a wrong one before anything is written, and run them.

        Parameters
        ----------
        overrides : sequence of sequence of str
            Those of each job.
        first : int
            Number of the first of them in the sweep.

        Returns
        -------
        list of JobReturn
            One for each job, with its objective; none where jobs were only planned or checked.

        Raises
        ------
        MvestError, HydraException, OmegaConfBaseException
            If the request is wrong.
        """
        config = self._config
        launcher: Any = OmegaConf.to_container(config.hydra.launcher, resolve=True)
        launcher.pop("_target_")
        require_admissible_values(EngineSettings, launcher, "hydra.launcher")
        settings = build(EngineSettings, launcher)
        require_engine(settings)
        batch = make_plan(config, self._loader, overrides, first)
        if str(config.hydra.runtime.choices["hydra/sweeper"]) in GIVEN_ONCE:
            batch.require_different()
        for job in batch.jobs:
            _check(job)
        if config.dry_run:
            print(batch.summary(), batch.listing(), sep="\n")
            return []
        if config.check:
            _run_checks(batch)
            return []
        self._jobs |= {job.request.config_hash: job for job in batch.jobs}
        plan = replace(batch, jobs=tuple(self._jobs.values()))
        with nothing_empty(plan.folder, Path(config.paths.outputs)):
            require_writable(plan.folder)
            plan = plan.write()
            OmegaConf.save(config, plan.folder / MULTIRUN)
        print(batch.summary())
        if config.detach and batch.to_run:
            print(f"`mvest worker {plan.folder} --shard I/N`, for I from 1 to N, runs the jobs")
            print(f"`mvest collect {plan.folder}` writes what became of them")
            return []
        self._run(plan, batch, settings)
        found = {job.hash: job.record for job in finish(plan, self._ended).jobs}
        returned = [_returned(job, found[job.short_hash], config.objective) for job in batch.jobs]
        # Of ten thousand jobs not kept while they are logged.
        self._ended, found = {}, {}
        log_sweep(plan.folder, plan.common)
        return returned

    def _run(self, plan: Plan, batch: Plan, settings: EngineSettings) -> None:
        """Run the jobs of a batch that are not done."""
        left = {job.request.config_hash: job for job in batch.to_run}
        left = {key: job for key, job in left.items() if key not in self._ended}
        if not left:
            return
        announce_compilation("the first jobs")
        jobs = list(left.values())
        ends = run_jobs(
            [job.request for job in jobs], settings, min(plan.workers, len(jobs)), plan.written_ns
        )
        try:
            with SweepBar(plan.name, len(plan.jobs) - len(jobs), len(jobs), plan.workers) as bar:
                for k, record in ends:
                    self._ended[jobs[k].request.config_hash] = record
                    bar.ended(jobs[k], record)
        except KeyboardInterrupt:
            ends.close()
            collected(plan, self._ended)
            raise
        except OSError as error:
            # The jobs that ended are on disk.
            print(
                f"error: the sweep cannot go on ({error}); run the same command again to go on",
                file=sys.stderr,
            )


def collect_sweep(folder: Path) -> int:
    """Write and log what became of the jobs of a sweep that others work on, also before its end.

    Returns
    -------
    int
        Exit status: 1 if a job has no estimate.

    Raises
    ------
    MvestError
        If nothing is planned in the folder, or the results cannot be written.
    """
    plan = Plan.read(folder)
    found = finish(plan, {})
    log_sweep(plan.folder, plan.common)
    return 0 if all(record.converged for record in found.records) else 1


def finish(plan: Plan, ended: Mapping[str, Record]) -> Sweep:
    """Write, show and publish what became of a sweep.

    Raises
    ------
    MvestError
        If the results cannot be written.
    """
    found = collected(plan, ended)
    print(text_of(found))
    for path in write_sweep(plan.folder, found):
        if path.suffix in (".md", ".png"):
            print(f"Written to {path}")
    write_atomically(plan.folder / TABLE, sweep_table(found).to_parquet())
    publish_runs(
        (
            job.request.publish_as,
            last_record(job.folder, job.request.config_hash),
            job.folder,
            Path(job.values["paths"]["results"]),
        )
        for job in plan.jobs
        if job.request.publish_as
    )
    results = plan.common["paths"]["results"]
    if plan.publish and all(one.reason != NOT_RUN for one in found.records):
        publish_sweep(Path(results), found)
    elif plan.publish is False:
        print(f"{results} left as it is: this sweep has overrides")
    return found


def collected(plan: Plan, ended: Mapping[str, Record]) -> Sweep:
    """Write ``sweep.json`` and say in a line how the sweep ended."""
    path = plan.folder / SWEEP
    found = collect(plan, ended)
    write_sweep_file(path, found)
    print(_outcome(plan, found))
    print(f"Written to {path}")
    return found


def _returned(job: PlannedJob, record: Record, objective: str) -> JobReturn:
    """What Hydra is told of a job."""
    returned = JobReturn(overrides=job.request.overrides, working_dir=str(job.folder))
    returned.status = JobStatus.COMPLETED if record.converged else JobStatus.FAILED
    returned.return_value = (
        objective_of(record, objective)
        if record.converged
        else FailedRunError(record.reason, job.folder)
    )
    return returned


def objective_of(record: Record, name: str) -> float:
    """A number of a record, by the name that MLflow shows; NaN where it has none."""
    return metrics(record)[0].get(name, math.nan)


def _outcome(plan: Plan, found: Sweep) -> str:
    """How a sweep ended, in one line."""
    total, before = len(plan.jobs), sum(not job.to_run for job in plan.jobs)
    failed = [record for record in found.records if not record.converged]
    missing = sum(record.reason == NOT_RUN for record in failed)
    parts = [
        f"{total - len(failed)} of {total} jobs done" + (f" ({before} before)" if before else ""),
        f"{len(failed) - missing} without an estimate",
        *([f"{missing} not finished"] if missing else []),
    ]
    return f"{plan.name}: {', '.join(parts)}"


def _check(job: PlannedJob) -> None:
    """Refuse a job that could not run, saying which one it is."""
    try:
        require_admissible(job.values)
    except MvestError as error:
        raise ConfigurationError(f"{error} (job {' '.join(job.request.overrides)})") from error


def _run_checks(plan: Plan) -> None:
    """Say what the data of each job will tell."""
    study = plan.common["study"]
    checks = load_study(study).checks()
    for job in plan.jobs:
        if not checks or job.values["study"] != study:
            raise ConfigurationError(f"check=true has nothing to say of the job {job.label}")
        print(job.label, *(check(job.values, job.folder) for check in checks), "", sep="\n")
