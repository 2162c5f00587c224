"""From the jobs of a sweep to its results: skip finished jobs, run the rest, collect, log."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig, OmegaConf

from experiments.common.progress import PartBar, say, wrapped
from experiments.common.records.record import Record
from experiments.common.schema import build, require_admissible_values
from experiments.results.estimates import sweep_table
from experiments.results.published import publish_runs, publish_sweep
from experiments.runner.cluster import EngineSettings, require_engine
from experiments.runner.compose import make_plan
from experiments.runner.engine import execute, run_jobs
from experiments.runner.job import check_of, require_admissible
from experiments.runner.jobs import FailedRunError, Request, last_record, nothing_empty
from experiments.runner.metrics import metrics
from experiments.runner.plan import NOT_RUN, Plan, earlier
from experiments.runner.tracking import SWEEP, log_run
from experiments.sweeps.collected import Sweep, write_sweep_file
from experiments.sweeps.report import text_of, write_sweep
from mvest.errors import ConfigurationError, MvestError
from mvest.files import require_writable, write_atomically

# Files in a sweep's folder: its configuration as Hydra writes it, and a table of all jobs.
MULTIRUN, TABLE = "multirun.yaml", "jobs.parquet"
PLANNED = "planned"  # the sweeper that knows the grids of ``sweep=NAME``
# Sweepers that know all their jobs beforehand; others may try a job twice.
GIVEN_ONCE = (PLANNED, "basic")


def launch(
    config: DictConfig,
    loader: ConfigLoader,
    overrides: Sequence[Sequence[str]],
    first: int,
    before: Sequence[Request] = (),
) -> tuple[list[JobReturn], tuple[Request, ...]]:
    """Compose the jobs of a batch, refuse a wrong one before anything is written, and run them.

    ``config`` is the sweep's own configuration with Hydra's part, ``overrides`` are those of each
    job, ``first`` is the number of the first one in the sweep, and ``before`` are the jobs of
    earlier batches. Returns the result of each job with its objective, none if jobs were only
    planned or checked, and all jobs of the sweep so far.

    Raises an `MvestError`, `HydraException` or `OmegaConfBaseException` if the request is wrong.
    """
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
    batch = make_plan(config, loader, overrides, first, settings.at_a_time)
    if sweeper in GIVEN_ONCE:
        batch.require_different()
    for job in batch.jobs:
        try:
            require_admissible(job.values)
        except MvestError as error:
            raise ConfigurationError(f"{error} (job {' '.join(job.overrides)})") from error
    if config.dry_run:
        print(wrapped(f"{batch.summary()}\n{batch.listing()}"))
        return [], ()
    if config.check:
        for study in {job.values["study"]: job for job in batch.jobs}.values():
            check_of(study.values)  # refused before the first one runs
        for job in batch.jobs:
            print(job.label, check_of(job.values)(job.values, job.folder), "", sep="\n")
        return [], ()
    jobs = tuple({job.config_hash: job for job in (*before, *batch.jobs)}.values())
    # The records of earlier batches are on disk.
    plan = replace(batch, jobs=jobs, before={**earlier(before), **batch.before})
    with nothing_empty(plan.folder, Path(config.paths.outputs)):
        require_writable(plan.folder)
        plan = plan.write()
        OmegaConf.save(config, plan.folder / MULTIRUN)
    print(wrapped(batch.summary()))
    if config.detach and batch.to_run:
        print(f"`mvest worker {plan.folder} --shard I/N`, for I from 1 to N, runs the jobs")
        print(f"`mvest collect {plan.folder}` collects and logs their results")
        return [], jobs
    ended = _run(plan, batch.to_run, settings)
    found = {job.hash: job.record for job in finish(plan, ended).jobs}
    returned = []
    for job in batch.jobs:
        record, one = found[job.short_hash], JobReturn(job.overrides, working_dir=str(job.folder))
        one.status = JobStatus.COMPLETED if record.converged else JobStatus.FAILED
        one.return_value = (
            metrics(record).get(config.objective, math.nan)
            if record.converged
            else FailedRunError(f"{record.reason} (recorded in {job.folder})")
        )
        returned.append(one)
    folder, common = plan.folder, plan.common
    del ended, found, plan, batch  # frees ten thousand records before they are logged
    log_run(folder, common)
    done = [one.return_value for one in returned if one.status == JobStatus.COMPLETED]
    if sweeper not in GIVEN_ONCE and any(map(math.isnan, done)):
        raise ConfigurationError(
            f"objective = {config.objective}: a job has no such number (MLflow shows all names)"
        )
    return returned, jobs


def run_plan(plan: Plan, jobs: Sequence[Request]) -> Sweep:
    """Run some jobs of a plan on this machine, and publish all that are done, by anyone.

    Raises an `MvestError` if a setting is inadmissible or a file cannot be written.
    """
    for job in jobs:
        require_admissible(job.values)
    settings = EngineSettings()
    require_writable(plan.folder)
    plan = replace(plan, workers=settings.at_a_time).write()
    try:
        ended = _run(plan, jobs, settings)
    except KeyboardInterrupt:
        done = earlier(plan.jobs)  # a job that was cut off may have left a failure
        kept = [
            job for job in plan.jobs if job.config_hash in done and done[job.config_hash].converged
        ]
        _publish_jobs(kept)
        raise
    # Others may have finished jobs meanwhile.
    return finish(plan, {**earlier(plan.jobs), **ended})


def _run(plan: Plan, todo: Sequence[Request], settings: EngineSettings) -> dict[str, Record]:
    """Run jobs that are not done; returns heads of their records, by hash."""
    ended: dict[str, Record] = {}
    jobs = list({job.config_hash: job for job in todo}.values())
    if not jobs:
        return ended
    ends = run_jobs(jobs, settings, min(plan.workers, len(jobs)), plan.written_ns)
    try:
        with PartBar(plan.name, len(jobs), "job") as bar:
            for k, record in ends:
                job = jobs[k]
                ended[job.config_hash] = record
                if not record.converged:
                    say(f"failed: {job.label}: {record.reason} ({job.folder})")
                bar.step()
    except KeyboardInterrupt:
        ends.close()
        collected(plan, ended)
        raise
    except OSError as error:
        # The jobs that ended are on disk.
        say(f"error: the sweep cannot go on ({error}); run the same command again to go on")
    return ended


def run_shard(folder: Path, shard: str) -> int:
    """Run every N-th job of a planned sweep from the I-th on, for a ``shard`` "I/N".

    A failing job is recorded and does not fail the shard, so the exit status is 0.

    Raises an `MvestError` if nothing is planned in the folder, or there is no such shard.
    """
    take = share_of(shard)
    plan = Plan.read(folder, look=False)
    # Counted over all jobs, done or not, so that no two shards share one.
    jobs = plan.jobs[take]
    failed = sum(not execute(job, plan.written_ns).converged for job in jobs)
    print(f"shard {shard}: {len(jobs)} jobs, {failed} without an estimate")
    return 0


def share_of(shard: str) -> slice:
    """Every N-th from the I-th on, for "I/N"; raises a `ConfigurationError` for any other text."""
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", shard)
    first, step = map(int, found.groups()) if found else (0, 0)
    if not 1 <= first <= step:
        raise ConfigurationError(f"shard {shard}, expected I/N with I from 1 to N, for example 2/8")
    return slice(first - 1, None, step)


def collect_sweep(folder: Path) -> int:
    """Collect and log a sweep that workers run, also before its end; 1 if a job has no estimate.

    Raises an `MvestError` if nothing is planned in the folder, or the results cannot be written.
    """
    plan = Plan.read(folder)
    found = finish(plan, {})
    log_run(plan.folder, plan.common)
    return 0 if all(record.converged for record in found.records) else 1


def finish(plan: Plan, ended: Mapping[str, Record]) -> Sweep:
    """Write, show and publish the results of a sweep; raises an `MvestError` if it cannot."""
    found = collected(plan, ended)
    print(text_of(found))
    for path in write_sweep(plan.folder, found):
        if path.suffix in (".md", ".png"):
            print(f"Written to {path}")
    write_atomically(plan.folder / TABLE, sweep_table(found).to_parquet())
    _publish_jobs(plan.jobs)
    results = plan.common["paths"]["results"]
    if plan.publish and all(one.reason != NOT_RUN for one in found.records):
        publish_sweep(Path(results), found)
    elif plan.publish is False:
        print(f"{results} left as it is: this sweep has overrides")
    return found


def _publish_jobs(jobs: Sequence[Request]) -> None:
    publish_runs(
        (
            job.publish_as,
            last_record(job.folder, job.config_hash),
            job.folder,
            Path(job.values["paths"]["results"]),
        )
        for job in jobs
        if job.publish_as
    )


def collected(plan: Plan, ended: Mapping[str, Record]) -> Sweep:
    """Write ``sweep.json`` and print in a line how the sweep ended."""
    path, left = plan.folder / SWEEP, {job.config_hash for job in plan.to_run}
    found = plan.collect(ended)
    write_sweep_file(path, found)
    before = sum(job.config_hash not in left for job in plan.jobs)
    failed = [record for record in found.records if not record.converged]
    missing = sum(record.reason == NOT_RUN for record in failed)
    print(
        f"{plan.name}: {len(plan.jobs) - len(failed)} of {len(plan.jobs)} jobs done"
        + (f" ({before} before)" if before else "")
        + f", {len(failed) - missing} without an estimate"
        + (f", {missing} not finished" if missing else "")
    )
    print(f"Written to {path}")
    return found
