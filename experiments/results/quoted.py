"""Numbers of texts that are taken from results, so that no text keeps an older one.

A source is ``TABLE > ROW > COLUMN``: a CSV of the results without its ending (or ``believed``), the
first cells of one row, and a heading without its unit. A format may follow: ``: .1f``; otherwise
a number has two significant digits.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from experiments.results.believed import believed
from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.reporting.markup import number

MARKED = re.compile(r"(?<![\d.])[-+]?[\d.]+(?:e[-+]?\d+)?(?=<!-- ([^<>]+(?: > [^<>]+)+) -->)")
"""A number in Markdown, followed by its source in a comment."""
BLOCK = re.compile(r"(<!-- (\w+\.md)((?: > [^<>]+)+) -->\n\n(?:\|.*\n){2})(?:\|.*\n)+")
"""A table in Markdown after a comment that names columns of a page of results."""


def quoted(source: str, results: Path) -> str:
    """The number of a source; an `InputError` names one that results do not have."""
    place, _, form = source.partition(" : ")
    name, *keys = (part.strip() for part in place.split(" > "))
    if len(keys) < 2:
        raise InputError(f"{source}: expected TABLE > ROW > COLUMN")
    *cells, column = keys
    found = [row for row in _rows(results, name) if [*row.values()][: len(cells)] == cells]
    if len(found) != 1 or column not in found[0]:
        what = f"{len(found)} rows {' > '.join(cells)}" if len(found) != 1 else f"no {column}"
        raise InputError(f"{results / name}.csv has {what}, expected one for {source}")
    try:
        value = float(text := found[0][column])
    except ValueError as error:
        raise InputError(f"{source}: {text!r} is no number") from error
    whole = value.is_integer() and "." not in text
    return format(value, form.strip()) if form else str(int(value)) if whole else number(value, 2)


@cache
def _rows(results: Path, name: str) -> Sequence[Mapping[str, str]]:
    """The rows of a table as texts, by headings without units."""
    if name == "believed":
        return [
            {k: "" if v is None else str(v) for k, v in row.items()}
            for row in believed(results).rows
        ]
    path = results / f"{name}.csv"
    if not path.is_file():
        raise InputError(f"{path}: there is no such table")
    with path.open(encoding="utf-8") as file:
        rows = csv.reader(line for line in file if not line.startswith("# "))
        heads = [head.partition(" [")[0] for head in next(rows)]
        return [dict(zip(heads, row, strict=True)) for row in rows]


def requoted(text: str, results: Path) -> str:
    """Markdown with its marked numbers and tables as results have them now."""

    def rows(found: re.Match[str]) -> str:
        page = (results / found[2]).read_text(encoding="utf-8").splitlines()
        head, _, *body = ([cell.strip() for cell in one[1:-1].split(" | ")] for one in page
                          if one.startswith("|"))  # fmt: skip
        columns = [head.index(name.strip()) for name in found[3].split(" > ")[1:]]
        lines = ("| " + " | ".join(row[k] for k in columns) + " |\n" for row in body)
        return found[1] + "".join(lines)

    text = BLOCK.sub(rows, text)
    return MARKED.sub(lambda found: quoted(found[1], results), text)


def requote(path: Path, results: Path) -> list[Path]:
    """Write a text with its marked numbers again if one has changed; returns the paths written."""
    before = path.read_text(encoding="utf-8") if path.is_file() else ""
    _rows.cache_clear()
    believed.cache_clear()
    after = requoted(before, results)
    return [write_atomically(path, after)] if after != before else []
