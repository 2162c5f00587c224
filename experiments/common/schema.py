"""Configuration schemas made from frozen dataclasses of the library and the studies, and back.

A setting has one name, one type, one default and one range, and all of them stand where it is
declared. A misspelt, wrongly typed or inadmissible override is refused before anything is built.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

from omegaconf import MISSING
from pydantic.fields import FieldInfo

from mvest.errors import ConfigurationError, InputError
from mvest.files import sha256_of
from mvest.reading.text import check_words

T = TypeVar("T")
Values: TypeAlias = Mapping[str, Any]
"""Plain data of a configuration, or of a part of it."""

MAX_ENTRIES, MAX_LETTERS = 10_000, 10_000
"""Of a list or mapping, and of a text."""

LARGEST = 1e15
"""Of a number whose type has no range: a factor of a sweep, a setting of another program."""


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


@dataclasses.dataclass(frozen=True, slots=True)
class Mark:
    """Marks a setting; see `NOT_HASHED` and `BY_PARAMETER`."""

    name: str


NOT_HASHED = Mark("not hashed")
"""Of a setting that changes no number of a result, and stays out of its hash."""

BY_PARAMETER = Mark("by parameter")
"""Of values that are named by parameters, and in the range of what those are."""


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
    """Values of a schema, or of one of its types, with what its settings read in their place.

    Equal numbers become alike, so that 1 and 1.0 are one setting in a hash: in a float, and where a
    type states no more than a range, they are floats, and in what has no type whole ones are ints.
    """
    if value is None or value == MISSING or not _may_change(kind):
        return value
    given, (kind, marks) = kind, _unwrapped(kind)
    for mark in marks:
        if isinstance(mark, Reads):
            return mark.contents(value, beside or {})
    if isinstance(value, int | float) and not isinstance(value, bool):
        if kind is float or (kind is Any and any(isinstance(m, FieldInfo) for m in marks)):
            return float(value)
        return int(value) if kind is Any and float(value).is_integer() else value
    if isinstance(value, Mapping):
        return {k: with_contents(hint, item, value) for k, hint, item in _parts(given, value)}
    if isinstance(value, list | tuple):
        return [with_contents(hint, item) for _, hint, item in _parts(given, value)]
    return value


def _parts(given: Any, value: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Name, type and value of each part of a mapping or list; without its own, the whole's type."""
    kind, _ = _unwrapped(given)
    inner = typing.get_args(kind) or (given,)
    if isinstance(value, Mapping):
        hints = hints_of(kind) if _is_schema(kind) else {}
        other = None if hints else inner[-1]
        yield from ((name, hints.get(name, other), part) for name, part in value.items())
    else:
        yield from ((None, inner[0], part) for part in value)


@cache
def _may_change(kind: Any) -> bool:
    inner = hints_of(kind).values() if _is_schema(kind) else typing.get_args(kind)
    return kind in (Any, float) or isinstance(kind, Reads) or any(map(_may_change, inner))


def _is_schema(kind: Any) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


@cache
def hints_of(cls: type) -> dict[str, Any]:
    """Types of the fields of a dataclass, with their marks."""
    names = {field.name for field in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls, include_extras=True)
    return {name: hint for name, hint in hints.items() if name in names}


