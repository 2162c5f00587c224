"""From records of runs (the contents of their ``result.json``) to tables: CSV, Markdown, LaTeX.

One row for each run, failed ones included, below the paper's own row. CSV holds plain numbers in
columns that name their unit; Markdown and LaTeX hold the same, rounded for reading.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mvest.files import write_atomically
from mvest.reporting.files import provenance_line
from mvest.reporting.markup import MISSING, latex_text, markdown_rows, number, with_std

if TYPE_CHECKING:
    import pandas as pd


__all__ = ["frame", "readable", "text_table", "write_tables"]

Record = Mapping[str, Any]


def frame(records: Sequence[Record]) -> pd.DataFrame:
    """Tidy table of runs: one row each, plain numbers, units in the column names.

    Parameters
    ----------
    records : sequence of mapping
        At least one; the first one's paper reference becomes the first row.
    """
    import pandas as pd

    rows = [_paper_row(records[0])] if records[0]["paper"] else []
    return pd.DataFrame(rows + [_row(record) for record in records])


def _paper_row(record: Record) -> dict[str, Any]:
    paper = record["paper"]
    row: dict[str, Any] = {"run": f"paper, {paper['table']}", "source": "paper"}
    for k, name in enumerate(record["parameters"]):
        row[f"truth {name}{_unit(name)}"] = _at(record["truth"], k)
        row[f"estimate {name}{_unit(name)}"] = _at(paper["estimate"], k)
        row[f"error {name} [%]"] = _at(paper["error_percent"], k)
    row["moduli error mean [%]"] = _at(paper["moduli_error_percent"], 0)
    row["moduli error SD [%]"] = _at(paper["moduli_error_percent"], 1)
    row["distance mean [mm]"] = _at(paper["distance_mm"], 0)
    row["distance SD [mm]"] = _at(paper["distance_mm"], 1)
    return row


def _row(record: Record) -> dict[str, Any]:
    row: dict[str, Any] = {"run": record["row"], "source": "mvest"}
    errors = record["relative_error"]
    for k, name in enumerate(record["parameters"]):
        row[f"truth {name}{_unit(name)}"] = _at(record["truth"], k)
        row[f"start {name}{_unit(name)}"] = _at(record["initial"], k)
        row[f"estimate {name}{_unit(name)}"] = _at(record["estimate"], k)
        row[f"std {name}{_unit(name)}"] = _at(record["std"], k)
        row[f"error {name} [%]"] = None if errors is None else 100.0 * abs(errors[k])
    closed = (record["closure"] or {}).get("closed", {})
    moduli, distance = record["moduli_error_percent"] or {}, record["distance_mm"] or {}
    model = record["model"]
    row |= {
        "moduli error mean [%]": moduli.get("mean"),
        "moduli error SD [%]": moduli.get("std"),
        "distance mean [mm]": distance.get("mean"),
        "distance SD [mm]": distance.get("std"),
        "distance max [mm]": distance.get("max"),
        "orifice, closed [mm²]": closed.get("orifice_area"),
        "passing ball, closed [mm]": closed.get("passing_ball_diameter"),
        "coaptation [mm]": closed.get("coaptation_length"),
        "element": model["element"],
        "cells": " x ".join(str(n) for n in model["cells"]),
        "nodes": record["mesh"]["nodes"],
        "filter": model["filter"],
        "noise [mm]": model["noise_mm"],
        "iterations": record["iterations"],
        "forward solves": record["forward_solves"],
        "time [s]": record["seconds"],
        "status": record["status"],
        "reason": record["reason"],
    }
    return row


def readable(records: Sequence[Record]) -> pd.DataFrame:
    """The table of ``frame`` as a reader wants it: text, rounded, related numbers in one column."""
    import pandas as pd

    table = frame(records)
    rows = []
    for _, row in table.iterrows():
        text: dict[str, str] = {"run": str(row["run"])}
        for name in records[0]["parameters"]:
            unit = _unit(name)
            text[f"{name}{unit}"] = with_std(
                row[f"estimate {name}{unit}"], row.get(f"std {name}{unit}")
            )
            text[f"error {name} [%]"] = number(row[f"error {name} [%]"])
        text["error of all moduli [%]"] = with_std(
            row["moduli error mean [%]"], row["moduli error SD [%]"]
        )
        text["distance [mm]"] = with_std(row["distance mean [mm]"], row["distance SD [mm]"])
        text["element, cells"] = (
            MISSING if row["source"] == "paper" else f"{row['element']}, {row['cells']}"
        )
        for name in ("forward solves", "time [s]"):
            text[name] = MISSING if row["source"] == "paper" else f"{row[name]:.0f}"
        text["ended"] = MISSING if row["source"] == "paper" else str(row["reason"]).split(":")[0]
        rows.append(text)
    return pd.DataFrame(rows)


def text_table(records: Sequence[Record]) -> str:
    """The readable table for a terminal, one line per quantity."""
    table = readable(records).set_index("run").T
    table.index.name = None
    table.columns.name = None
    return str(table.to_string())


def write_tables(folder: Path, name: str, records: Sequence[Record]) -> list[Path]:
    """Write ``name.csv``, ``name.md`` and ``name.tex``; returns their paths.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    lines = [provenance_line(record) for record in records]
    reading = readable(records)
    csv = "".join(f"# {line}\n" for line in lines) + frame(records).to_csv(index=False)
    notes = "\n".join(f"<sub>{line}</sub>  " for line in lines)
    table = markdown_rows(_plain(reading))
    markdown = f"# {records[0]['title']}\n\n{table}\n\n{_truth(records)}\n\n{notes}\n"
    tex = "".join(f"% {line}\n" for line in lines) + _latex(reading)
    return [
        write_atomically(folder / f"{name}.csv", csv),
        write_atomically(folder / f"{name}.md", markdown),
        write_atomically(folder / f"{name}.tex", tex),
    ]


def _truth(records: Sequence[Record]) -> str:
    first = records[0]
    values = "/".join(number(value) for value in first["truth"] or [])
    start = "/".join(number(value) for value in first["initial"])
    return (
        f"Truth {values}, start {start} for {', '.join(first['parameters'])}. Estimates are given "
        f"with the filter's standard deviation, errors without sign; errors of all moduli and "
        f"distances (fitted to observed closed valve) are mean ± SD."
    )


def _plain(table: pd.DataFrame) -> list[dict[str, str]]:
    return [dict(zip(table.columns, row, strict=True)) for row in table.to_numpy().tolist()]


def _latex(table: pd.DataFrame) -> str:
    """A booktabs table, transposed: quantities are rows, so that it fits a page."""
    runs = [latex_text(text) for text in table["run"]]
    body = [
        " & ".join([latex_text(str(name)), *(latex_text(text) for text in table[name])]) + r" \\"
        for name in table.columns[1:]
    ]
    return "\n".join(
        [
            r"\begin{tabular}{l" + "r" * len(runs) + "}",
            r"\toprule",
            " & ".join(["", *runs]) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _unit(parameter: str) -> str:
    return " [MPa]" if parameter.startswith("E_f.") else ""


def _at(values: Sequence[float] | None, k: int) -> float | None:
    return None if values is None or k >= len(values) else values[k]
