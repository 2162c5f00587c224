"""Parameters of an external model as a table and a figure."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from experiments.common.records.record import Record
from experiments.studies.external.findings import Findings
from mvest.reporting.figures import iterates_figure
from mvest.reporting.markup import MISSING, markdown_rows, with_std

__all__ = ["external_table", "external_text", "external_words", "iterates"]


def external_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per parameter."""
    findings = record.findings
    absent = [None] * len(findings.initial)
    return pd.DataFrame(
        {
            "parameter": record.parameters,
            "unit": findings.units,
            "prior_mean": findings.initial,
            "prior_std": findings.prior_std,
            "estimate": findings.estimate or absent,
            "std": findings.std or absent,
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
    findings, program = record.findings, record.findings.program
    derivatives = "of the program" if program.own_jacobian else "differences of its predictions"
    lines = [
        record.reason + (f" ({record.detail})" if record.detail else "") + ".",
        f"{findings.iterations} iterations, {record.forward_solves} predictions; the program "
        f"ran {program.runs} times in {program.seconds:.3g} s, {program.reused} finished "
        "runs served again.",
        f"Derivatives: {derivatives}.",
    ]
    if findings.distance_mm is not None:
        lines.append(
            f"Distance of the {program.points} points from where they were observed: mean "
            f"{findings.distance_mm.mean:.3g} mm, largest {findings.distance_mm.max:.3g} mm."
        )
    if findings.innovation is not None:
        low, high = findings.innovation.nis_band
        lines.append(
            f"Innovation in units of what model, prior and noise explain: "
            f"{findings.innovation.nis:.4g}, expected between {low:.4g} and {high:.4g}."
        )
    return "\n\n".join(lines)


def external_text(record: Record[Findings]) -> str:
    """Table and words for the terminal."""
    table = pd.DataFrame(_rows(record)).to_string(index=False)
    return f"{table}\n{_words(record).replace(chr(10) * 2, chr(10))}"


def external_words(record: Record[Findings]) -> str:
    """Table and words as Markdown."""
    return f"{markdown_rows(_rows(record))}\n\n{_words(record)}"


def iterates(record: Record[Findings]) -> Figure | None:
    """How the estimate came about."""
    findings = record.findings
    title = f"{record.title}: {record.row}"
    if not findings.iterates:
        return None
    return iterates_figure(title, record.parameters, findings.iterates, findings.iterate_std)
