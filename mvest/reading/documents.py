"""JSON and YAML files as plain data: mappings, lists, text, numbers, and nothing else.

Both are of bounded size and depth, with finite numbers and each key once.

Of YAML nothing is built but from the events of the parser, each looked at first. Tags (which ask
for objects), aliases (with which a short text can grow without bound), repeated keys and endless
nesting are refused, and so are numbers that only YAML reads as such: hexadecimal, octal,
sexagesimal, with underscores.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import yaml

from mvest.errors import InputError
from mvest.reading.text import MAX_TEXT, check_words, number, one_line, read_bytes, read_text

MAX_JSON_DEPTH = 50
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
    for _ in range(MAX_JSON_DEPTH):
        level = [
            item
            for holder in level
            if isinstance(holder, dict | list)
            for item in (holder.values() if isinstance(holder, dict) else holder)
        ]
        if not level:
            return
    raise ValueError(f"nested more than {MAX_JSON_DEPTH} deep")


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
MAX_YAML_DEPTH = 20
MAX_VALUES = 50_000
"""Of lists and mappings together; numbers of all vertices of a dozen rims are a few thousand."""

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""That of libyaml is fifty times as fast, and not everywhere."""
_RESOLVER = yaml.resolver.Resolver()
_KIND = "tag:yaml.org,2002:"
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
        data = _Document(path, yaml.parse(text, Loader=_LOADER)).read()
    except (yaml.YAMLError, ValueError) as fault:
        # The parser reads escapes of characters that there are not.
        if isinstance(fault, InputError):
            raise
        raise InputError(f"{path}: no valid YAML: {one_line(fault, 160)}") from fault
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds a {type(data).__name__}, expected a mapping of fields")
    return data


class _Document:
    """The one document of a file, from its events."""

    def __init__(self, path: Path, events: Iterator[yaml.Event]) -> None:
        self._path, self._events = path, events
        self._values = 0

    def read(self) -> Any:
        """Its plain data; None if there is none."""
        event = self._next()
        while isinstance(event, yaml.StreamStartEvent | yaml.DocumentStartEvent):
            event = self._next()
        if isinstance(event, yaml.StreamEndEvent):
            return None
        data = self._value(event, "", 0)
        self._next()
        event = self._next()
        if not isinstance(event, yaml.StreamEndEvent):
            raise self._wrong(event, "a second document; expected one")
        return data

    def _next(self) -> Any:
        event = next(self._events)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise self._wrong(event, "anchors and aliases are not used here; write the value out")
        tag = getattr(event, "tag", None)
        if tag is not None:
            raise self._wrong(
                event, f"tag {tag[:40]!r} asks for an object; expected plain values only"
            )
        return event

    def _value(self, event: Any, field: str, depth: int) -> Any:
        self._values += 1
        if self._values > MAX_VALUES:
            raise self._wrong(event, f"more than {MAX_VALUES} values")
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event, field)
        if depth >= MAX_YAML_DEPTH:
            raise self._wrong(event, f"nested more than {MAX_YAML_DEPTH} deep")
        inner = f"{field}." if field else ""
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Any] = []
            while not isinstance(event := self._next(), yaml.SequenceEndEvent):
                items.append(self._value(event, f"{inner}{len(items)}", depth + 1))
            return items
        mapping: dict[Any, Any] = {}
        while not isinstance(event := self._next(), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                raise self._wrong(event, "a key is no single word or number")
            key, name = self._scalar(event, inner + event.value), inner + event.value
            if key in mapping:
                line = event.start_mark.line + 1
                raise InputError(
                    f"{self._path}: {one_line(name, 80)}: occurs twice (again in line {line}); "
                    "keep one"
                )
            mapping[key] = self._value(self._next(), name, depth + 1)
        return mapping

    def _scalar(self, event: yaml.ScalarEvent, field: str) -> str | int | float | bool | None:
        text = event.value
        tag = _RESOLVER.resolve(yaml.ScalarNode, text, event.implicit).removeprefix(_KIND)
        try:
            if tag == "null":
                return None
            if tag == "bool":
                return bool(yaml.SafeLoader.bool_values[text.lower()])
            if tag == "int":
                if not _INTEGER.fullmatch(text):
                    raise InputError(f"{one_line(repr(text), 40)}, expected a decimal number")
                return int(number(text))
            if tag == "merge":
                raise InputError("a merge key; write its fields out")
            if tag == "timestamp":
                raise InputError(f"{text!r} is a date; put text in quotes")
            return number(text) if tag == "float" else check_words(text)
        except InputError as fault:
            line = event.start_mark.line + 1
            raise InputError(
                f"{self._path}: {one_line(field, 80)}: found {fault} (line {line})"
            ) from fault

    def _wrong(self, event: Any, what: str) -> InputError:
        return InputError(f"{self._path}: line {event.start_mark.line + 1}: {what}")
