"""Bytes, text, numbers and words from files that others wrote."""

from __future__ import annotations

import math
import re
import stat
from pathlib import Path

from mvest.errors import InputError

MAX_TEXT = 2**26
"""Bytes of a file of text, where its reader does not state less."""
MAX_NUMBER = 1e9
"""Of any number that a user gives, whatever its unit: far beyond sense, and far from overflow."""
MAX_LINE = 300
"""Characters of what is said of a file."""
MAX_WORDS = 20_000
"""Characters of any text that a user gives."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,5})?", re.ASCII)
_MAX_DIGITS = 400
_UNWRITABLE = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


def read_bytes(path: Path, max_size: int = MAX_TEXT, where: str = "") -> bytes:
    """All of a file, which an error calls ``where`` or by its path.

    Raises
    ------
    InputError
        If it is missing, is no regular file, cannot be read, or is larger than ``max_size`` bytes.
    """
    where = where or str(path)
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            # Whoever opens a pipe waits for who writes to it.
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
    """All of a file of UTF-8 text, with or without a byte order mark.

    Raises
    ------
    InputError
        As `read_bytes`, and if it is no such text.
    """
    try:
        return read_bytes(path, max_size, where).decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise InputError(f"{where or path}: byte {fault.start} is no UTF-8 text") from fault


def number(text: str, max_abs: float = MAX_NUMBER) -> float:
    """A decimal number: finite, bounded, without underscores, hexadecimal or sexagesimal digits.

    Raises
    ------
    InputError
        If the text is none, or its magnitude is more than ``max_abs``.
    """
    plain = text.strip()
    value = float(plain) if len(plain) <= _MAX_DIGITS and _NUMBER.fullmatch(plain) else math.nan
    if not (math.isfinite(value) and abs(value) <= max_abs):
        at_most = f" (at most {max_abs:g})" if math.isfinite(max_abs) else ""
        raise InputError(f"{one_line(repr(text), 40)}, expected a finite number{at_most}")
    return value


def check_words(text: str, max_length: int = MAX_WORDS) -> str:
    """The text, if every output can hold it: no control characters but line ends and tabs.

    Raises
    ------
    InputError
        If there are others, halves of surrogate pairs, or more than ``max_length`` characters.
    """
    if len(text) > max_length:
        raise InputError(f"{len(text)} characters, expected at most {max_length}")
    wrong = _UNWRITABLE.search(text)
    if wrong is not None:
        code = f"U+{ord(wrong.group()):04X}"
        raise InputError(f"the character {code} at {wrong.start()}, which is no text; remove it")
    return text


def one_line(text: object, max_length: int = MAX_LINE) -> str:
    """What is said of a file, in one line of bounded length that any terminal can show."""
    words = " ".join(str(text)[: 4 * max_length].split())
    line = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in words)
    return line if len(line) <= max_length else line[: max_length - 3] + "..."
