"""The gate as one table for all anatomies: what each variation moves, jumps, gaps, the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from experiments.common.places import ANATOMIES
from experiments.common.records.record import Record
from experiments.common.records.report import percent
from experiments.studies.gate.findings import Findings, Limits
from mvest.files import write_atomically

__all__ = ["gate_answer", "gate_table", "gate_words", "write_gate"]

Records = Mapping[str, Record[Findings]]


def gate_table(records: Records) -> pd.DataFrame:
    """One row per anatomy and variation, or path along moduli."""
    return pd.DataFrame(
        [
            {
                "anatomy": record.row,
                "variation": row.case,
                "mean_mm": row.mean_mm,
                "max_mm": row.max_mm,
                "passed": row.passed,
                "seconds": row.seconds,
                "reason": row.reason,
            }
            for record in records.values()
            for row in record.findings.rows
        ]
        + [
            {
                "anatomy": record.row,
                "variation": f"along {path.along}",
                "max_mm": path.unexplained_mm,
                "share": path.share,
                "curvature": path.curvature,
                "passed": path.passed,
                "reason": path.reason,
            }
            for record in records.values()
            for path in record.findings.paths
        ]
    )


def gate_answer(records: Records) -> str:
    """Which anatomies have one closed state."""
    passed = [record.row for record in records.values() if record.findings.passed]
    failed = [record for record in records.values() if not record.findings.passed]
    said = f"Gate passed by {len(passed)} of {len(records)} anatomies"
    if passed:
        said += f" ({', '.join(passed)})"
    for record in failed:
        said += f"; NOT passed by {record.row} ({'; '.join(record.findings.failures)})"
    return said + "."


def gate_words(records: Records) -> str:
    """Markdown of the tables and the words around them."""
    first = next(iter(records.values()))
    return "\n".join(
        [
            f"**{gate_answer(records)}**",
            "",
            *_verdicts(records),
            "",
            *_variations(records),
            "",
            *_paths(records),
            "",
            _limits(first.findings.limits),
        ]
    )


def write_gate(folder: Path, records: Records, _arrays: Mapping[str, Path]) -> list[Path]:
    """Write the tables of all anatomies.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    first = next(iter(records.values()))
    base = folder / first.table
    table = gate_table(records)
    lines = "  \n".join(f"{record.row}: {record.line}" for record in records.values())
    missing = sorted(set(ANATOMIES) - {record.row for record in records.values()})
    note = f"**Not asked yet: {', '.join(missing)}.**\n\n" if missing else ""
    text = f"# {first.title}\n\n{note}{gate_words(records)}\n\n{lines}\n"
    return [
        write_atomically(base.with_suffix(".csv"), lambda path: table.to_csv(path, index=False)),
        write_atomically(base.with_suffix(".md"), text),
    ]


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [
        "| " + " | ".join(header) + " |",
        "|" + "---|" * len(header),
        *("| " + " | ".join(row) + " |" for row in rows),
    ]


def _verdicts(records: Records) -> list[str]:
    rows = []
    for record in records.values():
        found = record.findings
        verdict = "passed" if found.passed else "**NOT passed**: " + "; ".join(found.failures)
        open_ = (_number(found.gap_mm2), _number(found.passing_ball_mm))
        seconds = f"{record.seconds_total:.0f}"
        rows.append((record.row, verdict, *open_, str(record.forward_solves), seconds))
    header = ("anatomy", "gate", "gap (mm²)", "passing ball (mm)", "closures", "time (s)")
    return _markdown(header, rows)


def _variations(records: Records) -> list[str]:
    """Mean and largest distance from the reference, a column for each anatomy."""
    cells = {
        record.row: {
            row.case: ("-" if row.mean_mm is None else f"{row.mean_mm:.2g} / {row.max_mm:.2g}")
            + ("" if row.passed else " **no**")
            for row in record.findings.rows[1:]
        }
        for record in records.values()
    }
    # In the order in which they were run, also if one anatomy was not asked for all of them.
    cases = dict.fromkeys(case for column in cells.values() for case in column)
    rows = [(case, *(column.get(case, "not run") for column in cells.values())) for case in cases]
    return _markdown(("mean / max (mm)", *cells), rows)


def _paths(records: Records) -> list[str]:
    """The largest unexplained move, its share of the whole way, and the curvature."""
    cells = {
        record.row: {
            path.along: f"{_number(path.unexplained_mm)} mm, {percent(path.share, '.2g', '-')} "
            f"({percent(path.curvature, '.2g', '-')})" + ("" if path.passed else " **no**")
            for path in record.findings.paths
        }
        for record in records.values()
    }
    names = dict.fromkeys(name for column in cells.values() for name in column)
    rows = [(name, *(column.get(name, "not run") for column in cells.values())) for name in names]
    return _markdown(("unexplained along ± 20 % (curvature)", *cells), rows)


def _limits(limits: Limits) -> str:
    return (
        f"Limits: under variations that must not matter, mean {limits.mean_mm} mm and maximum "
        f"{limits.max_mm} mm from the reference. Along the moduli, a move of any one vertex that "
        f"the exact derivatives do not explain, {limits.jump_mm} mm; over all vertices, "
        f"{100 * limits.share:g} % of a piece of the way, where a vertex moves by more than "
        f"{limits.seen_mm} mm unexplained, and {100 * limits.share:g} % of the whole way; and "
        f"{100 * limits.side:g} % on both sides of one state. A response that bends is followed in "
        "smaller steps until it is explained, a jump stays. The curvature is the difference "
        "between the exact derivative and a central one over ± 20 %; it has no limit. The gap is "
        "what stays open of the reference where leaflets that touch are taken off."
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"
