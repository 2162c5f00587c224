"""``results/``: small records that are kept, and the tables and figures that follow from them.

A record is a run's ``result.json``. Every table is made from all records that name it, so that
tables and iterate figures can be made again from a clean checkout, without running anything.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.studies.twin.tables import write_tables
from mvest.errors import InputError
from mvest.provenance import write_json
from mvest.reporting.figures import iterates_figure, save_figure, valve_figure

__all__ = ["RECORDS", "publish", "read_record", "read_records", "regenerate"]

RECORDS = "records"
"""Folder of the kept records within the results."""

REQUIRED = ("experiment", "table", "row", "title", "parameters", "estimate", "provenance", "status")


def publish(results: Path, name: str, record: Mapping[str, Any], fields: Path) -> list[Path]:
    """Keep a record, and renew the table it belongs to and the figures of the table's main run.

    Parameters
    ----------
    results : Path
        The folder of all results; made if need be.
    name : str
        Of the record.
    record : mapping
    fields : Path
        Arrays for the picture of the valve; not kept.
    """
    try:
        (results / RECORDS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {results}: {error.strerror}") from error
    write_json(results / RECORDS / f"{name}.json", record)
    written = regenerate(results, record["table"])
    if name == record["table"] and fields.exists():
        written += save_figure(results / f"{name}_valve", valve_figure(fields), record)
    return written


def regenerate(results: Path, only: str | None = None) -> list[Path]:
    """Write every table (or one) and its iterate figure from the kept records.

    Raises
    ------
    InputError
        If there is no record, or one is damaged.
    """
    tables: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for name, record in read_records(results).items():
        tables.setdefault(record["table"], []).append((name, record))
    written = []
    for table, found in sorted(tables.items()):
        if only is not None and table != only:
            continue
        # The run that gives the table its name comes first.
        found.sort(key=lambda item: (item[0] != table, item[0]))
        records = [record for _, record in found]
        written += write_tables(results, table, records)
        if found[0][0] == table and records[0]["iterates"]:
            written += save_figure(results / table, iterates_figure(records[0]), records[0])
    return written


def read_records(results: Path) -> dict[str, dict[str, Any]]:
    """Name -> record of everything kept in ``results``.

    Raises
    ------
    InputError
        If there is none, or one is damaged.
    """
    paths = sorted((results / RECORDS).glob("*.json"))
    if not paths:
        raise InputError(
            f"{results / RECORDS} holds no record; run an experiment first, for example "
            f"python -m experiments.run experiment=table1"
        )
    return {path.stem: read_record(path) for path in paths}


def read_record(path: Path) -> dict[str, Any]:
    """A run's record.

    Raises
    ------
    InputError
        If the file cannot be read or is no record.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON: {error}") from error
    missing = [key for key in REQUIRED if not isinstance(record, dict) or key not in record]
    if missing:
        raise InputError(f"{path} is no record of a run: it lacks {', '.join(missing)}")
    return dict(record)
