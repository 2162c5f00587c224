"""Configuration schemas made from the library's own frozen dataclasses, and back.

So a setting has one name, one type and one default, those of the library, and a misspelt or wrongly
typed override is refused by Hydra before anything is built.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

from omegaconf import MISSING

from mvest.errors import ConfigurationError
from mvest.files import sha256_of

__all__ = ["InputFile", "Reads", "build", "contents", "schema", "with_contents"]

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, slots=True)
class Reads:
    """Marks a setting that names files or folders which the study reads.

    In the hash of a configuration what lies there stands in place of its name.

    Attributes
    ----------
    contents : callable
        (value of the setting, values beside it) -> plain data that say what will be read.
    """

    contents: Callable[[Any, Mapping[str, Any]], Any]


def contents(value: Any, _beside: Mapping[str, Any] | None = None) -> Any:
    """Plain data with what lies at each path in place of its name; what cannot be read keeps it."""
    if isinstance(value, Mapping):
        return {key: contents(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [contents(item) for item in value]
    try:
        return {"sha256": sha256_of(Path(value))} if isinstance(value, str | Path) else value
    except ValueError:
        # The study says what is wrong with it.
        return str(value)


InputFile = Annotated[str | None, Reads(contents)]
"""Type of a setting that names one file or folder, all of which is read."""


def with_contents(kind: Any, value: Any, beside: Mapping[str, Any] | None = None) -> Any:
    """Values of a schema, or of one of its types, with what its settings read in their place."""
    if value is None or value == MISSING or not _may_read(kind):
        return value
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is Annotated:
        for mark in arguments[1:]:
            if isinstance(mark, Reads):
                return mark.contents(value, beside or {})
        return with_contents(arguments[0], value)
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return with_contents(arguments[0], value)
    if _is_schema(kind):
        hints = _hints(kind)
        return {k: with_contents(hints.get(k), item, value) for k, item in value.items()}
    if isinstance(value, Mapping):
        return {key: with_contents(arguments[1], item) for key, item in value.items()}
    return [with_contents(arguments[0], item) for item in value]


@cache
def _may_read(kind: Any) -> bool:
    inner = _hints(kind).values() if _is_schema(kind) else typing.get_args(kind)
    return isinstance(kind, Reads) or any(map(_may_read, inner))


def _is_schema(kind: Any) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


@cache
def _hints(cls: type) -> dict[str, Any]:
    names = {field.name for field in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls, include_extras=True)
    return {name: hint for name, hint in hints.items() if name in names}


def schema(cls: type, *more: type) -> type:
    """A mutable dataclass that OmegaConf accepts, with the fields of the frozen ``cls``.

    Tuples become lists, nested dataclasses schemas of their own; defaults are kept. ``more`` are
    mutable dataclasses whose fields are added.
    """
    hints = typing.get_type_hints(cls)
    fields: list[Any] = []
    for field in dataclasses.fields(cls):
        kind = _config_type(hints[field.name])
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            fields.append((field.name, kind, dataclasses.field(default=MISSING)))
            continue
        default = (
            field.default_factory()
            if field.default_factory is not dataclasses.MISSING
            else field.default
        )
        plain = _config_value(default)
        fields.append((field.name, kind, _field(kind, plain)))
    return dataclasses.make_dataclass(f"{cls.__name__}Config", fields, bases=more)


def _field(kind: Any, plain: Any) -> Any:
    if isinstance(plain, list):
        return dataclasses.field(default_factory=lambda: list(plain))
    if dataclasses.is_dataclass(kind):
        return dataclasses.field(default_factory=lambda: _instance(kind, plain))
    if isinstance(plain, dict):
        return dataclasses.field(default_factory=lambda: dict(plain))
    return dataclasses.field(default=plain)


def _instance(kind: Any, plain: Mapping[str, Any]) -> Any:
    """A schema with values from plain data, schemas within it included."""
    kinds = {field.name: field.type for field in dataclasses.fields(kind)}
    return kind(
        **{
            name: _instance(kinds[name], value) if dataclasses.is_dataclass(kinds[name]) else value
            for name, value in plain.items()
        }
    )


def _config_type(hint: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return schema(typing.cast(type, hint))
    if origin is tuple:
        # OmegaConf takes 1 for a float, but not within a list of lists.
        nested = typing.get_origin(arguments[0]) is tuple
        return list[Any] if nested else list[_config_type(arguments[0])]  # type: ignore[misc]
    if origin in (dict, Mapping):
        return dict[str, _config_type(arguments[1])]  # type: ignore[misc]
    if origin in (types.UnionType, typing.Union):
        return typing.Optional[_config_type(arguments[0])]  # noqa: UP045
    return hint


def _config_value(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _config_value(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_config_value(item) for item in value]
    return value


def build(cls: type[T], values: Mapping[str, Any]) -> T:
    """The frozen ``cls`` from plain data of its schema; what a schema adds is passed over.

    Raises
    ------
    ConfigurationError
        If a field without a default has no value.
    """
    hints = typing.get_type_hints(cls)
    names = [field.name for field in dataclasses.fields(typing.cast(Any, cls))]
    missing = [name for name in names if values.get(name, MISSING) == MISSING]
    if missing:
        raise ConfigurationError(f"{cls.__name__} needs a value for {', '.join(missing)}")
    return cls(**{name: _value(hints[name], values[name]) for name in names})


def _value(hint: Any, value: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if value is None:
        return None
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value)
    if origin is tuple and isinstance(value, Sequence):
        return tuple(_value(arguments[0], item) for item in value)
    if origin in (dict, Mapping) and isinstance(value, Mapping):
        return {key: _value(arguments[1], item) for key, item in value.items()}
    if origin in (types.UnionType, typing.Union):
        return _value(arguments[0], value)
    return value
