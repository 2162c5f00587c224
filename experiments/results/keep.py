"""``results/records``: kept records, and the tables and figures that follow from them.

``results/records/TABLE/NAME.json`` is the record ``NAME`` of the table ``TABLE``, beside it what
figures need of the run's arrays, if anything.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from experiments.common.records.record import FIELDS, Record, read_record, write_record
from experiments.common.study import Study, load_study
from mvest.errors import InputError, cannot_write
from mvest.files import write_atomically
from mvest.reading.json_file import read_mapping

__all__ = ["RECORDS", "arrays_of", "publish", "records_of", "regenerate"]

RECORDS = "records"
"""Folder of the kept records within the results."""


def arrays_of(folder: Path, name: str) -> dict[str, Path]:
    """Name -> arrays of the run in a folder, if it left any."""
    path = folder / FIELDS
    return {name: path} if path.is_file() else {}


def publish(
    study: Study[Any, Any], results: Path, runs: Mapping[str, tuple[Record[Any], Path]]
) -> list[Path]:
    """Keep records of one table, and renew it.

    Parameters
    ----------
    study : Study
    results : Path
        The folder of all results; made if need be.
    runs : mapping
        Name -> record and output folder of each run, at least one.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    (table,) = {record.table for record, _ in runs.values()}
    place = results / RECORDS / table
    arrays: dict[str, Path] = {}
    try:
        place.mkdir(parents=True, exist_ok=True)
        # Jobs of one experiment end in several processes at once.
        with FileLock(results / f".{table}.lock"):
            for name, (record, folder) in runs.items():
                own = arrays_of(folder, name)
                kept = study.keep_arrays(record, own[name]) if own else {}
                if kept:
                    write_atomically(place / f"{name}.npz", partial(np.savez_compressed, **kept))
                write_record(place / f"{name}.json", study.keep(record))
                arrays |= own
            records = _read(place, study.findings)
            return study.write(results, records, _arrays(place) | arrays)
    except OSError as error:
        raise cannot_write(place, error) from error


def regenerate(results: Path) -> list[Path]:
    """Write every table and figure again that follows from kept records.

    Raises
    ------
    InputError
        If there is no record, or one is damaged or not as it was written.
    """
    places = sorted({path.parent for path in (results / RECORDS).glob("*/*.json")})
    if not places:
        raise InputError(
            f"{results / RECORDS} holds no record; run an experiment first, for example "
            "python -m experiments.run experiment=table1"
        )
    written: list[Path] = []
    for place in places:
        first = next(iter(sorted(place.glob("*.json"))))
        study = load_study(str(read_mapping(first).get("study")))
        written += study.write(results, _read(place, study.findings), _arrays(place))
    return written


def records_of(results: Path, table: str, findings: type) -> dict[str, Record[Any]]:
    """Name -> kept record of a table, the one of its name first; empty if there is none.

    Raises
    ------
    InputError
        If one is damaged.
    """
    return _read(results / RECORDS / table, findings)


def _read(place: Path, findings: type) -> dict[str, Record[Any]]:
    """The records of a table by name; the one that has the table's name comes first."""
    paths = sorted(place.glob("*.json"), key=lambda path: (path.stem != place.name, path.stem))
    return {path.stem: read_record(path, findings) for path in paths}


def _arrays(place: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(place.glob("*.npz"))}
