"""Text and table of a case and of a virtual patient."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvest.files import write_atomically
from mvest.reporting.markup import MISSING, number

__all__ = ["case_text", "interval_words", "write_case_tables"]

Record = Mapping[str, Any]


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


def interval_words(row: Mapping[str, Any]) -> str:
    """Estimate and interval of an unknown, crossed if the truth is not in it."""
    if row["estimate"] is None:
        return MISSING
    outside = " ✗" if row.get("inside") is False else ""
    return f"{number(row['estimate'])} ({number(row['low'])} to {number(row['high'])}){outside}"


def _truth(row: Mapping[str, Any]) -> str:
    return "" if row["truth"] is None else f"  (hidden truth {number(row['truth'])})"


def write_case_tables(folder: Path, record: Record) -> list[Path]:
    """``unknowns.csv`` of one case."""
    import pandas as pd

    rows = [{key: row.get(key) for key in UNKNOWN_COLUMNS} for row in record["unknowns"]]
    return [write_atomically(folder / "unknowns.csv", pd.DataFrame(rows).to_csv(index=False))]


UNKNOWN_COLUMNS = (
    "name", "unit", "treatment", "prior_mean", "prior_std", "estimate", "std", "low", "high",
    "truth",
)  # fmt: skip
