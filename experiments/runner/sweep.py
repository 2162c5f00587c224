"""From a sweep's plan to its file of results: skip what is done, run the rest, collect, log."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf

from experiments.common.progress import announce_compilation
from experiments.common.records.record import Record
from experiments.common.schema import require_admissible_values
from experiments.common.study import load_study
from experiments.results.estimates import sweep_table
from experiments.results.keep import publish, records_of
from experiments.runner.collecting.collect import NOT_RUN, collect, read_ends
from experiments.runner.execution import slurm
from experiments.runner.execution.check import require_admissible
from experiments.runner.execution.drain import drain_here, drain_inline
from experiments.runner.jobs.folder import last_record, nothing_empty, require_writable
from experiments.runner.planning.compose import make_plan
from experiments.runner.planning.plan import Plan
from experiments.runner.planning.progress import SweepBar
from experiments.runner.tracking.log import SWEEP, log_sweep
from experiments.sweeps.collected import SWEEPS, Sweep, write_sweep_file
from experiments.sweeps.report import write_sweep
from mvest.errors import ConfigurationError, MvestError
from mvest.files import write_atomically
from mvest.quantities import Gigabytes, Processes, within


@dataclass(frozen=True, slots=True, kw_only=True)
class LauncherSettings:
    """Ranges of the settings of launchers (``conf/hydra/launcher``)."""

    n_jobs: Annotated[int, within(-1024, 1024, "", "processes; -1: one for each core")]
    jobs_per_task: Annotated[int, within(1, 1_000_000, "", "jobs of a sweep")]
    array_parallelism: Annotated[int, within(1, 1_000_000, "", "tasks of a sweep")]
    timeout_min: Annotated[int, within(1, 525_600, "min", "up to a year")]
    cpus_per_task: Processes
    mem_gb: Gigabytes
    poll_s: Annotated[float, within(0.01, 3600, "s", "an hour is too long to notice an end")]


TABLE = "jobs.parquet"
"""File in a sweep's folder: all its jobs as a table."""

LAUNCHERS = ("local", "basic", "slurm")
"""Who can run jobs; Hydra's basic one stands for one process."""

LOOK_AGAIN = 2.0
"""Seconds between two questions to Slurm about a sweep that is collected later."""


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
    launcher: Any = OmegaConf.to_container(config.hydra.launcher, resolve=True)
    require_admissible_values(LauncherSettings, launcher, "hydra.launcher")
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
        plan = plan.write()
    print(plan.summary())
    return run_plan(config, plan)


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
    arrays = slurm.submitted(plan.folder)
    to_come = slurm.record_dead(plan, arrays, LOOK_AGAIN) if arrays else 0
    if to_come:
        print(f"{plan.name}: {to_come} jobs wait or run in Slurm")
    return _collect(plan, to_come)


def run_plan(config: DictConfig, plan: Plan) -> int:
    """Run the jobs that are not done, and write and log what became of all of them.

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
    settings: Any = OmegaConf.to_container(config.hydra.launcher, resolve=True)
    launcher = _launcher(config)
    if config.detach and plan.to_run:
        if launcher == "slurm":
            slurm.submit(plan, settings)
        else:
            print(f"`mvest worker {plan.folder} --shard I/N`, for I from 1 to N, runs the jobs")
        print(f"`mvest collect {plan.folder}` writes what became of them")
        return 0
    if plan.to_run:
        announce_compilation("the first jobs")
        try:
            arrays = slurm.submit(plan, settings) if launcher == "slurm" else []
            with SweepBar(plan):
                if arrays:
                    slurm.wait_for(arrays, settings["poll_s"])
                    slurm.record_dead(plan, arrays, settings["poll_s"])
                elif config.isolate:
                    drain_here(plan)
                else:
                    drain_inline(plan)
        except KeyboardInterrupt:
            _write(plan)
            raise
        except OSError as error:
            # The jobs that ended are on disk.
            print(
                f"error: the sweep cannot go on ({error}); run the same command again to go on",
                file=sys.stderr,
            )
    return _collect(plan, 0)


def _launcher(config: DictConfig) -> str:
    """Who runs the jobs."""
    chosen = str(config.hydra.runtime.choices["hydra/launcher"])
    if chosen not in LAUNCHERS:
        raise ConfigurationError(
            f"hydra/launcher = {chosen!r}, expected local or slurm; any other scheduler may run "
            "`mvest worker` on a sweep that detach=true has planned"
        )
    return chosen


def _collect(plan: Plan, to_come: int) -> int:
    """Write, log and publish what became of a sweep; the exit status."""
    found = _write(plan)
    write_atomically(plan.folder / TABLE, sweep_table(found).to_parquet())
    log_sweep(plan.folder, plan.common)
    restored = _restore(plan)
    if restored:
        print(f"{plan.name}: results take over {restored} runs of earlier attempts")
    missing = any(record.reason == NOT_RUN for record in found.records)
    if not missing and not to_come:
        _publish(plan, found)
    return 0 if all(record.converged for record in found.records) else 1


def _restore(plan: Plan) -> int:
    """Let the results take over what jobs ended with where they have other records, or none.

    A job publishes its own record as it ends. What was done before is not run again, and the
    results may have been put back to another state since. Returns how many were taken over.
    """
    groups: dict[tuple[Path, str, str], dict[str, tuple[Record, Path]]] = {}
    for job in plan.jobs:
        record = last_record(job.folder, job.config_hash) if job.publish_as else None
        if record is None or not (record.converged or load_study(record.study).keeps_failures):
            continue
        results = Path(job.values["paths"]["results"])
        runs = groups.setdefault((results, record.study, record.table), {})
        runs[str(job.publish_as)] = record, job.folder
    count = 0
    for (results, study, table), runs in groups.items():
        kept = records_of(results, table)
        hashes = {
            name: record.provenance.config_hash
            for name, record in (kept.records.items() if kept is not None else ())
        }
        new = {
            name: run
            for name, run in runs.items()
            if hashes.get(name) != run[0].provenance.config_hash
        }
        if new:
            publish(load_study(study), results, new)
        count += len(new)
    return count


def _write(plan: Plan) -> Sweep:
    path = plan.folder / SWEEP
    found = collect(plan, read_ends(plan.folder))
    write_sweep_file(path, found)
    print(_outcome(plan, found))
    print(f"Written to {path}")
    return found


def _outcome(plan: Plan, found: Sweep) -> str:
    """How a sweep ended, in one line."""
    total, ran = len(plan.jobs), len(plan.to_run)
    failed = [record for record in found.records if not record.converged]
    missing = sum(record.reason == NOT_RUN for record in failed)
    stored = [record.numbers.get("truth_store") for record in found.records]
    text = f"{plan.name}: {total - len(failed)} of {total} jobs done"
    text += f" ({total - ran} before), " if total > ran else ", "
    text += f"{len(failed) - missing} without an estimate"
    if missing:
        text += f", {missing} not finished"
    text += f"; stored truths used {stored.count('hit')} times, {stored.count('miss')} simulated"
    overheads = [job.overhead for job in found.jobs if job.overhead is not None]
    if overheads:
        text += f"; overhead {median(overheads):.2f} s per job"
    return text


def _publish(plan: Plan, found: Sweep) -> None:
    """Let the results take over a sweep that was run as it is configured."""
    if plan.publish is None:
        return
    results = Path(plan.common["paths"]["results"])
    if not plan.publish:
        print(f"{results} left as it is: this sweep has overrides")
        return
    folder = results / SWEEPS
    require_writable(folder)
    write_sweep_file(folder / f"{found.name}.json", found)
    write_sweep(results, found)
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
