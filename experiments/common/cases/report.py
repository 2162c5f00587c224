"""Text, table and page of a case and of a virtual patient."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments.common.cases.findings import Findings
from experiments.common.cases.own_case import FIELDS
from experiments.common.records.record import Record
from mvest.files import write_atomically
from mvest.problem.verdict import NONE
from mvest.reporting.case.findings import CaseFindings, FrameDistances, UnknownRow
from mvest.reporting.markup import MISSING, ended, number

__all__ = [
    "case_text",
    "estimation_text",
    "interval_words",
    "write_case_run",
    "write_cases",
]


def case_text(record: Record[Findings]) -> str:
    """What a finished case says on the terminal."""
    case = record.findings.case
    title = f"{case.about.name}: {record.reason}"
    verdict = case.verdict
    if verdict is None:
        return estimation_text(title, case.unknowns, case.distances)
    lines = [f"{case.about.name}: {verdict.trust.upper()} ({len(verdict.passed)} checks passed)"]
    lines += [f"  {ended(ground.text)} Next: {ground.advice}" for ground in verdict.grounds]
    if verdict.trust == NONE:
        lines.append(f"  No modulus is stated; the run ended: {record.reason}")
        return estimation_text("\n".join(lines), (), case.distances)
    lines.append(title)
    return estimation_text("\n".join(lines), case.unknowns, case.distances)


def estimation_text(
    title: str, unknowns: Sequence[UnknownRow], distances: Sequence[FrameDistances]
) -> str:
    """Unknowns and distances, a line each."""
    lines = [title]
    for row in unknowns:
        value = f"  {row.label:28s} {interval_words(row)} {row.unit}".rstrip()
        truth = "" if row.truth is None else f"  (hidden truth {number(row.truth)})"
        lines.append(value + truth)
    for one in distances:
        lines.append(
            f"  frame {one.frame}{'' if one.seen else ' (not shown to the filter)'}: "
            f"{one.generic.mean:.2f} mm generic, {one.registered.mean:.2f} registered, "
            f"{one.personalised.mean:.2f} personalised"
        )
    return "\n".join(lines)


def interval_words(row: UnknownRow) -> str:
    """Estimate and interval of an unknown, crossed if the truth is not in it."""
    if row.estimate is None:
        return MISSING
    outside = " ✗" if row.inside is False else ""
    return f"{number(row.estimate)} ({number(row.low)} to {number(row.high)}){outside}"


def write_cases(
    folder: Path, records: Mapping[str, Record[Findings]], _arrays: Mapping[str, Path]
) -> list[Path]:
    """Table and page of each case."""
    return [path for record in records.values() for path in write_case_run(folder, record)]


def write_case_run(
    folder: Path, record: Record[Any], case: CaseFindings | None = None
) -> list[Path]:
    """``unknowns.csv`` of a record's case, or of another, and its page where there are arrays."""
    import pandas as pd

    from mvest.reporting.case.report import write_case_report

    case = case or record.findings.case
    rows = pd.DataFrame([asdict(row) for row in case.unknowns], columns=UNKNOWN_COLUMNS)
    written = [write_atomically(folder / "unknowns.csv", rows.to_csv(index=False))]
    fields = folder / FIELDS
    if fields.is_file():
        source = asdict(record.provenance)
        written += write_case_report(folder, case, fields, record.line, source)
    return written


UNKNOWN_COLUMNS = [
    "name", "unit", "treatment", "prior_mean", "prior_std", "estimate", "std", "low", "high",
    "truth",
]  # fmt: skip
