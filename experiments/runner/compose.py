"""The jobs of a sweep, composed from the overrides of each.

A grid maps settings to choices in Hydra's sweep syntax and means the product of its choices. A list
of grids means their union. Settings of the command line hold for every grid and replace its own
choices.
"""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from experiments.common.config import hash_of, plain
from experiments.common.progress import PartBar
from experiments.results.published import as_configured, publish_as
from experiments.runner.jobs import HASH_DIGITS, TIME_LIMIT_S, Request
from experiments.runner.plan import Plan, earlier
from mvest.errors import ConfigurationError


def expand(
    config: DictConfig, arguments: Sequence[str], loader: ConfigLoader | None
) -> list[list[str]]:
    """The overrides of every job of a sweep, in Hydra's order.

    ``config`` is the sweep's own configuration with Hydra's part, ``arguments`` are those of the
    command line. Without a ``loader``, values cannot be taken from groups of the configuration.

    Raises a `ConfigurationError` if the sweep has no such size, no grid, or no job, and a
    `HydraException` if a line is not in Hydra's syntax, or varies a setting continuously.
    """
    parser = OverridesParser.create(config_loader=loader)
    found: list[list[str]] = []
    for grid in _grids(config):
        lines = [*(f"{key}={value}" for key, value in grid.items()), *arguments]
        overrides = parser.parse_overrides(lines)
        for one in overrides:
            if one.is_discrete_sweep() and not list(one.sweep_string_iterator()):
                raise ConfigurationError(f"{one.input_line}: nothing to choose from, so no job")
        found += BasicSweeper.split_arguments(overrides, None)[0]
    return found


def make_plan(
    config: DictConfig,
    loader: ConfigLoader,
    jobs: Sequence[Sequence[str]],
    first: int = 0,
    workers: int = 1,
) -> Plan:
    """Compose jobs from the overrides of each.

    ``config`` is the sweep's own configuration with Hydra's part, ``first`` the number of the first
    job in the sweep, and ``workers`` the number of jobs that will run at a time. Raises Hydra's and
    OmegaConf's errors if a job cannot be composed.
    """
    swept = config.hydra.sweeper.get("params") or {}
    # Unresolved, because an interpolation can be resolved only within a job.
    typed: Any = OmegaConf.to_container(config.hydra.overrides.task)
    parser = OverridesParser.create(config_loader=loader)
    varied = _varied(config, typed, jobs, parser)
    named: Any = OmegaConf.to_container(config.hydra.sweep)
    by_hash = named["subdir"] == "${config_hash:}"
    parse = cache(lambda line: parser.parse_overrides([line])[0])
    is_group = cache(lambda name: bool(loader.get_group_options(name)))
    merged: dict[tuple[str, ...], DictConfig] = {}
    planned: list[Request] = []
    with PartBar(f"{config.name}, composing", len(jobs), "job", quiet=True) as bar:
        for number, overrides in enumerate(jobs, first):
            bar.step()
            parsed = {one.get_key_element(): one for one in map(parse, overrides)}
            # Merging files takes Hydra a tenth of a second. Jobs that set the same settings share
            # the merged configuration, and only their values are set in it.
            settings = [
                one
                for one in parsed.values()
                if one.type == OverrideType.CHANGE
                and one.package is None
                and not isinstance(one.value(), dict)
                and not is_group(one.key_or_group)
            ]
            kind = tuple(
                str(one.key_or_group if one in settings else one.input_line)
                for one in parsed.values()
            )
            if kind in merged:
                for one in settings:
                    OmegaConf.update(merged[kind], one.key_or_group, one.value())
            else:
                merged[kind] = loader.load_sweep_config(config, list(overrides))
                HydraConfig.instance().set_config(merged[kind])
            composed = merged[kind]
            values = plain(composed)
            # Null removes the limit; without an override the default holds.
            if values["time_limit_s"] is None and "time_limit_s" not in parsed:
                values["time_limit_s"] = TIME_LIMIT_S
            values["factors"] = {
                **{
                    # A number, or the text that was typed.
                    key: v
                    if isinstance(v := one.value(), int | float)
                    else one.get_value_element_as_str()
                    for key, one in parsed.items()
                    if key in varied
                },
                **values["factors"],
            }
            # Equal parts are shared, so that many configurations fit into memory.
            shared = planned[0].values if planned else {}
            for key in values.keys() & shared.keys():
                # As JSON, because 1 equals 1.0.
                if json.dumps(values[key]) == json.dumps(shared[key]):
                    values[key] = shared[key]
            config_hash = hash_of(values)
            with read_write(composed.hydra), open_dict(composed.hydra):
                composed.hydra.job.id = composed.hydra.job.num = number
            subdir = config_hash[:HASH_DIGITS] if by_hash else str(composed.hydra.sweep.subdir)
            folder = Path(str(composed.hydra.sweep.dir)) / subdir
            published = publish_as(values, overrides, swept)
            planned.append(Request(values, config_hash, folder, published, tuple(overrides)))
    sweep: Any = OmegaConf.to_container(config.sweep, resolve=True)
    return Plan(
        name=str(config.name),
        folder=Path(str(config.hydra.sweep.dir)),
        sweep=sweep,
        jobs=tuple(planned),
        before=earlier(planned),
        workers=workers,
        publish=as_configured(config) if config.publish and sweep else None,
    )


def _grids(config: DictConfig) -> list[dict[str, Any]]:
    """The grids of a sweep's size, or of the sweeper's own parameters."""
    found = config.hydra.sweeper.get("params")
    if config.sweep:
        sizes = [str(key) for key, value in config.sweep.items() if OmegaConf.is_config(value)]
        size = config.sweep.get("size")
        if size not in sizes:
            raise ConfigurationError(f"sweep.size = {size!r}, expected one of {', '.join(sizes)}")
        found = config.sweep[size]
    grids: Any = [{}] if found is None else OmegaConf.to_container(found, resolve=True)
    listed = grids if isinstance(grids, list) else [grids]
    if not listed or not all(isinstance(grid, dict) for grid in listed):
        raise ConfigurationError("hydra.sweeper.params: expected a grid or a list of grids")
    return listed


def _varied(
    config: DictConfig, typed: list[str], jobs: Sequence[Sequence[str]], parser: OverridesParser
) -> set[str]:
    """Settings that are varied and become factors of the jobs.

    A sweep's own grid is left out, because its configuration names the factors itself.
    """
    swept = parser.parse_overrides(typed)
    first = set(jobs[0]) if jobs else set()
    lines = {line for overrides in jobs for line in first.symmetric_difference(overrides)}
    found = {line.lstrip("+~").partition("=")[0] for line in lines}
    found |= {one.get_key_element() for one in swept if one.is_sweep_override()}
    own = {key for grid in _grids(config) for key in grid} if config.sweep else set()
    return found - own
