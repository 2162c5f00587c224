"""The closure gate as a table: one row per variation, and the verdict."""

from __future__ import annotations

from dataclasses import asdict

import pandas as pd

from experiments.common.record import Record
from experiments.studies.gate.findings import Findings

__all__ = ["gate_answer", "gate_table", "gate_words"]


def gate_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per variation."""
    return pd.DataFrame(map(asdict, record.findings.rows))


def gate_answer(record: Record[Findings]) -> str:
    """Whether the closed valve depends on how it was computed."""
    found = record.findings
    failed = [row.case for row in found.rows if not row.passed]
    largest = max((row.max_mm for row in found.rows if row.max_mm is not None), default=0.0)
    return (
        f"The closed state of the default valve under {len(found.rows) - 1} variations of numerics "
        f"and moduli: no vertex more than {largest:.2g} mm from where it should be; gate "
        + ("passed." if found.passed else f"NOT passed ({', '.join(failed) or 'slope'}).")
    )


def gate_words(record: Record[Findings]) -> str:
    """Markdown of the table and the words around it."""
    found = record.findings
    lines = [
        "| variation | mean (mm) | max (mm) | within limits | closure time (s) |",
        "|---|---|---|---|---|",
    ]
    for row in found.rows:
        mean, largest = ("-" if v is None else f"{v:.2g}" for v in (row.mean_mm, row.max_mm))
        verdict = "yes" if row.passed else f"no: {row.reason}"
        lines.append(f"| {row.case} | {mean} | {largest} | {verdict} | {row.seconds:.0f} |")
    slopes = ", ".join(
        f"{100 * difference:.2g} % at a step of {100 * float(step):g} %"
        for step, difference in found.slopes.items()
    )
    lines += [
        "",
        f"Limits: mean {found.limits.mean_mm} mm, maximum {found.limits.max_mm} mm. "
        "Where moduli change, the distance is what remains after the change that the exact "
        "derivative predicts.",
        f"Difference between the exact derivative and central differences: {slopes or 'not run'} "
        f"(limit {100 * found.limits.slope:g} %).",
        "The closed state is one state: **gate passed**."
        if found.passed
        else "**Gate not passed**.",
    ]
    return "\n".join(lines)
