"""The published results: which runs are published, their records, and what follows from these.

``results/records/TABLE.jsonl`` holds the records of a table, one a line, and
``results/records/TABLE/NAME.npz`` the arrays that figures need. A run is published only if it was
run as it is configured.
"""

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from omegaconf import DictConfig

from experiments.common.config import is_hashed
from experiments.common.records.record import FIELDS, Record, record_from, sealed_record
from experiments.common.records.writer import write_results
from experiments.common.study import Results, Study, load_study
from experiments.sweeps.collected import SWEEPS, Sweep, read_sweeps, write_sweep_file
from experiments.sweeps.report import write_sweep
from mvest.errors import InputError, cannot_write
from mvest.files import write_atomically
from mvest.reading.documents import parse_json

RECORDS = "records"  # folder of the records within the results


def publish_as(
    values: Mapping[str, Any], overrides: Sequence[str], swept: Mapping[str, Any] | None
) -> str | None:
    """Name of a run's record in the results; None: do not publish it.

    ``swept`` are the settings that the experiment itself varies if this is one run of several.
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
    """Whether no override changes the result of the experiment as configured."""
    allowed = {"experiment", "hydra", *(swept or {})}
    keys = (override.lstrip("+~").partition("=")[0] for override in overrides)
    return all({key, key.partition(".")[0]} & allowed or not is_hashed(key, study) for key in keys)


def as_configured(config: DictConfig) -> bool:
    """Whether nothing but the size of a sweep is overridden."""
    task = config.hydra.overrides.task
    changed = [line for line in task if line.startswith("sweep.")]
    sized = all(line.startswith("sweep.size=") for line in changed)
    return sized and as_published(task, None, config.study)


def publish_runs(runs: Iterable[tuple[str | None, Record | None, Path, Path]]) -> None:
    """Publish runs: name (None: do not publish), record, folder, and folder of the results.

    Raises an `InputError` if a file cannot be written.
    """
    groups: dict[tuple[Path, str, str], dict[str, tuple[Record, Path]]] = {}
    for name, record, folder, results in runs:
        if name and record and (record.converged or load_study(record.study).keeps_failures):
            group = results, record.study, record.table
            groups.setdefault(group, {})[name] = record, folder
    for (results, study, table), named in groups.items():
        publish(load_study(study), results, table, named)
        print(f"Results in {results}")


def publish_sweep(results: Path, sweep: Sweep) -> None:
    """Publish a sweep; raises an `InputError` if a file cannot be written."""
    folder = results / SWEEPS
    folder.mkdir(parents=True, exist_ok=True)
    write_sweep_file(folder / f"{sweep.name}.json", sweep)
    write_sweep(results, sweep)
    print(f"Results in {results}")


def arrays_of(folder: Path, name: str) -> dict[str, Path]:
    """Name -> file of arrays of the run in a folder, if there is one."""
    path = folder / FIELDS
    return {name: path} if path.is_file() else {}


def publish(
    study: Study[Any],
    results: Path,
    table: str,
    runs: Mapping[str, tuple[Record, Path]],
    gone: Collection[str] = (),
) -> list[Path]:
    """Publish records of a table, remove those that are ``gone``, and write what follows again.

    ``runs`` maps names to record and output folder; the folder of all results is made if missing.

    Raises an `InputError` if a file cannot be written.
    """
    place = results / RECORDS
    arrays: dict[str, Path] = {}
    try:
        place.mkdir(parents=True, exist_ok=True)
        # Several processes may publish at the same time.
        with FileLock(results / f".{table}.lock"):
            before = records_of(results, table).records
            records = {name: record for name, record in before.items() if name not in gone}
            for name in gone:
                _arrays(results, table, name).unlink(missing_ok=True)
            for name, (record, folder) in runs.items():
                own = arrays_of(folder, name)
                stored = study.keep_arrays(record, own[name]) if own else {}
                if stored:
                    (place / table).mkdir(exist_ok=True)
                    path = _arrays(results, table, name)
                    write_atomically(path, partial(np.savez_compressed, **stored))
                records[name] = study.keep(record)
                arrays |= own
            write_records(results, table, records)
            published = records_of(results, table)
            shown = Results(published.records, {**published.arrays, **arrays})
            return write_results(results, study, shown)
    except OSError as error:
        raise cannot_write(place, error) from error


def regenerate(results: Path) -> list[Path]:
    """Write every table, figure and page of published records and sweeps again.

    Raises an `InputError` if there is no record, or one is damaged or was changed.
    """
    paths = sorted((results / RECORDS).glob("*.jsonl"))
    sweeps = read_sweeps(results)
    if not paths and not sweeps:
        raise InputError(
            f"{results / RECORDS} holds no record; run an experiment first, for example "
            "mvest run experiment=table1"
        )
    from experiments.results.quoted import requote

    written: list[Path] = []
    for path in paths:
        found = records_of(results, path.stem)
        written += write_results(results, load_study(found.first.study), found)
    for sweep in sweeps:
        written += write_sweep(results, sweep)
    return [*written, *requote(results.resolve().parent / "README.md", results)]


def records_of(results: Path, table: str) -> Results:
    """The published records of a table, if any, the one of its name first; checks them."""
    path = results / RECORDS / f"{table}.jsonl"
    records = {}
    for k, line in enumerate(path.read_bytes().splitlines() if path.is_file() else ()):
        data = parse_json(line, f"{path}, line {k + 1}")
        name = str(data.get("name"))
        where = f"{path}, record {name}"
        records[name] = record_from(data.get("record") or {}, where, _arrays(results, table, name))
    order = sorted(records, key=lambda name: (name != table, name))
    arrays = {name: _arrays(results, table, name) for name in order}
    own = {name: place for name, place in arrays.items() if place.is_file()}
    return Results({name: records[name] for name in order}, own)


def write_records(results: Path, table: str, records: Mapping[str, Record]) -> Path:
    """Write the records of a table, with digests of them and of their arrays, sorted by name."""
    lines = [
        json.dumps(
            {"name": name, "record": sealed_record(record, _arrays(results, table, name))},
            ensure_ascii=False,
            separators=(",", ":"),
        )
        for name, record in sorted(records.items())
    ]
    return write_atomically(results / RECORDS / f"{table}.jsonl", "\n".join([*lines, ""]))


def _arrays(results: Path, table: str, name: str) -> Path:
    return results / RECORDS / table / f"{name}.npz"
