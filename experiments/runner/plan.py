"""What a sweep will run: its jobs, which of them are done, and how long the others will take.

A grid is a mapping from settings to choices in Hydra's sweep syntax, and stands for the product of
its choices. Several grids stand for their union. What is said on the command line holds for every
grid and takes the place of a grid's own choices.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError

from experiments.common.config import hash_of, plain
from experiments.runner.folder import RESULT, last_record
from experiments.runner.request import model_settings
from mvest.errors import ConfigurationError
from mvest.provenance import git_state, write_json

__all__ = ["Plan", "PlannedJob", "expand", "make_plan", "plan_run"]

SWEEPER = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
"""The sweeper whose syntax and products are understood here."""

MOST_READ = 500
"""Results that are read to estimate a time."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedJob:
    """One job of a sweep.

    Attributes
    ----------
    config_hash : str
    folder : Path
    overrides : tuple of str
    values : dict
        The resolved configuration.
    record : dict or None
        What an earlier attempt recorded.
    done : bool
    """

    config_hash: str
    folder: Path
    overrides: tuple[str, ...]
    values: dict[str, Any]
    record: dict[str, Any] | None
    done: bool

    @property
    def label(self) -> str:
        """What sets the job apart, for a line of text."""
        factors = self.values["factors"]
        if factors:
            return ", ".join(f"{name}={value}" for name, value in factors.items())
        return " ".join(self.overrides)


