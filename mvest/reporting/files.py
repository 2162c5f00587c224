"""Result files, each saying where it came from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvest.errors import cannot_write
from mvest.provenance import write_json

__all__ = ["keep_record", "provenance_line"]

HASH_DIGITS = 12


def provenance_line(record: Mapping[str, Any]) -> str:
    """Commit, configuration, mesh and seed of a record in one line."""
    source = record["provenance"]
    git = source["git"]
    sha = (git["sha"] or "unknown")[:HASH_DIGITS] + ("+changes" if git["dirty"] else "")
    return (
        f"{record['experiment']}: mvest {source['versions']['mvest']}, commit {sha}, "
        f"configuration {source['config_hash'][:HASH_DIGITS]}, "
        f"mesh {source['mesh_hash'][:HASH_DIGITS]}, seed {source['seed']}"
    )


def keep_record(results: Path, record: Mapping[str, Any]) -> None:
    """Write ``RESULTS/EXPERIMENT.json``, from which tables and figures come again.

    Raises
    ------
    InputError
        If the folder or the file cannot be written.
    """
    try:
        results.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(results, error) from error
    write_json(results / f"{record['experiment']}.json", record)
