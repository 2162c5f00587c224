"""What the results keep of moduli from simulated volumes, and the table of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from experiments.common.cases.skill import Answered, skill_words
from experiments.common.plain import Plain, flat
from experiments.common.record import Record
from experiments.studies.imaged_patient.tables import write_volume_tables

__all__ = ["kept_of_volume", "volumes_answer", "write_volumes"]

KEPT = ("rows", "unknowns", "known_geometry", "image_errors")


def volumes_answer(records: Mapping[str, Record[Plain]]) -> str:
    """How good moduli from volumes are, in one line."""
    answered = []
    for record in records.values():
        generic = {row["name"]: row["prior_mean"] for row in record.findings["unknowns"]}
        answered += [
            Answered(
                row["truth"], row["estimate"], row["low"], row["high"],
                generic[f"E_f.{row['modulus']}"],
            )
            for row in record.findings["rows"]
        ]  # fmt: skip
    return f"{len(records)} simulated volumes: {skill_words(answered)}"


def kept_of_volume(record: Record[Plain]) -> Record[Plain]:
    """What the table needs of a record, and what else was estimated."""
    return replace(record, findings={key: record.findings.get(key) for key in KEPT})


def write_volumes(
    folder: Path, records: Mapping[str, Record[Plain]], _arrays: Mapping[str, Path]
) -> list[Path]:
    """The table of all volumes."""
    rows = [row for record in records.values() for row in record.findings["rows"]]
    return write_volume_tables(folder, {**flat(list(records.values())[-1]), "rows": rows})