@dataclass(frozen=True, slots=True)
class Plan:
    """All jobs of a sweep, in order.

    Attributes
    ----------
    name : str
        Of the configuration.
    folder : Path
        Of the sweep.
    sweep : dict
        The configuration's ``sweep``, empty for jobs swept on the command line.
    jobs : tuple of PlannedJob
    workers : int
        Jobs that run at a time; 1 where it is not known.
    """

    name: str
    folder: Path
    sweep: dict[str, Any]
    jobs: tuple[PlannedJob, ...]
    workers: int

    @property
    def to_run(self) -> list[PlannedJob]:
        """Jobs that are missing, have failed, or are to be run again."""
        return [job for job in self.jobs if job.values["force"] or not job.done]

    def write(self) -> None:
        """Write ``plan.json`` into the sweep's folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(
            self.folder / "plan.json",
            {
                "sweep": self.sweep.get("name", self.name),
                "size": self.sweep.get("size"),
                "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                "jobs": [
                    {
                        "hash": job.config_hash[:16],
                        "folder": os.path.relpath(job.folder, self.folder),
                        "overrides": list(job.overrides),
                        "factors": job.values["factors"],
                        "row": job.values["row"],
                        "repeats": job.values.get("repeats", 1),
                    }
                    for job in self.jobs
                ],
            },
        )

    def summary(self) -> str:
        """How much is done and how much is left, in one line."""
        left, done = self.to_run, sum(job.done for job in self.jobs)
        failed = sum(job.record is not None and not job.done for job in self.jobs)
        size = f" ({self.sweep['size']})" if "size" in self.sweep else ""
        text = f"{self.name}{size}: {len(self.jobs)} jobs, {done} done, {failed} failed before, "
        return f"{text}{len(left)} to run{self._stale()}; {self.estimate()}"

    def listing(self) -> str:
        """Every job with its state, one line each."""
        run_again = {job.config_hash for job in self.to_run}
        return "\n".join(
            f"  {'run ' if job.config_hash in run_again else 'done'}  {job.config_hash[:16]}  "
            f"{job.label}"
            + (f"  [failed before: {job.record['reason']}]" if job.record and not job.done else "")
            for job in self.jobs
        )

    def estimate(self) -> str:
        """How long the jobs that are left will take, from what finished ones took."""
        left = self.to_run
        if not left:
            return "nothing left"
        spent = _recorded_seconds(self.folder.parent, self)
        times = [
            fmean(spent[kind]) * job.values.get("repeats", 1)
            for job in left
            if (kind := json.dumps(model_settings(job.values))) in spent
        ]
        if not times:
            return "time unknown: no job of this kind has finished yet"
        total = _duration(fmean(times) * len(left) / min(self.workers, len(left)))
        rest = f" (from {len(times)} of a known kind)" if len(times) < len(left) else ""
        return f"about {total}, {self.workers} at a time{rest}"

    def _stale(self) -> str:
        """A remark on results that other code than the present one computed."""
        present = git_state(Path(__file__).resolve().parent)["sha"]
        commits = [
            job.record["provenance"]["git"]["sha"] for job in self.jobs if job.done and job.record
        ]
        other = sum(sha != present for sha in commits)
        return f" ({other} of the done ones by another commit; force=true redoes)" if other else ""


def make_plan(config: DictConfig, loader: ConfigLoader) -> Plan:
    """Compose every job of a sweep, in Hydra's order.

    Parameters
    ----------
    config : DictConfig
        The sweep's own configuration, with Hydra's part.
    loader : ConfigLoader

    Raises
    ------
    ConfigurationError
        If the sweep has no such size, or two jobs are one and the same.
    HydraException, OmegaConfBaseException
        If a job cannot be composed.
    """
    sweeper = config.hydra.sweeper["_target_"]
    if sweeper != SWEEPER:
        raise ConfigurationError(f"hydra/sweeper = {sweeper}, expected hydra/sweeper=basic")
    jobs: list[PlannedJob] = []
    for overrides in expand(_grids(config), config.hydra.overrides.task, loader):
        job = _planned(loader.load_sweep_config(config, overrides), overrides)
        jobs.append(job)
    _require_different(jobs)
    sweep: dict[str, Any] = OmegaConf.to_container(config.sweep, resolve=True)  # type: ignore[assignment]
    folder = Path(str(config.hydra.sweep.dir))
    return Plan(str(config.name), folder, sweep, tuple(jobs), _workers(config))


def plan_run(config: DictConfig) -> Plan:
    """The plan of a run by itself."""
    folder = Path(str(config.hydra.run.dir))
    job = _planned(config, config.hydra.overrides.task, folder)
    return Plan(str(config.name), folder.parent, {}, (job,), 1)


def expand(
    grids: Sequence[Mapping[str, Any]], arguments: Sequence[str], loader: ConfigLoader
) -> list[list[str]]:
    """The overrides of every job.

    Parameters
    ----------
    grids : sequence of mapping
        Setting -> choices.
    arguments : sequence of str
        Of the command line.
    loader : ConfigLoader
    """
    parser = OverridesParser.create(config_loader=loader)
    found: list[list[str]] = []
    for grid in grids:
        lines = [f"{key}={value}" for key, value in grid.items()]
        parsed = parser.parse_overrides([*lines, *arguments])
        found += BasicSweeper.split_arguments(parsed, None)[0]
    return found


def _grids(config: DictConfig) -> list[dict[str, Any]]:
    """The grids that a sweep's size, or Hydra's own parameters, stand for."""
    try:
        params = config.hydra.sweeper.params
    except InterpolationKeyError:
        sizes = [str(key) for key, value in config.sweep.items() if OmegaConf.is_config(value)]
        raise ConfigurationError(
            f"sweep.size = {config.sweep.get('size')!r}, expected one of {', '.join(sizes)}"
        ) from None
    if params is None:
        return [{}]
    plain_params: Any = OmegaConf.to_container(params, resolve=True)
    grids = plain_params if isinstance(plain_params, list) else [plain_params]
    if not grids or not all(isinstance(grid, dict) for grid in grids):
        raise ConfigurationError("hydra.sweeper.params: expected a grid or a list of grids")
    return grids


def _planned(
    config: DictConfig, overrides: Sequence[str], folder: Path | None = None
) -> PlannedJob:
    if folder is None:
        HydraConfig.instance().set_config(config)
        folder = Path(str(config.hydra.sweep.dir)) / str(config.hydra.sweep.subdir)
    config_hash, values = hash_of(config), plain(config)
    record = last_record(folder, config_hash)
    done = record is not None and record["status"] == "converged"
    return PlannedJob(config_hash, folder, tuple(overrides), values, record, done)


def _require_different(jobs: Sequence[PlannedJob]) -> None:
    first: dict[Path, PlannedJob] = {}
    for job in jobs:
        other = first.setdefault(job.folder.resolve(), job)
        if other is not job:
            raise ConfigurationError(
                f"two jobs are one and the same: {' '.join(other.overrides)} and "
                f"{' '.join(job.overrides)}"
            )


def _workers(config: DictConfig) -> int:
    jobs = config.hydra.launcher.get("n_jobs") or config.hydra.launcher.get("array_parallelism")
    if jobs is None:
        return 1
    return max(1, int(jobs) if int(jobs) > 0 else (os.cpu_count() or 1) + 1 + int(jobs))


def _recorded_seconds(folders: Path, plan: Plan) -> dict[str, list[float]]:
    """Kind of job -> seconds for one seed, from what finished in the folders of all runs."""
    found: dict[str, list[float]] = {}
    places = sorted(
        folders.glob(f"*/*/{RESULT}"), key=lambda place: place.parent.parent != plan.folder
    )
    for place in places[:MOST_READ]:
        try:
            record = json.loads(place.read_text(encoding="utf-8"))
            kind, seconds = json.dumps(record["model"]), float(record["seconds_total"])
            seeds = len(record.get("repeats") or [None])
            converged = record["status"] == "converged"
        except (OSError, ValueError, KeyError, TypeError):
            # Not a result of this kind of study, or of this version: it tells no time.
            continue
        if converged:
            found.setdefault(kind, []).append(seconds / seeds)
    return found


def _duration(seconds: float) -> str:
    """Seconds, minutes or hours, whichever reads best."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
