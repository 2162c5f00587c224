"""Tables of results: from rows of plain data to CSV, Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from mvest.files import write_atomically
from mvest.reporting.markup import latex_rows, markdown_rows

__all__ = ["write_table"]


def write_table(
    base: Path,
    table: pd.DataFrame,
    readable: Sequence[Mapping[str, str]],
    line: str,
    notes: Sequence[str],
) -> list[Path]:
    """Write a table as CSV, Markdown and LaTeX, with notes and provenance; returns the paths."""
    words = "\n\n".join(notes)
    comment = "".join(f"% {note}\n" for note in [*notes, line])
    text = f"{markdown_rows(readable)}\n\n{words}\n\n{line}\n"
    return [
        write_atomically(base.with_suffix(".csv"), f"# {line}\n" + table.to_csv(index=False)),
        write_atomically(base.with_suffix(".md"), text),
        write_atomically(base.with_suffix(".tex"), comment + latex_rows(readable)),
    ]
