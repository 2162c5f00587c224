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
from experiments.results.estimates import sweep_table
from experiments.results.publish import publish_runs, publish_sweep
from experiments.runner.collecting.collect import NOT_RUN, collect
from experiments.runner.execution.check import require_admissible, require_checks
from experiments.runner.execution.cluster import EngineSettings, require_engine
from experiments.runner.execution.engine import run_jobs
from experiments.runner.jobs.folder import FailedRunError, last_record, nothing_empty
from experiments.runner.planning.compose import make_plan
from experiments.runner.planning.plan import Plan, PlannedJob
from experiments.runner.planning.progress import SweepBar
from experiments.runner.tracking.log import SWEEP, log_sweep
from experiments.sweeps.collected import Sweep, write_sweep_file
from experiments.sweeps.report import text_of, write_sweep
from mvest.errors import ConfigurationError, MvestError
from mvest.files import require_writable, write_atomically

MULTIRUN, TABLE = "multirun.yaml", "jobs.parquet"
"""Files in a sweep's folder: its configuration as Hydra writes it, and all its jobs as a table."""

PLANNED = "planned"
"""The sweeper that knows the grids of ``sweep=NAME``."""

GIVEN_ONCE = (PLANNED, "basic")
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
        sweeper = str(config.hydra.runtime.choices["hydra/sweeper"])
        if config.sweep and sweeper != PLANNED:
            raise ConfigurationError(f"hydra/sweeper={sweeper} knows no grid of sweep=NAME")
        later = [name for name in ("dry_run", "check", "detach") if config[name]]
        if later and sweeper not in GIVEN_ONCE:
            raise ConfigurationError(
                f"{later[0]}=true: hydra/sweeper={sweeper} finds its jobs by running"
            )
        batch = make_plan(config, self._loader, overrides, first, settings.at_a_time)
        if sweeper in GIVEN_ONCE:
            batch.require_different()
        for job in batch.jobs:
            _check(job)
        if config.dry_run:
            print(batch.summary(), batch.listing(), sep="\n")
            return []
        if config.check:
            _run_checks(batch)
            return []
        # What became of the jobs of earlier batches is on disk.
        self._jobs = {key: PlannedJob.of(job.request) for key, job in self._jobs.items()}
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
        ended = _run(plan, batch, settings)
        found = {job.hash: job.record for job in finish(plan, ended).jobs}
        returned = [_returned(job, found[job.short_hash], config.objective) for job in batch.jobs]
        # Ten thousand records are not kept while they are logged.
        folder, common = plan.folder, plan.common
        self._jobs = {key: PlannedJob(job.request) for key, job in self._jobs.items()}
        del ended, found, plan, batch
        log_sweep(folder, common)
        done = [one.return_value for one in returned if one.status == JobStatus.COMPLETED]
        if sweeper not in GIVEN_ONCE and any(map(math.isnan, done)):
            raise ConfigurationError(
                f"objective = {config.objective}: a job has no such number (MLflow shows all names)"
            )
        return returned


def _run(plan: Plan, batch: Plan, settings: EngineSettings) -> dict[str, Record]:
    """Run the jobs of a batch that are not done; returns heads of their records, by hash."""
    ended: dict[str, Record] = {}
    left = {job.request.config_hash: job for job in batch.to_run}
    if not left:
        return ended
    announce_compilation("the first jobs")
    jobs = list(left.values())
    ends = run_jobs(
        [job.request for job in jobs], settings, min(plan.workers, len(jobs)), plan.written_ns
    )
    try:
        with SweepBar(plan.name, len(plan.jobs) - len(jobs), len(jobs), plan.workers) as bar:
            for k, record in ends:
                ended[jobs[k].request.config_hash] = record
                bar.ended(jobs[k], record)
    except KeyboardInterrupt:
        ends.close()
        collected(plan, ended)
        raise
    except OSError as error:
        # The jobs that ended are on disk.
        print(
            f"error: the sweep cannot go on ({error}); run the same command again to go on",
            file=sys.stderr,
        )
    return ended


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
        else FailedRunError(f"{record.reason} (recorded in {job.folder})")
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
    """Say what the data of each job will tell; jobs that begin alike share what they compute."""
    studies = {job.values["study"]: job.values for job in plan.jobs}
    checks = {study: require_checks(values) for study, values in studies.items()}
    for job in plan.jobs:
        found = (check(job.values, job.folder) for check in checks[job.values["study"]])
        print(job.label, *found, "", sep="\n")
