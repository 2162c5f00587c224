"""The jobs of a sweep, composed from its grids and the command line.

A grid is a mapping from settings to choices in Hydra's sweep syntax, and stands for the product of
its choices. Several grids stand for their union. What is said on the command line holds for every
grid and takes the place of a grid's own choices.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf

from experiments.common.config import hash_of, plain
from experiments.runner.jobs.folder import last_record
from experiments.runner.jobs.limits import TIME_LIMIT_S
from experiments.runner.jobs.request import Request, as_published, publish_as
from experiments.runner.planning.plan import Attempt, Plan, PlannedJob
from mvest.errors import ConfigurationError

HASH_DIGITS = 16
"""Digits of its hash by which a job's folder is named."""


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
    swept = config.hydra.sweeper.get("params") or {}
    compose = _Composer(config, loader)
    jobs: list[PlannedJob] = []
    first: dict[str, Any] = {}
    # Null takes the limit away; the default holds where nothing is said.
    limited = any(line.partition("=")[0] == "time_limit_s" for line in arguments)
    for overrides in expand(grids(config), arguments, loader):
        composed = compose(overrides)
        values = plain(composed)
        if not limited and values["time_limit_s"] is None:
            values["time_limit_s"] = TIME_LIMIT_S
        config_hash = hash_of(values)
        # Ten thousand configurations fit into memory where they share what is alike in them.
        first = first or values
        values = {
            key: first[key] if key in first and _same(first[key], value) else value
            for key, value in values.items()
        }
        folder = Path(str(composed.hydra.sweep.dir)) / config_hash[:HASH_DIGITS]
        published = publish_as(values, overrides, swept)
        jobs.append(_planned(Request(values, config_hash, folder, published), overrides))
    _require_different(jobs)
    sweep: dict[str, Any] = OmegaConf.to_container(config.sweep, resolve=True)  # type: ignore[assignment]
    return Plan(
        name=str(config.name),
        folder=Path(str(config.hydra.sweep.dir)),
        sweep=sweep,
        jobs=tuple(jobs),
        workers=_workers(config),
        publish=_as_configured(config) if config.publish and sweep else None,
    )


def plan_run(request: Request) -> Plan:
    """The plan of a run by itself."""
    job = _planned(request, HydraConfig.get().overrides.task)
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


class _Composer:
    """Composes jobs; those that choose from the same groups differ in values only.

    Hydra merges all files and schemas anew for each job, for a tenth of a second. What it merges
    follows from the choices of groups; values are set in what was merged for the job before, which
    set the same ones.
    """

    def __init__(self, config: DictConfig, loader: ConfigLoader) -> None:
        self._config, self._loader = config, loader
        parser = OverridesParser.create(config_loader=loader)
        self._parse = cache(lambda line: parser.parse_overrides([line])[0])
        self._merged: dict[tuple[str, ...], DictConfig] = {}
        self._is_group = cache(lambda key: bool(loader.get_group_options(key)))

    def __call__(self, overrides: Sequence[str]) -> DictConfig:
        """A job's configuration, which the next one may overwrite."""
        parsed = [self._parse(line) for line in overrides]
        values = [override for override in parsed if self._sets_value(override)]
        kind = tuple(str(one.key_or_group if one in values else one.input_line) for one in parsed)
        composed = self._merged.get(kind)
        if composed is None:
            composed = self._loader.load_sweep_config(self._config, list(overrides))
            HydraConfig.instance().set_config(composed)
            self._merged[kind] = composed
        else:
            for override in values:
                OmegaConf.update(composed, override.key_or_group, override.value())
        return composed

    def _sets_value(self, override: Override) -> bool:
        return (
            override.type == OverrideType.CHANGE
            and override.package is None
            # A mapping is merged with what is there.
            and not isinstance(override.value(), dict)
            and not self._is_group(override.key_or_group)
        )


def _same(one: Any, other: Any) -> bool:
    """Whether they are written alike; 1 and 1.0 are not."""
    return json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


def _as_configured(config: DictConfig) -> bool:
    """Whether a sweep is run as it is published: nothing but its size is chosen."""
    task = config.hydra.overrides.task
    changed = [line for line in task if line.startswith("sweep.")]
    sized = all(line.startswith("sweep.size=") for line in changed)
    return sized and as_published(task, None, config.study)


def _planned(request: Request, overrides: Sequence[str]) -> PlannedJob:
    record = last_record(request.folder, request.config_hash)
    return PlannedJob(
        request.config_hash,
        request.folder,
        tuple(overrides),
        request.values,
        # Of ten thousand records no more than is asked of them again.
        None if record is None else Attempt(record.reason, record.provenance.git.sha),
        record is not None and record.converged,
        request.publish_as,
    )


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
