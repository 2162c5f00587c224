"""Small tables as comma-separated text, each with a header."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from mvest.errors import InputError, cannot_write
from mvest.reading.text import MAX_NUMBER, check_words, number, one_line, read_text
from mvest.typing import FloatArray, IntArray


def read_columns(
    file: Path,
    names: Sequence[str],
    *,
    strict: bool = False,
    count: int | None = None,
    where: str = "",
) -> dict[str, list[str]]:
    """Columns of a table by their names, as text.

    Parameters
    ----------
    file : Path
    names : sequence of str
        Of all columns.
    strict : bool
        Whether they come in this order, with no space around them and without empty rows.
    count : int, optional
        Of rows; no more are looked at.
    where : str
        What an error calls the file; its path without.

    Raises
    ------
    InputError
        The file cannot be read, its header or the number of its rows is another, a row is too short
        or too long, or a cell is no text.
    """
    where = where or str(file)
    stream = io.StringIO(read_text(file, where=where), newline="")
    try:
        rows = csv.reader(stream, strict=True)
        stripped = ([cell.strip() for cell in row] for row in rows)
        filled = rows if strict else filter(any, stripped)
        header = next(filled, [])
        if header != list(names) if strict else sorted(header) != sorted(names):
            raise InputError(
                f"{where}: columns {one_line(','.join(header), 80) or 'none'}, expected "
                f"{one_line(','.join(names), 120)}"
            )
        found = list(islice(filled, None if count is None else count + 1))
    except csv.Error as fault:
        raise InputError(f"{where}: no comma-separated text: {fault}") from fault
    for row, cells in enumerate(found[:count]):
        if len(cells) != len(header):
            raise InputError(f"{where}: row {row} has {len(cells)} cells, expected {len(header)}")
    if not found or (count is not None and len(found) != count):
        shown = f"more than the {count}" if count and len(found) > count else f"{len(found)}"
        raise InputError(f"{where}: {shown} rows, expected {count or 'some below the header'}")
    for row, cells in enumerate(found):
        for name, cell in zip(header, cells, strict=True):
            try:
                check_words(cell)
            except InputError as fault:
                raise InputError(f"{where}: {name} of row {row}: {fault}") from fault
    columns = zip(*found, strict=True)
    return {name: list(column) for name, column in zip(header, columns, strict=True)}


def numbers(
    where: Path | str, name: str, cells: Sequence[str], max_abs: float = MAX_NUMBER
) -> FloatArray:
    """A column as finite numbers."""
    result = np.empty(len(cells))
    for row, cell in enumerate(cells):
        try:
            result[row] = number(cell, max_abs)
        except InputError as fault:
            raise InputError(f"{where}: {name} of row {row} is {fault}") from fault
    return result


def indices(file: Path, name: str, cells: Sequence[str]) -> IntArray:
    """A column as numbers from 0."""
    for row, cell in enumerate(cells):
        if not (cell.isascii() and cell.isdigit() and len(cell) < 10):
            raise InputError(f"{file}: {name} of row {row} is {cell[:40]!r}, expected 0, 1, 2, ...")
    return np.array([int(cell) for cell in cells], dtype=np.int64)


def read_numbers(
    file: Path,
    names: Sequence[str],
    *,
    strict: bool = False,
    count: int | None = None,
    max_abs: float = MAX_NUMBER,
    where: str = "",
) -> FloatArray:
    """A table of finite numbers, ``(rows, columns)`` in the order of ``names``: `read_columns`."""
    columns = read_columns(file, names, strict=strict, count=count, where=where)
    where = where or str(file)
    return np.column_stack([numbers(where, name, columns[name], max_abs) for name in names])


def read_vertices(file: Path) -> IntArray:
    """The one column ``vertex`` of a table."""
    return indices(file, "vertex", read_columns(file, ["vertex"])["vertex"])


def write_columns(file: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table; numbers keep all their digits.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    try:
        with file.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(names)
            writer.writerows(rows)
    except OSError as error:
        raise cannot_write(file, error) from error
