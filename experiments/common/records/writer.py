"""Tables, figures and page of any study, from its records alone.

A table of results called NAME consists of ``NAME.csv`` and ``NAME_PART.csv`` (tidy tables, for
programs), ``NAME.md`` (the page for readers), ``NAME.png`` and ``NAME_PART.png`` (figures), and,
for the paper's own tables, LaTeX and PDF.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.common.records.record import Record
from experiments.common.study import Results, Study
from mvest.files import write_atomically
from mvest.reporting.markup import markdown_text
from mvest.reporting.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 60  # most rows of a table on a page; of a longer one the page names the file


def write_results(folder: Path, study: Study[Any], results: Results) -> list[Path]:
    """Write everything that follows from records; returns the paths, tables first.

    ``folder`` exists. Files have the name of the table that the records belong to.

    Raises an `InputError` if a file cannot be written.
    """
    drawn = None if study.figure is None or results.is_empty else study.figure(results)
    figures = drawn if isinstance(drawn, Mapping) else {"": drawn} if drawn else {}
    return write_page(
        folder / results.first.table,
        results.first.title,
        {part: results.table(part) for part in results.table_names},
        None if study.summary is None or results.is_empty else study.summary(results),
        list(results.records.values()),
        figures=figures,
        captions=study.captions,
        latex=study.latex,
    )


def write_page(
    base: Path,
    title: str,
    tables: Mapping[str, Table],
    summary: Mapping[str, Table] | None,
    records: Sequence[Record],
    *,
    figures: Mapping[str, Figure],
    captions: Mapping[str, str],
    latex: Collection[str],
) -> list[Path]:
    """Write tables as CSV, figures, and the page that shows these and earlier figures.

    All file names begin with ``base``. Tables, figures and captions are named by their part of the
    results, ``""`` for the main one. Readers see the tables of the ``summary``, if given, instead
    of all. ``latex`` names the readers' tables that are also written as LaTeX, and figures as PDF.

    Raises an `InputError` if a file cannot be written.
    """
    lines = sorted({record.line for record in records})
    comments = "".join(f"# {line}\n" for line in lines[:1])
    shown = tables if summary is None else summary
    written, drawn = [], []
    for part, figure in figures.items():
        from mvest.reporting.figures import save_figure_with

        place = _named(base, part)
        pdf = place.name in latex
        drawn += save_figure_with(place, figure, provenance_of(records), pdf=pdf)
    for part, table in {**tables, **shown}.items():
        path = _named(base, part, ".csv")
        written.append(write_atomically(path, comments + table.csv()))
    parts = [f"# {title}", *(f"**{text}**" for text in cautions(records))]
    if summary is None and len(records) == 1:
        parts.append("\n".join(numbers_of(records[0])))
    for part, table in shown.items():
        if part:
            parts.append(f"## {_heading(part)}")
        file = _named(base, part, ".csv").name
        parts.append(table.markdown() if len(table) <= LONGEST else f"{len(table)} rows: {file}")
        if _named(base, part).name in latex:
            text = f"% {provenance_of(records)}\n{table.latex()}"
            written.append(write_atomically(_named(base, part, ".tex"), text))
    for part, caption in captions.items():
        if (picture := _named(base, part, ".png")).is_file():
            parts.append(f"![{markdown_text(caption)}]({picture.name})")
    parts.append(f"<sub>{provenance_of(records)}</sub>")
    page = "\n\n".join(part for part in parts if part) + "\n"
    return [*written, write_atomically(base.with_name(f"{base.name}.md"), page), *drawn]


def words_of(study: Study[Any], record: Record) -> str:
    """The text of a finished run for the terminal: cautions, numbers and readers' tables."""
    parts = cautions([record])
    results = Results({record.experiment: record})
    if study.words is not None and not results.is_empty:
        return "\n".join([*parts, study.words(record)])
    tables = {part: results.table(part) for part in results.table_names}
    if study.summary is not None and not results.is_empty:
        tables = dict(study.summary(results))
    parts += numbers_of(record)
    for part, table in tables.items():
        shown = table.text() if len(table) <= LONGEST else f"{len(table)} rows"
        parts.append(f"{_heading(part)}:\n{shown}" if part else shown)
    return "\n".join(parts)


def numbers_of(record: Record) -> list[str]:
    """The single values of a record, a line of Markdown each, or why a run failed."""
    failed = [] if record.converged else [f"* no result: {record.reason}"]
    values = {name: f"{v:.4g}" if isinstance(v, float) else v for name, v in record.numbers.items()}
    return failed + [f"* {_heading(name)}: {value}" for name, value in values.items()]


def cautions(records: Sequence[Record]) -> list[str]:
    """Warnings about results whose anatomies have not passed the gate, with their names."""
    rows: dict[str, list[str]] = {}
    for record in records:
        if record.caution:
            rows.setdefault(record.caution, []).append(record.row)
    return [
        text if len(named) == len(records) else f"{'; '.join(named)}: {text}"
        for text, named in rows.items()
    ]


def provenance_of(records: Sequence[Record]) -> str:
    """The provenance of the first of several records, and the number of others."""
    lines = sorted({record.line for record in records})
    return lines[0] + (f" (and {len(lines) - 1} runs more)" if len(lines) > 1 else "")


def _named(base: Path, part: str, suffix: str = "") -> Path:
    return base.with_name(f"{base.name}_{part}{suffix}" if part else f"{base.name}{suffix}")


def _heading(name: str) -> str:
    return name.replace("_", " ")
