"""What a sweep will run: its jobs, which of them are done, and how long the others will take.

A grid is a mapping from settings to choices in Hydra's sweep syntax, and stands for the product of
its choices. Several grids stand for their union. What is said on the command line holds for every
grid and takes the place of a grid's own choices.
"""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from experiments.common.config import hash_of, plain
from experiments.common.record import Record, model_of_values, read_data
from experiments.runner.compared import Compared, compared, last_compared
from experiments.runner.folder import RESULT
from experiments.runner.request import Request
from mvest.errors import ConfigurationError, InputError
from mvest.provenance import git_state, write_json

__all__ = ["PLAN", "Plan", "PlannedJob", "expand", "grids", "make_plan", "plan_run"]

PLAN = "plan.json"
"""File in a sweep's folder with the jobs that it consists of."""

MAX_READ = 500
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
    record : Record or None
        What an earlier attempt recorded.
    done : bool
    """

    config_hash: str
    folder: Path
    overrides: tuple[str, ...]
    values: dict[str, Any]
    record: Record[Compared] | None
    done: bool

    @property
    def label(self) -> str:
        """What sets the job apart, for a line of text."""
        return ", ".join(_texts(self.values["factors"])) or " ".join(self.overrides)


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
        created = time.gmtime()
        jobs = [
            {
                "hash": job.config_hash[:16],
                "folder": os.path.relpath(job.folder, self.folder),
                "name": name,
                "overrides": list(job.overrides),
                "factors": job.values["factors"],
                "row": job.values["row"],
                "repeats": job.values.get("repeats", 1),
            }
            for job, name in zip(self.jobs, self.names(), strict=True)
        ]
        sweep_id = f"{time.strftime('%Y%m%d-%H%M%S', created)}-{uuid.uuid4().hex[:4]}"
        try:
            before = json.loads((self.folder / PLAN).read_text(encoding="utf-8"))
            # The same jobs, perhaps with more of them, are the same sweep that goes on.
            if {job["hash"] for job in before["jobs"]} <= {job["hash"] for job in jobs}:
                sweep_id = before["sweep_id"]
        except (OSError, ValueError, KeyError):
            # The first sweep here.
            pass
        write_json(
            self.folder / PLAN,
            {
                "sweep": self.sweep.get("name", self.name),
                "size": self.sweep.get("size"),
                "sweep_id": sweep_id,
                "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", created),
                "jobs": jobs,
            },
        )

    def names(self) -> list[str]:
        """What sets each job apart from all others, in a few words."""
        factors = [_texts(job.values["factors"]) for job in self.jobs]
        shared = set(factors[0]).intersection(*factors)
        found = [", ".join(text for text in texts if text not in shared) for texts in factors]
        alike: dict[str, list[PlannedJob]] = {}
        for name, job in zip(found, self.jobs, strict=True):
            alike.setdefault(name, []).append(job)
        names = []
        for name, job in zip(found, self.jobs, strict=True):
            common = set(job.overrides).intersection(*(other.overrides for other in alike[name]))
            own = [line for line in job.overrides if line not in common]
            names.append(", ".join(filter(None, [name, *own])) or str(job.values["row"]))
        return names

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
            + (f"  [failed before: {job.record.reason}]" if job.record and not job.done else "")
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
            if (kind := json.dumps(asdict(model_of_values(job.values)))) in spent
        ]
        if not times:
            return "time unknown: no job of this kind has finished yet"
        total = _duration(fmean(times) * len(left) / min(self.workers, len(left)))
        rest = f" (from {len(times)} of a known kind)" if len(times) < len(left) else ""
        return f"about {total}, {self.workers} at a time{rest}"

    def _stale(self) -> str:
        """A remark on results that other code than the present one computed."""
        present = git_state(Path(__file__).resolve().parent)["sha"]
        commits = [job.record.provenance.git.sha for job in self.jobs if job.done and job.record]
        other = sum(sha != present for sha in commits)
        return f" ({other} of the done ones by another commit; force=true redoes)" if other else ""


def make_plan(config: DictConfig, loader: ConfigLoader, arguments: Sequence[str]) -> Plan:
    """Compose every job of a sweep, in Hydra's order.

    Parameters
    ----------
    config : DictConfig
        The sweep's own configuration, with Hydra's part.
    loader : ConfigLoader
    arguments : sequence of str
        Of the command line.

    Raises
    ------
    ConfigurationError
        If the sweep has no such size, or two jobs are one and the same.
    HydraException, OmegaConfBaseException
        If a job cannot be composed.
    """
    jobs: list[PlannedJob] = []
    for overrides in expand(grids(config), arguments, loader):
        composed = loader.load_sweep_config(config, overrides)
        HydraConfig.instance().set_config(composed)
        place = Path(str(composed.hydra.sweep.dir)) / str(composed.hydra.sweep.subdir)
        jobs.append(_planned(plain(composed), hash_of(composed), place, overrides))
    _require_different(jobs)
    sweep: dict[str, Any] = OmegaConf.to_container(config.sweep, resolve=True)  # type: ignore[assignment]
    folder = Path(str(config.hydra.sweep.dir))
    return Plan(str(config.name), folder, sweep, tuple(jobs), _workers(config))


def plan_run(request: Request) -> Plan:
    """The plan of a run by itself."""
    overrides = tuple(HydraConfig.get().overrides.task)
    job = _planned(request.values, request.config_hash, request.folder, overrides)
    return Plan(str(request.values["name"]), request.folder.parent, {}, (job,), 1)


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
        # What comes later takes the place of what was said before of the same setting.
        choices = {
            override.get_key_element(): _choices(override)
            for override in parser.parse_overrides([*lines, *arguments])
        }
        found += [list(job) for job in product(*choices.values())]
    return found


def grids(config: DictConfig) -> list[dict[str, Any]]:
    """The grids that a sweep's size, or the sweeper's own parameters, stand for.

    Raises
    ------
    ConfigurationError
        If the sweep has no such size, or what it has there is no grid.
    """
    found = config.hydra.sweeper.get("params")
    if config.sweep:
        sizes = [str(key) for key, value in config.sweep.items() if OmegaConf.is_config(value)]
        size = config.sweep.get("size")
        if size not in sizes:
            raise ConfigurationError(f"sweep.size = {size!r}, expected one of {', '.join(sizes)}")
        found = config.sweep[size]
    if found is None:
        return [{}]
    plain_grids: Any = OmegaConf.to_container(found, resolve=True)
    listed = plain_grids if isinstance(plain_grids, list) else [plain_grids]
    if not listed or not all(isinstance(grid, dict) for grid in listed):
        raise ConfigurationError("hydra.sweeper.params: expected a grid or a list of grids")
    return listed


def _choices(override: Override) -> list[str]:
    """What a line of Hydra's sweep syntax stands for, one override each."""
    key = override.get_key_element()
    if not override.is_sweep_override():
        return [f"{key}={override.get_value_element_as_str()}"]
    if not override.is_discrete_sweep():
        kind = override.value_type.name if override.value_type else "unknown"
        raise ConfigurationError(
            f"{override.input_line}: a plan does not support sweep type {kind}"
        )
    return [f"{key}={value}" for value in override.sweep_string_iterator()]


def _planned(
    values: dict[str, Any], config_hash: str, folder: Path, overrides: Sequence[str]
) -> PlannedJob:
    record = last_compared(folder, config_hash)
    done = record is not None and record.converged
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
    for place in places[:MAX_READ]:
        try:
            record = compared(read_data(place), str(place))
        except InputError:
            # Not a result of this version: it tells no time.
            continue
        if record.converged and record.model is not None:
            seconds = record.seconds_total / len(record.findings.repeats)
            found.setdefault(json.dumps(asdict(record.model)), []).append(seconds)
    return found


def _texts(factors: Mapping[str, Any]) -> list[str]:
    return [f"{name}={value}" for name, value in factors.items()]


def _duration(seconds: float) -> str:
    """Seconds, minutes or hours, whichever reads best."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
