"""Reading JSON: plain data of bounded size and depth, finite numbers, each key once."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from mvest.errors import InputError
from mvest.reading.text import MAX_TEXT, number, one_line, read_bytes

MAX_DEPTH = 50
MAX_INTEGER = 2**64
"""Beyond any seed, count or size; no array of NumPy holds a larger one."""
MAX_REAL = 1.8e308


def read_json(path: Path, max_size: int = MAX_TEXT, where: str = "") -> Any:
    """What a file of JSON holds; an error calls it ``where`` or by its path.

    Raises
    ------
    InputError
        If it cannot be read or is larger than ``max_size`` bytes, is no JSON, nests too deeply,
        repeats a key, or holds NaN, an infinity, an integer of more than 64 bits, or half of a
        surrogate pair.
    """
    return parse_json(read_bytes(path, max_size, where), where or str(path))


def read_mapping(path: Path, max_size: int = MAX_TEXT, where: str = "") -> dict[str, Any]:
    """The mapping that a file of JSON holds: see `read_json`."""
    data = read_json(path, max_size, where)
    if not isinstance(data, dict):
        raise InputError(f"{where or path}: holds a {type(data).__name__}, expected a mapping")
    return data


def parse_json(content: bytes | str, where: str) -> Any:
    """What a text of JSON says; ``where`` names it in an error. See `read_json`."""
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
        data = json.loads(
            text,
            parse_constant=_refuse,
            parse_int=_integer,
            parse_float=_real,
            object_pairs_hook=_mapping,
        )
        _check_depth(data)
        if "\\u" in text:
            # Halves of surrogate pairs come from escapes only.
            json.dumps(data, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{where} is not JSON: {one_line(fault, 120)}") from fault
    return data


def _check_depth(data: Any) -> None:
    level = [data]
    for _ in range(MAX_DEPTH):
        level = [
            item
            for holder in level
            if isinstance(holder, dict | list)
            for item in (holder.values() if isinstance(holder, dict) else holder)
        ]
        if not level:
            return
    raise ValueError(f"nested more than {MAX_DEPTH} deep")


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")


def _integer(text: str) -> int:
    if len(text) > 21 or abs(int(text)) >= MAX_INTEGER:
        raise ValueError(f"integer {text[:40]} of more than 64 bits")
    return int(text)


def _real(text: str) -> float:
    return number(text, MAX_REAL)


def _mapping(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"key {next(k for k in keys if keys.count(k) > 1)[:40]!r} occurs twice")
    return mapping
