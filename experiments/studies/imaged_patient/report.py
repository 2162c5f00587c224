"""Moduli from simulated volumes: text and pages of a run, and the table of all of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from experiments.common.cases.blind import ESTIMATE, read_estimate
from experiments.common.cases.report import estimation_text, write_case_run
from experiments.common.cases.skill import skill_words
from experiments.common.records.record import Record
from experiments.studies.imaged_patient.budget import write_budget
from experiments.studies.imaged_patient.findings import KNOWN, SEGMENTED, Findings
from experiments.studies.imaged_patient.tables import write_volume_tables
from mvest.reporting.case.findings import UnknownRow

__all__ = ["moduli_of_volumes", "volume_text", "volumes_answer", "write_run", "write_volumes"]


def volume_text(record: Record[Findings]) -> str:
    """What a finished run says on the terminal."""
    findings = record.findings
    title = f"{record.row}: {record.reason}"
    return estimation_text(title, findings.unknowns, findings.distances)


def moduli_of_volumes(records: Iterable[Record[Findings]]) -> list[UnknownRow]:
    """The modulus of each leaflet of each patient, as it is stated."""
    return [row.as_stated for record in records for row in record.findings.rows]


def volumes_answer(records: Mapping[str, Record[Findings]]) -> str:
    """How good moduli from volumes are, in one line."""
    words = skill_words(moduli_of_volumes(records.values()))
    return f"{len(records)} simulated volumes: {words}"


def write_run(folder: Path, record: Record[Findings]) -> list[Path]:
    """Table and page of both estimations, as far as they left something."""
    return [
        path
        for place in (folder, folder / SEGMENTED, folder / KNOWN)
        if (place / ESTIMATE).is_file()
        for path in write_case_run(place, record, read_estimate(place).findings.case)
    ]


def write_volumes(
    folder: Path, records: Mapping[str, Record[Findings]], _arrays: Mapping[str, Path]
) -> list[Path]:
    """The table of all volumes, and what costs them how much of the moduli."""
    last = list(records.values())[-1]
    rows = [row for record in records.values() for row in record.findings.rows]
    first = rows[0].modulus
    budgets = {record.row: record.findings.budget for record in records.values()}
    return [
        *write_volume_tables(
            folder / last.table,
            rows,
            last.line,
            [record.findings.chord_ratios for record in records.values()],
        ),
        *write_budget(
            folder / f"{last.table}_budget", budgets, first.prior_std / first.prior_mean, last.line
        ),
    ]
