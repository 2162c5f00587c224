"""Tables and figures of synthetic studies.

One row for each run, failed ones included, below the paper's own row. CSV holds plain numbers in
columns that name their unit; Markdown and LaTeX hold the same, rounded for reading.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.common.records.estimates import Paper
from experiments.common.records.record import Record
from experiments.common.records.report import bracketed_unit, heading
from experiments.studies.twin.findings import Findings
from mvest.files import write_atomically
from mvest.reporting.markup import MISSING, latex_text, markdown_rows, number, with_std
from mvest.valve.measure.measurements import ClosureMeasurements

if TYPE_CHECKING:
    import pandas as pd


__all__ = [
    "frame",
    "meshes_answer",
    "readable",
    "table1_answer",
    "text_table",
    "write_tables",
    "write_twin",
    "write_twin_run",
]

Twin = Record[Findings]

ITERATES, VALVE = "iterates", "valve"
"""Figures of a run in its folder."""


def frame(records: Sequence[Twin]) -> pd.DataFrame:
    """Tidy table of runs: one row each, plain numbers, units in the column names.

    Parameters
    ----------
    records : sequence of Record
        At least one; the first one's paper reference becomes the first row.
    """
    import pandas as pd

    first = records[0]
    rows = [_paper_row(first, first.findings.paper)] if first.findings.paper else []
    return pd.DataFrame(rows + [_row(record) for record in records])


def _paper_row(record: Twin, paper: Paper) -> dict[str, Any]:
    row: dict[str, Any] = {"run": f"paper, {paper.table}", "source": "paper"}
    for k, name in enumerate(record.parameters):
        row[f"truth {name}{bracketed_unit(name)}"] = record.findings.truth[k]
        row[f"estimate {name}{bracketed_unit(name)}"] = _at(paper.estimate, k)
        row[f"error {name} [%]"] = _at(paper.error_percent, k)
    row["moduli error mean [%]"] = _at(paper.moduli_error_percent, 0)
    row["moduli error SD [%]"] = _at(paper.moduli_error_percent, 1)
    row["distance mean [mm]"] = _at(paper.distance_mm, 0)
    row["distance SD [mm]"] = _at(paper.distance_mm, 1)
    return row


def _row(record: Twin) -> dict[str, Any]:
    findings, model, mesh = record.findings, record.model, record.mesh
    first, moduli = findings.first, findings.moduli_error_percent
    assert model is not None
    assert mesh is not None
    row: dict[str, Any] = {"run": record.row, "source": "mvest"}
    for k, name in enumerate(record.parameters):
        row[f"truth {name}{bracketed_unit(name)}"] = findings.truth[k]
        row[f"start {name}{bracketed_unit(name)}"] = findings.initial[k]
        row[f"estimate {name}{bracketed_unit(name)}"] = _at(first.estimate, k)
        row[f"std {name}{bracketed_unit(name)}"] = _at(first.std, k)
        error = _at(first.relative_error, k)
        row[f"error {name} [%]"] = None if error is None else 100.0 * abs(error)
        row[f"truth of {name} known to [%]"] = _at(findings.truth_band_percent, k)
    distance = first.distance_mm
    closed = (findings.closure or {}).get("closed")
    measured = closed if isinstance(closed, ClosureMeasurements) else None
    return row | {
        "moduli error mean [%]": moduli and moduli.mean,
        "moduli error SD [%]": moduli and moduli.std,
        "distance mean [mm]": distance and distance.mean,
        "distance SD [mm]": distance and distance.std,
        "distance max [mm]": distance and distance.max,
        "orifice, closed [mm²]": measured and measured.orifice_area,
        "passing ball, closed [mm]": measured and measured.passing_ball_diameter,
        "coaptation [mm]": measured and measured.coaptation_length,
        "element": model.element,
        "cells": " x ".join(str(n) for n in model.cells),
        "nodes": mesh.nodes,
        "filter": model.filter,
        "noise [mm]": model.noise_mm,
        "iterations": first.iterations or 0,
        "forward solves": record.forward_solves,
        "time [s]": first.seconds,
        "status": record.status,
        "reason": record.reason,
    }


def readable(records: Sequence[Twin]) -> pd.DataFrame:
    """The table of ``frame`` as a reader wants it: text, rounded, related numbers in one column."""
    import pandas as pd

    table = frame(records)
    rows = []
    for _, row in table.iterrows():
        text: dict[str, str] = {"run": str(row["run"])}
        for name in records[0].parameters:
            unit = bracketed_unit(name)
            text[f"{name}{unit}"] = with_std(
                row[f"estimate {name}{unit}"], row.get(f"std {name}{unit}")
            )
            band = row.get(f"truth of {name} known to [%]")
            text[f"error {name} [%]"] = with_std(row[f"error {name} [%]"], band)
        text["error of all moduli [%]"] = with_std(
            row["moduli error mean [%]"], row["moduli error SD [%]"]
        )
        text["distance [mm]"] = with_std(row["distance mean [mm]"], row["distance SD [mm]"])
        own = row["source"] != "paper"
        text["element, cells"] = f"{row['element']}, {row['cells']}" if own else MISSING
        for name in ("forward solves", "time [s]"):
            text[name] = f"{row[name]:.0f}" if own else MISSING
        text["ended"] = str(row["reason"]).split(":")[0] if own else MISSING
        rows.append(text)
    return pd.DataFrame(rows)


def text_table(records: Sequence[Twin]) -> str:
    """The readable table for a terminal, one line per quantity."""
    table = readable(records).set_index("run").T
    table.index.name = None
    table.columns.name = None
    return str(table.to_string())


def write_tables(folder: Path, name: str, records: Sequence[Twin]) -> list[Path]:
    """Write ``name.csv``, ``name.md`` and ``name.tex``; returns their paths.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    lines = [record.line for record in records]
    reading = readable(records)
    csv = "".join(f"# {line}\n" for line in lines) + frame(records).to_csv(index=False)
    notes = "\n".join(f"<sub>{line}</sub>  " for line in lines)
    table = markdown_rows(
        [dict(zip(reading.columns, row, strict=True)) for row in reading.to_numpy().tolist()]
    )
    markdown = f"{heading(*records)}{table}\n\n{_truth(records[0])}\n\n{notes}\n"
    tex = "".join(f"% {line}\n" for line in lines) + _latex(reading)
    return [
        write_atomically(folder / f"{name}.csv", csv),
        write_atomically(folder / f"{name}.md", markdown),
        write_atomically(folder / f"{name}.tex", tex),
    ]


