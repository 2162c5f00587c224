"""The closure gate as a table: one row per variation, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from mvest.files import write_atomically
from mvest.reporting.files import provenance_line

__all__ = ["gate_text", "write_gate_tables"]

Record = Mapping[str, Any]


def _frame(record: Record) -> pd.DataFrame:
    return pd.DataFrame(record["rows"])[
        ["case", "mean_mm", "max_mm", "passed", "seconds", "reason"]
    ]


def _readable(record: Record) -> str:
    """Markdown of the table and the words around it."""
    lines = [
        "| variation | mean (mm) | max (mm) | within limits | closure time (s) |",
        "|---|---|---|---|---|",
    ]
    for row in record["rows"]:
        mean, largest = ("-" if row[k] is None else f"{row[k]:.2g}" for k in ("mean_mm", "max_mm"))
        verdict = "yes" if row["passed"] else f"no: {row['reason']}"
        lines.append(f"| {row['case']} | {mean} | {largest} | {verdict} | {row['seconds']:.0f} |")
    slopes = ", ".join(f"{100 * v:.2g} % at a step of {100 * float(k):g} %"
                       for k, v in record["slopes"].items())  # fmt: skip
    lines += [
        "",
        f"Limits: mean {record['limits']['mean_mm']} mm, maximum {record['limits']['max_mm']} mm. "
        "Where moduli change, the distance is what remains after the change that the exact "
        "derivative predicts.",
        f"Difference between the exact derivative and central differences: {slopes or 'not run'} "
        f"(limit {100 * record['limits']['slope']:g} %).",
        "The closed state is one state: **gate passed**."
        if record["passed"]
        else "**Gate not passed**.",
    ]
    return "\n".join(lines)


def gate_text(record: Record) -> str:
    """The table for the terminal."""
    return _readable(record).replace("**", "")


def write_gate_tables(folder: Path, record: Record) -> list[Path]:
    """``gate.csv`` and ``gate.md`` in ``folder``."""
    table = _frame(record)
    text = f"# {record['title']}\n\n{_readable(record)}\n\n{provenance_line(record)}\n"
    return [
        write_atomically(folder / "gate.csv", lambda path: table.to_csv(path, index=False)),
        write_atomically(folder / "gate.md", text),
    ]
