"""Reads JSON and YAML files of bounded size as mappings, lists, text and finite numbers.

YAML tags (which create objects), aliases (which let a short text grow without bound), repeated keys
and deep nesting raise an error. Only decimal literals are numbers; hexadecimal, octal and
sexagesimal literals, those with underscores, and dates are text.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from mvest.errors import InputError
from mvest.reading.text import MAX_TEXT, check_words, number, one_line, read_bytes, read_text

M = TypeVar("M", bound=BaseModel)


def read_mapping(path: Path, max_size: int = MAX_TEXT, where: str = "") -> dict[str, Any]:
    """Read the mapping in a JSON file; ``where`` names it in errors (default: its path).

    InputError if the file cannot be read, is larger than ``max_size`` bytes, or holds something
    else.
    """
    data = parse_json(read_bytes(path, max_size, where), where or str(path))
    if not isinstance(data, dict):
        raise InputError(f"{where or path}: holds a {type(data).__name__}, expected a mapping")
    return data


def validated(schema: type[M], data: Any, where: str) -> M:
    """Convert plain data to an instance of a schema; ``where`` names the data in errors.

    InputError if a field is missing, or does not fit the schema.
    """
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field, found = ".".join(map(str, first["loc"])), one_line(repr(first["input"]), 60)
        raise InputError(f"{where}: {field}: {found}, expected: {first['msg']}") from error


def parse_json(content: bytes | str, where: str) -> Any:
    """Parse JSON text; ``where`` names it in errors.

    InputError if the text is not JSON, or contains NaN, an infinity, or half of a surrogate pair.
    """
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
        data = json.loads(text)
        # Python reads NaN, 1e999 and halves of surrogate pairs, but cannot write them.
        json.dumps(data, ensure_ascii=False, allow_nan=False).encode()
        return data
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{where} is not JSON: {one_line(fault, 120)}") from fault


MAX_FILE_SIZE = 1_000_000
"""Largest YAML file (bytes); a case has a few thousand."""
MAX_DEPTH = 20
MAX_VALUES = 50_000
"""Largest number of values; a case with a dozen lists of vertices has a few thousand."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Plain values and unique keys. libyaml's loader, if installed, is fifty times as fast."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            lines = {key.value: key.start_mark.line + 1 for key, _ in node.value}
            ((twice, _),) = Counter(key.value for key, _ in node.value).most_common(1)
            raise InputError(
                f"{one_line(twice, 80)}: occurs twice (again in line {lines[twice]}); keep one"
            )
        return mapping

    def construct_plain(self, node: Any) -> str | float:
        """A bounded number or text."""
        kind, text = node.tag.rpartition(":")[2], node.value
        try:
            if kind == "str":
                return check_words(text)
            return int(number(text)) if kind == "int" else number(text)
        except InputError as fault:
            raise InputError(f"line {node.start_mark.line + 1}: found {fault}") from fault


_TAG = "tag:yaml.org,2002:"
_Loader.yaml_implicit_resolvers = {
    first: [one for one in known if one[0] in (f"{_TAG}bool", f"{_TAG}null")]
    for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.yaml_constructors = {
    tag: construct
    for tag, construct in yaml.SafeLoader.yaml_constructors.items()
    if tag in (None, *(_TAG + kind for kind in ("bool", "null", "seq", "map")))
}
for _kind, _pattern in (
    ("int", r"[-+]?(?:0|[1-9][0-9]*)$"),
    ("float", r"(?:[-+]?[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+][0-9]+)?$"),
):
    _Loader.add_implicit_resolver(_TAG + _kind, re.compile(_pattern), list("-+.0123456789"))
for _kind in ("str", "int", "float"):
    _Loader.add_constructor(_TAG + _kind, _Loader.construct_plain)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a file that holds one mapping.

    InputError if the file is missing, too large, or not a YAML mapping; or it has tags, aliases,
    repeated keys, deep nesting, or text or numbers beyond the bounds.
    """
    text = read_text(path, MAX_FILE_SIZE)
    try:
        _check_events(yaml.parse(text, Loader=_Loader))
        data = yaml.load(text, Loader=_Loader)
    except InputError as fault:
        raise InputError(f"{path}: {fault}") from fault
    except (yaml.YAMLError, ValueError) as fault:
        # ValueError: an invalid escape.
        raise InputError(f"{path}: no valid YAML: {one_line(fault, 160)}") from fault
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds a {type(data).__name__}, expected a mapping of fields")
    return data


def _check_events(events: Iterator[Any]) -> None:
    """Reject content that may grow without bound, before building anything."""
    depth = 0
    for count, event in enumerate(events):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            wrong = "anchors and aliases are not used here; write the value out"
        elif count > MAX_VALUES:
            wrong = f"more than {MAX_VALUES} values"
        elif depth > MAX_DEPTH:
            wrong = f"nested more than {MAX_DEPTH} deep"
        else:
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            continue
        raise InputError(f"line {event.start_mark.line + 1}: {wrong}")
