"""Whether and how the results take over what was run: only what was run as it is configured."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from experiments.common.config import is_hashed
from experiments.common.records.record import Record
from experiments.common.study import load_study
from experiments.results.keep import publish
from experiments.sweeps.collected import SWEEPS, Sweep, write_sweep_file
from experiments.sweeps.report import write_sweep


def publish_as(
    values: Mapping[str, Any], overrides: Sequence[str], swept: Mapping[str, Any] | None
) -> str | None:
    """Name of a run's record in the results; None where they are not to be touched.

    ``swept`` is what the experiment itself varies (empty: nothing) if this is one run of several.
    """
    # A sweep is published as a whole.
    published = values["publish"] and not values["sweep"]
    if not published or not as_published(overrides, swept, values["study"]):
        return None
    if swept is None:
        return str(values["name"])
    return re.sub(r"[^a-z0-9]+", "-", f"{values['name']} {values['row']}".lower()).strip("-")


def as_published(
    overrides: Sequence[str], swept: Mapping[str, Any] | None, study: str | None
) -> bool:
    """Whether a run is its experiment as configured: nothing overridden that changes the result."""
    allowed = {"experiment", "hydra", *(swept or {})}
    keys = (override.lstrip("+~").partition("=")[0] for override in overrides)
    return all({key, key.partition(".")[0]} & allowed or not is_hashed(key, study) for key in keys)


def as_configured(config: DictConfig) -> bool:
    """Whether a sweep is run as it is published: nothing but its size is chosen."""
    task = config.hydra.overrides.task
    changed = [line for line in task if line.startswith("sweep.")]
    sized = all(line.startswith("sweep.size=") for line in changed)
    return sized and as_published(task, None, config.study)


def publish_run(values: Mapping[str, Any], record: Record, folder: Path, name: str | None) -> None:
    """Let the results take over a run, by a name; None: it has overrides, which is said.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    results = Path(values["paths"]["results"])
    if name is None and values["publish"] and not values["sweep"]:
        print(f"{results} left as it is: this run has overrides")
    publish_runs([(name, record, folder, results)])


def publish_runs(runs: Iterable[tuple[str | None, Record | None, Path, Path]]) -> None:
    """Let the results take over the runs of a sweep that have records of their own there.

    Parameters
    ----------
    runs : iterable of tuple
        Name (None: the results are not to be touched), record, folder, and folder of the results.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    groups: dict[tuple[Path, str, str], dict[str, tuple[Record, Path]]] = {}
    for name, record, folder, results in runs:
        if name and record and (record.converged or load_study(record.study).keeps_failures):
            group = results, record.study, record.table
            groups.setdefault(group, {})[name] = record, folder
    for (results, study, _), named in groups.items():
        publish(load_study(study), results, named)
        print(f"Results in {results}")


def publish_sweep(results: Path, sweep: Sweep) -> None:
    """Let the results take over a sweep.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    folder = results / SWEEPS
    folder.mkdir(parents=True, exist_ok=True)
    write_sweep_file(folder / f"{sweep.name}.json", sweep)
    write_sweep(results, sweep)
    print(f"Results in {results}")
