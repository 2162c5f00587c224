"""Reads bytes, text, numbers and small comma-separated tables from users, within bounds."""

import csv
import io
import math
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mvest.errors import InputError, MvestError, cannot_write
from mvest.typing import FloatArray, IntArray

MAX_TEXT = 2**26
"""Default largest size of a text file (bytes)."""
MAX_NUMBER = 1e9
"""Largest magnitude of any user-supplied number, in any unit."""
MAX_LINE = 300
"""Longest message about a file (characters)."""
MAX_WORDS = 20_000
"""Longest user-supplied text (characters)."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,5})?", re.ASCII)
_MAX_DIGITS = 400
_UNWRITABLE = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


def read_bytes(path: Path, max_size: int = MAX_TEXT, where: str = "") -> bytes:
    """Read a file; ``where`` names it in errors (default: its path).

    InputError if the file is missing, irregular, not readable, or larger than ``max_size`` bytes.
    """
    where = where or str(path)
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # opening a pipe would block
            kind = "a folder" if stat.S_ISDIR(mode) else "no regular file"
            raise InputError(f"{where} cannot be read: it is {kind}")
        with path.open("rb") as stream:
            content = stream.read(max_size + 1)
            size = stream.seek(0, 2)
    except FileNotFoundError as fault:
        raise InputError(f"{where} is missing") from fault
    except OSError as fault:
        raise InputError(f"{where} cannot be read: {fault.strerror or fault}") from fault
    if len(content) > max_size:
        raise InputError(f"{where}: {size} bytes, expected at most {max_size}")
    return content


def read_text(path: Path, max_size: int = MAX_TEXT, where: str = "") -> str:
    """Read a UTF-8 file, with or without a byte order mark.

    InputError as `read_bytes`, or the file is not UTF-8.
    """
    try:
        return read_bytes(path, max_size, where).decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise InputError(f"{where or path}: byte {fault.start} is no UTF-8 text") from fault


def number(text: str, max_abs: float = MAX_NUMBER) -> float:
    """Parse a finite decimal number; underscores, hexadecimal and sexagesimal digits are errors.

    InputError if the text is not such a number, or its magnitude exceeds ``max_abs``.
    """
    plain = text.strip()
    value = float(plain) if len(plain) <= _MAX_DIGITS and _NUMBER.fullmatch(plain) else math.nan
    if not (math.isfinite(value) and abs(value) <= max_abs):
        at_most = f" (at most {max_abs:g})" if math.isfinite(max_abs) else ""
        raise InputError(f"{one_line(repr(text), 40)}, expected a finite number{at_most}")
    return value


def check_words(text: str, max_length: int = MAX_WORDS) -> str:
    """Return the text if all output formats can represent it.

    InputError if the text has control characters other than line ends and tabs, halves of surrogate
    pairs, or more than ``max_length`` characters.
    """
    if len(text) > max_length:
        raise InputError(f"{len(text)} characters, expected at most {max_length}")
    if wrong := _UNWRITABLE.search(text):
        code = f"U+{ord(wrong.group()):04X}"
        raise InputError(f"the character {code} at {wrong.start()}, which is no text; remove it")
    return text


def one_line(text: object, max_length: int = MAX_LINE) -> str:
    """Convert an object to one line of bounded length that any terminal can show."""
    words = " ".join(str(text)[: 4 * max_length].split())
    line = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in words)
    return line if len(line) <= max_length else line[: max_length - 3] + "..."


@contextmanager
def refusing(path: Path, what: str) -> Iterator[None]:
    """Turn every exception into a one-line error of this package that names the file.

    MvestError as raised within, cut to `MAX_LINE` characters; an `InputError` for everything else.
    """
    try:
        yield
    except Exception as error:
        known = isinstance(error, MvestError)
        kind = type(error) if known else InputError
        words = str(error).removeprefix(f"{path}: ") or type(error).__name__
        words = words if known else f"damaged or no {what}: {words}"
        raise kind(f"{path}: {one_line(words, MAX_LINE - len(path.name) - 2)}") from error


@contextmanager
def named(*places: object) -> Iterator[None]:
    """Prepend the first place to errors of this package that begin with none of the places."""
    try:
        yield
    except MvestError as fault:
        known = any(str(fault).startswith(str(place)) for place in places)
        raise type(fault)(str(fault) if known else f"{places[0]}: {fault}") from fault


def read_columns(
    file: Path, names: Sequence[str], where: str = "", optional: Sequence[str] = ()
) -> dict[str, list[str]]:
    """Read columns of a table by name, as text; the file may have them in any order.

    ``where`` names the file in errors (default: its path). The optional columns come together.

    InputError if the file is unreadable or not text, its header is wrong, it has no rows, or a row
    is too short or too long.
    """
    where = where or str(file)
    text = read_text(file, where=where)
    try:
        check_words(text, MAX_TEXT)
        cells = csv.reader(io.StringIO(text, newline=""), strict=True)
        rows = [row for row in ([cell.strip() for cell in row] for row in cells) if any(row)]
    except (InputError, csv.Error) as fault:
        raise InputError(f"{where}: no comma-separated text: {fault}") from fault
    header = rows[0] if rows else []
    if sorted(header) not in (sorted(names), sorted((*names, *optional))):
        more = f", and both or none of {','.join(optional)}" if optional else ""
        raise InputError(
            f"{where}: columns {one_line(','.join(header), 80) or 'none'}, expected "
            f"{one_line(','.join(names), 120)}{more}"
        )
    for number, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise InputError(f"{where}: row {number} has {len(row)} cells, expected {len(header)}")
    if len(rows) < 2:
        raise InputError(f"{where}: no rows, expected some below the header")
    return dict(zip(header, map(list, zip(*rows[1:], strict=True)), strict=True))


def numbers(
    where: Path | str, name: str, cells: Sequence[str], max_abs: float = MAX_NUMBER
) -> FloatArray:
    """Convert a column to finite numbers."""
    result = np.empty(len(cells))
    for row, cell in enumerate(cells):
        try:
            result[row] = number(cell, max_abs)
        except InputError as fault:
            raise InputError(f"{where}: {name} of row {row} is {fault}") from fault
    return result


def read_numbers(
    file: Path, names: Sequence[str], max_abs: float = MAX_NUMBER, where: str = ""
) -> FloatArray:
    """Read a table of finite numbers ``(rows, columns)``, in the order of ``names``."""
    columns = read_columns(file, names, where)
    cells = [numbers(where or str(file), name, columns[name], max_abs) for name in names]
    return np.column_stack(cells)


def indices(file: Path, name: str, cells: Sequence[str]) -> IntArray:
    """Convert a column to indices, counted from 0."""
    for row, cell in enumerate(cells):
        if not (cell.isascii() and cell.isdigit() and len(cell) < 10):
            raise InputError(f"{file}: {name} of row {row} is {cell[:40]!r}, expected 0, 1, 2, ...")
    return np.array([int(cell) for cell in cells], dtype=np.int64)


def read_vertices(file: Path) -> IntArray:
    """Read a table whose only column is ``vertex``."""
    return indices(file, "vertex", read_columns(file, ["vertex"])["vertex"])


def write_columns(file: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table; numbers are written with all digits.

    InputError if the file cannot be written.
    """
    try:
        with file.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(names)
            writer.writerows(rows)
    except OSError as error:
        raise cannot_write(file, error) from error
