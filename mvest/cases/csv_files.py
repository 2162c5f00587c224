"""The small tables of a case folder, as comma-separated text: chordae, loops, pressure."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from mvest.cases.schema import MAX_NUMBER
from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray

__all__ = ["read_columns", "read_numbers", "read_vertices", "write_columns"]


def read_columns(file: Path, names: Sequence[str]) -> dict[str, list[str]]:
    """Columns of a table by their names, as text.

    Raises
    ------
    InputError
        The file cannot be read, its header is another, or a row is too short or too long.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as fault:
        raise InputError(f"{file}: byte {fault.start} is no UTF-8 text") from fault
    except OSError as fault:
        raise InputError(f"{file}: cannot be read: {fault.strerror or fault}") from fault
    try:
        rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    except csv.Error as fault:
        raise InputError(f"{file}: no comma-separated text: {fault}") from fault
    header = [cell.strip() for cell in rows[0]] if rows else []
    if sorted(header) != sorted(names):
        raise InputError(
            f"{file}: columns {','.join(header) or 'none'}, expected {','.join(names)}"
        )
    if len(rows) < 2:
        raise InputError(f"{file}: no rows below the header")
    for number, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise InputError(f"{file}: row {number} has {len(row)} cells, expected {len(header)}")
    columns = zip(header, zip(*rows[1:], strict=True), strict=True)
    return {name: [cell.strip() for cell in column] for name, column in columns}


def numbers(file: Path, name: str, cells: Sequence[str]) -> FloatArray:
    """A column as finite numbers."""
    result = []
    for row, cell in enumerate(cells):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not abs(value) <= MAX_NUMBER:
            raise InputError(
                f"{file}: {name} of row {row} is {cell[:40]!r}, expected a finite number "
                f"(at most {MAX_NUMBER:g})"
            )
        result.append(value)
    return np.array(result, dtype=np.float64)


def indices(file: Path, name: str, cells: Sequence[str]) -> IntArray:
    """A column as numbers from 0."""
    for row, cell in enumerate(cells):
        if not (cell.isascii() and cell.isdigit() and len(cell) < 10):
            raise InputError(f"{file}: {name} of row {row} is {cell[:40]!r}, expected 0, 1, 2, ...")
    return np.array([int(cell) for cell in cells], dtype=np.int64)


def read_numbers(file: Path, names: Sequence[str]) -> FloatArray:
    """A table of finite numbers, ``(rows, columns)`` in the order of ``names``."""
    columns = read_columns(file, names)
    return np.column_stack([numbers(file, name, columns[name]) for name in names])


def read_vertices(file: Path) -> IntArray:
    """The one column ``vertex`` of a table."""
    return indices(file, "vertex", read_columns(file, ["vertex"])["vertex"])


def write_columns(file: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table; numbers keep all their digits."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(rows)
