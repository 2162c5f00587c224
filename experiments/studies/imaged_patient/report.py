"""Records of moduli from simulated volumes in the results, and the table of all of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock

from experiments.studies.imaging.tables import write_volume_tables
from mvest.errors import cannot_write
from mvest.provenance import write_json

__all__ = ["publish_volume"]

FOLDER = "volume"
"""Of the records in the results; the table beside it has the same name."""

KEPT = ("status", "reason", "rows", "unknowns", "known_geometry", "image_errors", "provenance")


def publish_volume(results: Path, name: str, record: Mapping[str, Any]) -> list[Path]:
    """Keep the record of a patient, and renew the table of all.

    Parameters
    ----------
    results : Path
    name : str
        Of the record.
    record : mapping
        With ``rows`` as for `experiments.studies.imaging.tables.volume_table`.
    """
    folder = results / FOLDER
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Jobs of one experiment end in several processes at once.
        with FileLock(results / f".{FOLDER}.lock"):
            write_json(folder / f"{name}.json", {key: record.get(key) for key in KEPT})
            kept = [json.loads(file.read_text("utf-8")) for file in sorted(folder.glob("*.json"))]
            whole = {**record, "rows": [row for one in kept for row in one["rows"]]}
            write_json(
                results / f"{FOLDER}.json",
                {
                    key: whole.get(key)
                    for key in ("schema", "experiment", "title", "rows", "provenance")
                },
            )
            return write_volume_tables(results, whole)
    except OSError as error:
        raise cannot_write(folder, error) from error
