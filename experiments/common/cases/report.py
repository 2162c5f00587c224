"""What is told and kept of a case and of a virtual patient."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock

from experiments.common.cases.tables import (
    PATIENTS,
    POPULATION,
    Record,
    interval_words,
    write_patient_tables,
)
from experiments.studies.patient.population import write_population_tables
from mvest.errors import cannot_write
from mvest.files import write_atomically
from mvest.provenance import write_json
from mvest.reporting.markup import number

__all__ = ["case_text", "publish_patient", "write_case_tables"]


KEPT_ARRAYS = (
    "triangles", "region", "rest", "annulus", "free_edge", "frames", "seen", "tips", "chord_tip",
    "chord_insertion", "generic", "fitted", "distance_generic", "distance_fitted",
)  # fmt: skip
"""Arrays that Figure 3 needs."""


def case_text(record: Record) -> str:
    """What a finished case says on the terminal."""
    lines = [f"{record['case']['name']}: {record['reason']}"]
    for row in record["unknowns"]:
        lines.append(
            f"  {row['label']:28s} {interval_words(row)} {row['unit']}".rstrip() + _truth(row)
        )
    for row in record["distances"]:
        lines.append(
            f"  frame {row['frame']}{'' if row['seen'] else ' (not shown to the filter)'}: "
            f"{row['generic']['mean']:.2f} mm generic, {row['registered']['mean']:.2f} registered, "
            f"{row['personalised']['mean']:.2f} personalised"
        )
    return "\n".join(lines)


def _truth(row: Mapping[str, Any]) -> str:
    return "" if row["truth"] is None else f"  (hidden truth {number(row['truth'])})"


def write_case_tables(folder: Path, record: Record) -> list[Path]:
    """``unknowns.csv`` of one case."""
    rows = [{key: row.get(key) for key in UNKNOWN_COLUMNS} for row in record["unknowns"]]
    return [write_atomically(folder / "unknowns.csv", pd.DataFrame(rows).to_csv(index=False))]


UNKNOWN_COLUMNS = (
    "name", "unit", "treatment", "prior_mean", "prior_std", "estimate", "std", "low", "high",
    "truth",
)  # fmt: skip


def publish_patient(results: Path, name: str, record: Record, fields: Path) -> list[Path]:
    """Keep the record of a patient, and renew the tables it belongs to.

    Parameters
    ----------
    results : Path
    name : str
        Of the record.
    record : mapping
        Its ``table`` is ``patients`` or ``population``.
    fields : Path
        Arrays of the patient; what Figure 3 needs of them is kept.
    """
    folder = results / record["table"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Jobs of one experiment end in several processes at once.
        with FileLock(results / f".{record['table']}.lock"):
            write_json(folder / f"{name}.json", _kept(record))
            if record["table"] == PATIENTS and fields.is_file():
                with np.load(fields, allow_pickle=False) as stored:
                    arrays = {key: _small(stored[key]) for key in KEPT_ARRAYS if key in stored}
                np.savez_compressed(folder / f"{name}.npz", **arrays)
            write = write_patient_tables if record["table"] == PATIENTS else write_population_tables
            return write(results)
    except OSError as error:
        raise cannot_write(folder, error) from error


def _small(array: Any) -> Any:
    return array.astype(np.float32) if array.dtype == np.float64 else array


def _kept(record: Record) -> dict[str, Any]:
    """What tables need of a record; the settings are in ``conf``."""
    dropped = ("settings", "measurements") if record["table"] == POPULATION else ()
    return {key: value for key, value in record.items() if key not in dropped}
