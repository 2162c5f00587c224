"""JSON and YAML files as plain data: mappings, lists, text, numbers, and nothing else.

Both are of bounded size, with finite numbers and each key once. Of YAML, tags (which ask for
objects), aliases (with which a short text can grow without bound), repeated keys and endless
nesting are refused, and so are numbers that only YAML reads as such: hexadecimal, octal,
sexagesimal, with underscores.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from mvest.errors import InputError
from mvest.reading.text import MAX_TEXT, check_words, number, one_line, read_bytes, read_text

M = TypeVar("M", bound=BaseModel)
MAX_INTEGER = 2**64
"""Beyond any seed, count or size; no array of NumPy holds a larger one."""
MAX_REAL = 1.8e308


def read_mapping(path: Path, max_size: int = MAX_TEXT, where: str = "") -> dict[str, Any]:
    """The mapping that a file of JSON holds; an error calls it ``where`` or by its path.

    Raises
    ------
    InputError
        If it cannot be read, is larger than ``max_size`` bytes, holds something else, or is
        refused by `parse_json`.
    """
    data = parse_json(read_bytes(path, max_size, where), where or str(path))
    if not isinstance(data, dict):
        raise InputError(f"{where or path}: holds a {type(data).__name__}, expected a mapping")
    return data


def validated(schema: type[M], data: Any, where: str) -> M:
    """Plain data as an instance of a schema; ``where`` names them in an error.

    Raises
    ------
    InputError
        If a field is missing, or is not what the schema says.
    """
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field, found = ".".join(map(str, first["loc"])), one_line(repr(first["input"]), 60)
        raise InputError(f"{where}: {field}: {found}, expected: {first['msg']}") from error


def parse_json(content: bytes | str, where: str) -> Any:
    """What a text of JSON says; ``where`` names it in an error.

    Raises
    ------
    InputError
        If it is no JSON, repeats a key, or holds NaN, an infinity, an integer of more than 64 bits,
        or half of a surrogate pair.
    """
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
        data = json.loads(
            text,
            parse_constant=_refuse,
            parse_int=_integer,
            parse_float=_real,
            object_pairs_hook=_mapping,
        )
        if "\\u" in text:
            # Halves of surrogate pairs come from escapes only.
            json.dumps(data, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{where} is not JSON: {one_line(fault, 120)}") from fault
    return data


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


MAX_FILE_SIZE = 1_000_000
"""Bytes; a description of a case is a few thousand."""
MAX_DEPTH = 20
MAX_VALUES = 50_000
"""Of lists and mappings together; numbers of all vertices of a dozen rims are a few thousand."""

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""That of libyaml is fifty times as fast, and not everywhere."""
_INTEGER = re.compile(r"[+-]?(?:0|[1-9][0-9]*)", re.ASCII)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a file that holds one mapping.

    Raises
    ------
    InputError
        The file is missing, too large, no text, no YAML or no mapping; it uses tags or aliases,
        repeats a key, nests too deeply, or holds text or a number that no output can hold.
    """
    text = read_text(path, MAX_FILE_SIZE)
    try:
        _check_events(path, yaml.parse(text, Loader=_LOADER))
        node = yaml.compose(text, Loader=_LOADER)
    except (yaml.YAMLError, ValueError) as fault:
        # The parser reads escapes of characters that there are not.
        if isinstance(fault, InputError):
            raise
        raise InputError(f"{path}: no valid YAML: {one_line(fault, 160)}") from fault
    data = None if node is None else _plain(path, node, ())
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds a {type(data).__name__}, expected a mapping of fields")
    return data


def _check_events(path: Path, events: Iterator[Any]) -> None:
    """Refuse, before anything is built, what can grow without bound or asks for objects."""
    depth = 0
    for count, event in enumerate(events):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            wrong = "anchors and aliases are not used here; write the value out"
        elif getattr(event, "tag", None) is not None:
            wrong = f"tag {event.tag[:40]!r} asks for an object; expected plain values only"
        elif count > MAX_VALUES:
            wrong = f"more than {MAX_VALUES} values"
        elif depth > MAX_DEPTH:
            wrong = f"nested more than {MAX_DEPTH} deep"
        else:
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            continue
        raise InputError(f"{path}: line {event.start_mark.line + 1}: {one_line(wrong, 120)}")


def _plain(path: Path, node: Any, place: tuple[str, ...]) -> Any:
    """Plain data of a node; ``place`` are the keys that lead to it."""
    where = f"{path}: {one_line('.'.join(place), 80)}"
    line = node.start_mark.line + 1
    if isinstance(node, yaml.SequenceNode):
        return [_plain(path, item, (*place, str(k))) for k, item in enumerate(node.value)]
    if isinstance(node, yaml.ScalarNode):
        try:
            return _scalar(node.tag.rpartition(":")[2], node.value)
        except InputError as fault:
            raise InputError(f"{where}: found {fault} (line {line})") from fault
    mapping: dict[Any, Any] = {}
    for name, value in node.value:
        if not isinstance(name, yaml.ScalarNode):
            raise InputError(f"{path}: line {line}: a key is no single word or number")
        inner = (*place, name.value)
        key = _plain(path, name, inner)
        if key in mapping:
            line = name.start_mark.line + 1
            raise InputError(
                f"{path}: {one_line('.'.join(inner), 80)}: occurs twice (again in line {line}); "
                "keep one"
            )
        mapping[key] = _plain(path, value, inner)
    return mapping


def _scalar(kind: str, text: str) -> str | int | float | bool | None:
    match kind:
        case "null":
            return None
        case "bool":
            return bool(yaml.SafeLoader.bool_values[text.lower()])
        case "int" if not _INTEGER.fullmatch(text):
            raise InputError(f"{one_line(repr(text), 40)}, expected a decimal number")
        case "int":
            return int(number(text))
        case "float":
            return number(text)
        case "merge":
            raise InputError("a merge key; write its fields out")
        case "timestamp":
            raise InputError(f"{text!r} is a date; put text in quotes")
    return check_words(text)
