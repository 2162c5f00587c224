"""Headers of NRRD files: fields and key/value pairs, each once.

The format is https://teem.sourceforge.net/nrrd/format.html. Values are parsed by pynrrd, one field
at a time, so that a message can name the field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nrrd

from mvest.imaging.reading.stated import fault

__all__ = ["LONGEST_HEADER", "NrrdHeader", "read_header"]

LONGEST_HEADER = 2**20
"""Bytes within which the empty line after a header must come."""

ALIASES = {
    "centers": "centerings",
    "datafile": "data file",
    "lineskip": "line skip",
    "byteskip": "byte skip",
    "sampleunits": "sample units",
}
SPACES = {
    "lps": "left-posterior-superior",
    "ras": "right-anterior-superior",
    "las": "left-anterior-superior",
    "lpst": "left-posterior-superior-time",
    "rast": "right-anterior-superior-time",
    "last": "left-anterior-superior-time",
}
"""Short names of spaces, which are the same as the long ones."""


@dataclass(frozen=True, slots=True)
class NrrdHeader:
    """The text before the data.

    Attributes
    ----------
    path : Path
    fields : dict
        Parsed by pynrrd: numbers, arrays, lists of words.
    keys : dict of str
        Pairs ``key:=value``.
    length : int
        Bytes up to the data.
    """

    path: Path
    fields: Mapping[str, Any]
    keys: Mapping[str, str]
    length: int

    def required(self, field: str, expected: str) -> Any:
        """Value of a field that must be there."""
        if field not in self.fields:
            raise fault(self.path, field, "not stated", expected)
        return self.fields[field]


def read_header(path: Path) -> NrrdHeader:
    """Read the header of a NRRD file, attached or detached.

    A field that stands twice with one meaning (old writers repeat ``space``) counts once.

    Raises
    ------
    InputError
        No end, a line that is no field, a field that cannot be parsed, or stands twice with two
        meanings.
    """
    with path.open("rb") as file:
        head = file.read(LONGEST_HEADER)
    lines: list[str] = []
    position = 0
    while True:
        end = head.find(b"\n", position)
        if end < 0 and len(head) == LONGEST_HEADER:
            raise fault(path, "header", f"no end in {LONGEST_HEADER} bytes", "an empty line")
        line = head[position : end if end >= 0 else len(head)]
        position = end + 1 if end >= 0 else len(head)
        text = line.decode("utf-8", errors="replace").rstrip()
        if not text or end < 0:
            lines += [text] if text else []
            break
        lines.append(text)
    fields, keys = _pairs(path, lines[1:])
    return NrrdHeader(
        path,
        {field: _parsed(path, lines[0], field, value) for field, value in fields.items()},
        keys,
        position,
    )


def _pairs(path: Path, lines: list[str]) -> tuple[dict[str, str], dict[str, str]]:
    fields: dict[str, str] = {}
    keys: dict[str, str] = {}
    for line in lines:
        if line.startswith("#"):
            continue
        name, colon, value = line.partition(":")
        if not colon:
            raise fault(path, "header", f"line {line!r}", "'field: value' or 'key:=value'")
        name, where = name.strip(), fields
        if value.startswith("="):
            where, value = keys, value[1:]
        else:
            name = ALIASES.get(name.lower(), name.lower())
        value = " ".join(value.split())
        if name == "space":
            value = SPACES.get(value.lower(), value.lower())
        if where.setdefault(name, value) != value:
            raise fault(path, name, f"{where[name]!r} and {value!r}", "one value")
    return fields, keys


def _parsed(path: Path, magic: str, field: str, value: str) -> Any:
    try:
        return nrrd.read_header([magic, f"{field}: {value}"])[field]
    except Exception as error:  # pynrrd's parsers fail in many ways on a damaged value
        raise fault(path, field, f"{value!r} ({error})", "a value as NRRD defines it") from error
