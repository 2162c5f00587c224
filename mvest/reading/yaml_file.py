"""Reading a YAML file as plain data: mappings, lists, text, numbers, and nothing else.

Nothing is built but from the events of the parser, each looked at first. Tags (which ask for
objects), aliases (with which a short text can grow without bound), repeated keys and endless
nesting are refused, and so are numbers that only YAML reads as such: hexadecimal, octal,
sexagesimal, with underscores.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from mvest.errors import InputError
from mvest.reading.text import check_words, number, one_line, read_text

MAX_FILE_SIZE = 1_000_000
"""Bytes; a description of a case is a few thousand."""
MAX_DEPTH = 20
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
        if depth >= MAX_DEPTH:
            raise self._wrong(event, f"nested more than {MAX_DEPTH} deep")
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