def _truth(first: Twin) -> str:
    values = "/".join(map(number, first.findings.truth))
    start = "/".join(map(number, first.findings.initial))
    return (
        f"Truth {values}, start {start} for {', '.join(first.parameters)}. Estimates are given "
        f"with the filter's standard deviation, errors without sign, and ± what is not known of a "
        f"truth that was carried on to cells of no size; errors of all moduli and "
        f"distances (fitted to observed closed valve) are mean ± SD."
    )


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


def _at(values: Sequence[float] | None, k: int) -> float | None:
    return None if values is None or k >= len(values) else values[k]


def write_twin(folder: Path, records: Mapping[str, Twin], arrays: Mapping[str, Path]) -> list[Path]:
    """The table of all records, and the figures of the one that the table is named after."""
    first, main = next(iter(records.items()))
    table, fields = main.table, arrays.get(first)
    written = write_tables(folder, table, list(records.values()))
    if first == table:
        names = {ITERATES: table, VALVE: f"{table}_valve"}
        drawn = _copied(fields.parent, folder, names) if fields is not None else []
        written += drawn or _figures(folder, names, main, fields)
    return written


def write_twin_run(folder: Path, record: Twin) -> list[Path]:
    """The table and the figures of one run."""
    fields = folder / "fields.npz"
    fitted = record.findings.first.distance_mm is not None and fields.is_file()
    return [
        *write_tables(folder, record.table, [record]),
        *_figures(folder, {}, record, fields if fitted else None),
    ]


def _copied(run: Path, folder: Path, names: Mapping[str, str]) -> list[Path]:
    """The figures that a run drew in its folder, under other names elsewhere."""
    return [
        write_atomically(folder / f"{name}{drawn.suffix}", drawn.read_bytes())
        for own, name in names.items()
        for drawn in sorted(run.glob(f"{own}.*"))
    ]


def _figures(
    folder: Path, names: Mapping[str, str], record: Twin, fields: Path | None
) -> list[Path]:
    """How the estimate came about, and the fitted valve if its arrays are there."""
    from mvest.reporting.case.figures import fitted_figure
    from mvest.reporting.figures import iterates_figure, save_figure_with

    first, written = record.findings.first, []
    if first.iterates:
        figure = iterates_figure(
            f"{record.title}: {record.row}",
            record.parameters,
            first.iterates,
            first.iterate_std,
            record.findings.truth,
        )
        written += save_figure_with(folder / names.get(ITERATES, ITERATES), figure, record.line)
    if fields is not None:
        figure = fitted_figure(fields)
        written += save_figure_with(folder / names.get(VALVE, VALVE), figure, record.line)
    return written


def meshes_answer(records: Mapping[str, Twin]) -> str:
    """How much moduli depend on the estimator's mesh."""
    errors = [
        abs(error)
        for record in records.values()
        for error in record.findings.first.relative_error or ()
        if error is not None
    ]
    return (
        f"Estimated on {len(records)} meshes from one simulated truth on another, moduli are up "
        f"to {100 * max(errors):.2g} % off."
    )


def table1_answer(records: Mapping[str, Twin]) -> str:
    """How far moduli are off, in one line: seen by the same model, and by others."""
    sentences = []
    for record in records.values():
        error = record.findings.moduli_error_percent
        off = f"{error.mean:.2g} %" if record.converged and error else "no estimate"
        if off != "no estimate" and (band := record.findings.truth_band_percent):
            off += f", which the truth itself is known to {max(band):.2g} %"
        sentences.append(f"{record.row} {off}")
    return f"Mean error of all moduli by what was seen (simulated): {'; '.join(sentences)}."