def _unwrapped(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its marks and without None, and the marks."""
    marks: tuple[Any, ...] = ()
    while True:
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
        if origin is Annotated:
            kind, marks = arguments[0], (*marks, *arguments[1:])
        elif origin in (types.UnionType, typing.Union):
            kind = next(one for one in arguments if one is not types.NoneType)
        else:
            return kind, marks


def without(values: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Nested values without those of the dotted names."""
    kept = {key: value for key, value in values.items() if key not in names}
    for name in names:
        part, _, inner = name.partition(".")
        if inner and isinstance(kept.get(part), Mapping):
            kept[part] = without(kept[part], (inner,))
    return kept


def marks_in(kind: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names of the settings of a schema with each mark; names within mappings are ``*``."""
    kind, marks = _unwrapped(kind)
    yield from ((key, mark) for mark in marks)
    if _is_schema(kind):
        for name, hint in hints_of(kind).items():
            yield from marks_in(hint, f"{key}.{name}".lstrip("."))
    elif typing.get_origin(kind) in (dict, Mapping):
        yield from marks_in(typing.get_args(kind)[1], f"{key}.*")
    else:
        for part in typing.get_args(kind):
            yield from marks_in(part, key)


def ranges(kind: Any) -> list[tuple[str, FieldInfo]]:
    """Dotted names of all settings of a schema with a range."""
    return [(key, mark) for key, mark in marks_in(kind) if isinstance(mark, FieldInfo)]


def require_admissible_values(
    kind: Any,
    value: Any,
    key: str = "",
    by_parameter: Callable[[str], FieldInfo | None] = lambda name: None,
) -> None:
    """Refuse values of a schema with a number outside its range, or a text that is none.

    Parameters
    ----------
    kind : type
    value : plain data
    key : str
        Dotted name of the value.
    by_parameter : callable
        Name of a parameter -> its range, for settings marked `BY_PARAMETER`.

    Raises
    ------
    ConfigurationError
        One line with the setting, its value and the range.
    """
    given, (kind, marks) = kind, _unwrapped(kind)
    within = next((mark for mark in marks if isinstance(mark, FieldInfo)), None)
    if value is None or isinstance(value, bool):
        return
    if isinstance(value, int | float):
        require_within(key, value, within)
    elif value == MISSING:
        raise ConfigurationError(f"{key} has no value")
    elif isinstance(value, str):
        try:
            check_words(value, MAX_LETTERS)
        except InputError as error:
            raise ConfigurationError(f"{key} has {error}") from error
    elif len(value) > MAX_ENTRIES:
        raise ConfigurationError(f"{key} has {len(value)} entries, expected at most {MAX_ENTRIES}")
    else:
        for name, hint, part in _parts(given, value):
            own = by_parameter(str(name)) if BY_PARAMETER in marks else None
            inner = hint if own is None else Annotated[Any, own]
            whole = key if name is None else f"{key}.{name}".lstrip(".")
            require_admissible_values(inner, part, whole, by_parameter)


def require_within(key: str, value: float, within: FieldInfo | None) -> None:
    """Refuse a number outside a range; without a range, one that no setting has.

    Raises
    ------
    ConfigurationError
        One line with the setting, its value and the range.
    """
    bounds = {} if within is None else {type(one).__name__: one for one in within.metadata}
    low = bounds["Ge"].ge if "Ge" in bounds else -LARGEST
    high = bounds["Le"].le if "Le" in bounds else LARGEST
    if not low <= value <= high:
        unit, _, why = ((within and within.description) or "").rpartition("; ")
        text = f"{key} = {value:.10g}, expected {low:.10g} to {high:.10g} {unit}".rstrip()
        raise ConfigurationError(text + (f" ({why})" if why else ""))


@cache
def schema(*classes: type) -> type:
    """A mutable dataclass that OmegaConf accepts, with the fields of frozen dataclasses.

    Tuples become lists, nested dataclasses schemas of their own; defaults are kept.
    """
    fields: dict[str, Any] = {}
    for cls in classes:
        hints = typing.get_type_hints(cls)
        for field in dataclasses.fields(cls):
            kind = _config_type(hints[field.name])
            default = dataclasses.field(default_factory=partial(_default, field, kind))
            fields[field.name] = (field.name, kind, default)
    return dataclasses.make_dataclass(f"{classes[0].__name__}Config", list(fields.values()))


def _default(field: dataclasses.Field[Any], kind: Any) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return _config_value(field.default_factory())
    if field.default is dataclasses.MISSING:
        return kind() if _is_schema(kind) else MISSING
    return _config_value(field.default)


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
        parts = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return schema(type(value))(**{name: _config_value(part) for name, part in parts.items()})
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
    hints = hints_of(typing.cast(Any, cls))
    missing = [name for name in hints if values.get(name, MISSING) == MISSING]
    if missing:
        raise ConfigurationError(f"{cls.__name__} needs a value for {', '.join(missing)}")
    return cls(**{name: _value(hint, values[name]) for name, hint in hints.items()})


def _value(hint: Any, value: Any) -> Any:
    kind, _ = _unwrapped(hint)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if value is None:
        return None
    if _is_schema(kind):
        return build(kind, value)
    if origin is tuple and isinstance(value, Sequence):
        return tuple(_value(arguments[0], item) for item in value)
    if origin in (dict, Mapping) and isinstance(value, Mapping):
        return {key: _value(arguments[1], item) for key, item in value.items()}
    return value
