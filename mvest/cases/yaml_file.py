"""Reading a YAML file as plain data: mappings, lists, text, numbers, and nothing else.

The text is looked through before anything is built from it. Tags (which ask for objects), aliases
(with which a short text can grow without bound), repeated keys and endless nesting are refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from mvest.errors import InputError

__all__ = ["read_yaml"]

MAX_FILE_SIZE = 1_000_000
"""Bytes; a description of a case is a few thousand."""
DEEPEST_NESTING = 20


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a file that holds one mapping.

    Raises
    ------
    InputError
        The file is missing, too large, no text, no YAML or no mapping; it uses tags or aliases,
        repeats a key, or nests too deeply.
    """
    try:
        content = path.read_bytes()
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror or fault}") from fault
    if len(content) > MAX_FILE_SIZE:
        raise InputError(f"{path}: {len(content)} bytes, expected at most {MAX_FILE_SIZE}")
    try:
        text = content.decode("utf-8")
        _check_events(path, text)
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        _check_keys(path, root, "")
        data = yaml.safe_load(text)
    except UnicodeDecodeError as fault:
        raise InputError(f"{path}: byte {fault.start} is no UTF-8 text") from fault
    except (yaml.YAMLError, ValueError) as fault:
        # A ValueError comes from a scalar that only looks like a date.
        if isinstance(fault, InputError):
            raise
        raise InputError(f"{path}: no valid YAML: {' '.join(str(fault).split())}") from fault
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds a {type(data).__name__}, expected a mapping of fields")
    return data


def _check_events(path: Path, text: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        line = f"{path}: line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise InputError(f"{line}: anchors and aliases are not used here; write the value out")
        tag = getattr(event, "tag", None)
        if tag is not None:
            raise InputError(f"{line}: tag {tag!r} asks for an object; expected plain values only")
        depth += isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent)
        depth -= isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent)
        if depth > DEEPEST_NESTING:
            raise InputError(f"{line}: nested more than {DEEPEST_NESTING} deep")


def _check_keys(path: Path, node: yaml.Node | None, field: str) -> None:
    if isinstance(node, yaml.SequenceNode):
        for number, item in enumerate(node.value):
            _check_keys(path, item, f"{field}{number}.")
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                line = key.start_mark.line + 1
                raise InputError(f"{path}: line {line}: a key is no single word or number")
            if key.value in seen:
                raise InputError(
                    f"{path}: {field}{key.value}: occurs twice (again in line "
                    f"{key.start_mark.line + 1}); keep one"
                )
            seen.add(key.value)
            _check_keys(path, value, f"{field}{key.value}.")
