"""Writing result files whole or not at all, each saying where it came from."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mvest.errors import cannot_write
from mvest.provenance import write_json

__all__ = ["keep_record", "provenance_line", "write_text", "write_with"]

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


def write_with(path: Path, write: Callable[[Path], None]) -> Path:
    """Let ``write`` make a temporary file beside ``path``, which then takes its name in one step.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    temporary = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")
    try:
        try:
            write(temporary)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error
    return path


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text, whole or not at all."""
    return write_with(path, lambda temporary: _write(temporary, text))


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


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
