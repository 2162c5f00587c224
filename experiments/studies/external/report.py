"""Parameters of an external model as a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from experiments.common.record import Record
from experiments.common.report import write_report
from experiments.studies.external.findings import Findings
from mvest.reporting.figures import iterates_figure, save_figure_with
from mvest.reporting.markup import MISSING, markdown_rows, with_std

__all__ = ["external_table", "external_text", "write_external"]


def external_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per parameter."""
    found = record.findings
    absent = [None] * len(found.initial)
    return pd.DataFrame(
        {
            "parameter": record.parameters,
            "unit": found.units,
            "prior_mean": found.initial,
            "prior_std": found.prior_std,
            "estimate": found.estimate or absent,
            "std": found.std or absent,
        }
    )


def _rows(record: Record[Findings]) -> list[dict[str, str]]:
    return [
        {
            "parameter": row["parameter"],
            "unit": row["unit"] or MISSING,
            "prior": with_std(row["prior_mean"], row["prior_std"]),
            "estimate": with_std(row["estimate"], row["std"]),
        }
        for row in external_table(record).to_dict("records")
    ]


def _words(record: Record[Findings]) -> str:
    """What is to be said below the table."""
    found, program = record.findings, record.findings.program
    derivatives = "of the program" if program.own_jacobian else "differences of its predictions"
    lines = [
        record.reason + (f" ({record.detail})" if record.detail else "") + ".",
        f"{found.iterations} iterations, {record.forward_solves} predictions; the program "
        f"ran {program.runs} times in {program.seconds:.3g} s, {program.reused} finished "
        "runs served again.",
        f"Derivatives: {derivatives}.",
    ]
    if found.distance_mm is not None:
        lines.append(
            f"Distance of the {program.points} points from where they were observed: mean "
            f"{found.distance_mm.mean:.3g} mm, largest {found.distance_mm.max:.3g} mm."
        )
    if found.innovation is not None:
        low, high = found.innovation.nis_band
        lines.append(
            f"Innovation in units of what model, prior and noise explain: "
            f"{found.innovation.nis:.4g}, expected between {low:.4g} and {high:.4g}."
        )
    return "\n\n".join(lines)


def external_text(record: Record[Findings]) -> str:
    """Table and words for the terminal."""
    table = pd.DataFrame(_rows(record)).to_string(index=False)
    return f"{table}\n{_words(record).replace(chr(10) * 2, chr(10))}"


def write_external(
    folder: Path, records: Mapping[str, Record[Findings]], _arrays: Mapping[str, Path]
) -> list[Path]:
    """Table, words and the figure of the iterates of each record."""
    written = []
    for record in records.values():
        found = record.findings
        words = f"{markdown_rows(_rows(record))}\n\n{_words(record)}"
        written += write_report(folder, record, external_table(record), words)
        if found.iterates:
            figure = iterates_figure(
                f"{record.title}: {record.row}",
                record.parameters,
                found.iterates,
                found.iterate_std,
            )
            written += save_figure_with(folder / "iterates", figure, record.line)
    return written
