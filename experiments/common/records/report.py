"""What reports of studies share: names of parameters, and the files of one record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from experiments.common.records.record import Record
from mvest.files import write_atomically

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = [
    "answer_of_main",
    "axis_label",
    "bracketed_unit",
    "cautions",
    "heading",
    "page",
    "parameter_label",
    "percent",
    "provenance_of",
    "write_drawn",
    "write_each",
    "write_report",
]

F = TypeVar("F")

WORDS = {
    "E_f": "modulus",
    "chord_stiffness": "chordal stiffness",
    "chord_rest_length": "chordal length",
}


AXES = {
    "chord_rest_length": "rest length of chordae",
    "chord_stiffness": "stiffness of chordae",
    "pressure_scale": "pressure",
}


def axis_label(name: str) -> str:
    """A parameter in a figure: ``E_f (anterior)``."""
    kind, _, part = name.partition(".")
    return AXES.get(kind, kind) + (f" ({part})" if part else "")


def bracketed_unit(parameter: str) -> str:
    """`` [MPa]`` for a modulus, nothing for any other parameter."""
    return " [MPa]" if parameter.startswith("E_f.") else ""


def parameter_label(name: str) -> str:
    """What a reader calls a parameter."""
    kind, _, part = name.partition(".")
    return f"{part} {WORDS[kind]}".strip() if kind in WORDS else name


def percent(value: float | None, form: str, missing: str) -> str:
    """A share in percent, or what is said where there is none."""
    return missing if value is None else f"{100 * value:{form}} %"


def answer_of_main(answer: Callable[[Record[F]], str]) -> Callable[[Mapping[str, Record[F]]], str]:
    """The answer of a section whose table has one record, or is answered by its main one."""
    return lambda records: answer(next(iter(records.values())))


def page(record: Record[Any], words: str) -> str:
    """Markdown of a record: its title, words, and in small print where it came from."""
    return f"{heading(record)}{words}\n\n<sub>{record.line}</sub>\n"


def heading(*records: Record[Any]) -> str:
    """Markdown of the first record's title, and of what has to be said before any of them."""
    return f"# {records[0].title}\n\n" + "".join(f"**{text}**\n\n" for text in cautions(records))


def cautions(records: Sequence[Record[Any]]) -> list[str]:
    """What stands before results whose anatomies have not passed the gate, naming them."""
    rows: dict[str, list[str]] = {}
    for record in records:
        if record.caution:
            rows.setdefault(record.caution, []).append(record.row)
    return [
        text if len(named) == len(records) else f"{'; '.join(named)}: {text}"
        for text, named in rows.items()
    ]


def provenance_of(records: Sequence[Record[Any]]) -> str:
    """Where the first of several records came from, and how many there are besides."""
    lines = sorted({record.line for record in records})
    return lines[0] + (f" (and {len(lines) - 1} runs more)" if len(lines) > 1 else "")


def _saved(base: Path, figure: Figure, line: str) -> list[Path]:
    # Imports matplotlib, which a job without figures does not need.
    from mvest.reporting.figures import save_figure_with

    return save_figure_with(base, figure, line)


def write_report(
    folder: Path,
    record: Record[F],
    table: pd.DataFrame,
    words: str,
    figure: Figure | None = None,
) -> list[Path]:
    """Write the table (csv), words (Markdown) and figure of a record, named after its experiment.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    base = folder / record.experiment
    text = f"{heading(record)}{words}\n\n{record.line}\n"
    return [
        write_atomically(base.with_suffix(".csv"), lambda path: table.to_csv(path, index=False)),
        write_atomically(base.with_suffix(".md"), text),
        *([] if figure is None else _saved(base, figure, record.line)),
    ]


def write_each(
    table: Callable[[Record[F]], pd.DataFrame],
    words: Callable[[Record[F]], str],
    figure: Callable[[Record[F]], Figure | None] | None = None,
    **more: Callable[[Record[F]], Figure | None],
) -> Callable[[Path, Mapping[str, Record[F]], Mapping[str, Path]], list[Path]]:
    """How a study writes whose records are each reported by themselves, without arrays.

    ``more`` figures are called ``EXPERIMENT_NAME``; one that returns None has nothing to show.
    """

    def write(
        folder: Path, records: Mapping[str, Record[F]], _arrays: Mapping[str, Path]
    ) -> list[Path]:
        written = []
        for record in records.values():
            drawn = figure and figure(record)
            written += write_report(folder, record, table(record), words(record), drawn)
            for name, draw in more.items():
                other = draw(record)
                if other is not None:
                    base = folder / f"{record.experiment}_{name}"
                    written += _saved(base, other, record.line)
        return written

    return write


def write_drawn(
    table: Callable[[Record[F]], pd.DataFrame],
    words: Callable[[Record[F]], str],
    figure: Callable[[Record[F], Path], Figure],
    note: Callable[[Record[F]], str] = lambda record: "",
) -> Callable[[Path, Mapping[str, Record[F]], Mapping[str, Path]], list[Path]]:
    """How a study writes whose figure needs the arrays of a run, and is left out without them.

    A note may stand above the table, as its comments.
    """

    def write(
        folder: Path, records: Mapping[str, Record[F]], arrays: Mapping[str, Path]
    ) -> list[Path]:
        written = []
        for name, record in records.items():
            base = folder / record.experiment
            csv = note(record) + table(record).to_csv(index=False, float_format="%.6g")
            written += [
                write_atomically(base.with_suffix(".csv"), csv),
                write_atomically(base.with_suffix(".md"), page(record, words(record))),
            ]
            if name in arrays:
                written += _saved(base, figure(record, arrays[name]), record.line)
        return written

    return write
