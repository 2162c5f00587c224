"""Hydra schemas made from frozen dataclasses of the library and the studies, and back.

A setting has one name, type, default and range, all given where it is declared. A misspelt, wrongly
typed or inadmissible override is refused before anything is built.
"""

import dataclasses
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import AfterValidator, TypeAdapter, ValidationError

from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.files import sha256_of
from mvest.problem.registration import range_of
from mvest.quantities import OutsideError
from mvest.reading.text import check_words

T = TypeVar("T")
# Plain data of a configuration, or of a part of it.
Values: TypeAlias = Mapping[str, Any]
MAX_LETTERS = 10_000  # longest text of a setting
LARGEST = 1e15  # largest number of a setting whose type has no range
# Marks a setting that changes no number of a result; it is left out of the hash.
NOT_HASHED = "not hashed"


@dataclasses.dataclass(frozen=True, slots=True)
class Reads:
    """Marks a setting that names files or folders which the study reads.

    The hash of a configuration uses their content, not their names: ``contents`` maps the value of
    the setting and its neighbouring values to plain data that identify the content.
    """

    contents: Callable[[Any, Values], Any]


def _in_their_ranges(values: dict[str, float]) -> dict[str, float]:
    for name, value in values.items():
        if (within := range_of(name)) is not None:
            within.check(value, f".{name}")
    return values


BY_PARAMETER = AfterValidator(_in_their_ranges)
"""Marks a mapping from parameters to values; each value must be in its parameter's range."""


def contents(value: Any, _beside: Values | None = None) -> Any:
    """Plain data in which the SHA-256 of each readable file replaces its name."""
    if isinstance(value, Mapping):
        return {key: contents(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [contents(item) for item in value]
    try:
        return {"sha256": sha256_of(Path(value))} if isinstance(value, str | Path) else value
    except ValueError:
        return str(value)  # the study reports what is wrong with it


InputFile = Annotated[str | None, Reads(contents)]
"""Type of a setting that names one file or folder, all of which is read."""


def with_contents(kinds: Mapping[str, Any], values: Values, *, hashed: bool) -> dict[str, Any]:
    """Values with file contents in place of names, and whole numbers as ints.

    So 1 and 1.0 are one setting in a hash. ``kinds`` maps settings to types with their marks;
    ``hashed`` leaves out settings that change no result.
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        kind, marks = parts_of(kinds.get(name, Any))
        if hashed and NOT_HASHED in marks:
            continue
        for mark in marks:
            if isinstance(mark, Reads) and value not in (None, MISSING):
                value = mark.contents(value, values)
        inner = kinds_in(kind, value) if isinstance(value, Mapping) else {}
        # Marks count in dataclasses only; in a mapping by name every setting is hashed.
        within = hashed and dataclasses.is_dataclass(kind)
        found[name] = with_contents(inner, value, hashed=within) if inner else _whole(value)
    return found


def parts_of(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """The type of a setting without None, and its marks."""
    marks: tuple[Any, ...] = ()
    if typing.get_origin(kind) is Annotated:
        kind, *rest = typing.get_args(kind)
        marks = tuple(rest)
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        kind = next(one for one in typing.get_args(kind) if one is not types.NoneType)
    return kind, marks


def kinds_in(kind: Any, names: Iterable[str]) -> dict[str, Any]:
    """Setting -> type within a dataclass, or within a mapping that has these names."""
    if dataclasses.is_dataclass(kind):
        return hints_of(typing.cast(type, kind))
    is_mapping = typing.get_origin(kind) in (dict, Mapping)
    return dict.fromkeys(names, typing.get_args(kind)[1]) if is_mapping else {}


def _whole(value: Any) -> Any:
    """Plain data with whole numbers as ints."""
    if isinstance(value, Mapping):
        return {key: _whole(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


@cache
def hints_of(cls: type) -> dict[str, Any]:
    """Types of the fields of a dataclass, with their marks."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


_adapter = cache(TypeAdapter)


def validated(kind: Any, value: Any, key: str = "") -> Any:
    """A value of a type from plain data; names that a dataclass does not have are ignored.

    ``key`` is the dotted name of the value. Raises an `MvestError`: one line with the setting, its
    value and what is admissible.
    """
    try:
        return _adapter(kind).validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        own = first.get("ctx", {}).get("error")
        if isinstance(own, MvestError) and not isinstance(own, OutsideError):
            raise own from error  # raised by a dataclass itself
        *_, last = place = [key, *first["loc"]]
        name = ".".join(part for part in place if isinstance(part, str) and part)
        given, fault = first["input"], first["type"]
        if own is not None:
            text = str(own)
        elif given == MISSING or (fault == "missing" and isinstance(last, str)):
            text = " has no value"
        elif fault == "literal_error":
            text = f" = {given!r}, expected {first['ctx']['expected'].replace(chr(39), '')}"
        else:
            text = f" = {given!r}: {first['msg']}"
        raise ConfigurationError(f"{name}{text}") from error


def build(cls: type[T], values: Values) -> T:
    """The frozen ``cls`` from plain data of its schema (see `validated`)."""
    return typing.cast(T, validated(cls, values))


def from_words(command: str, cls: type[T], words: Sequence[str], others: Sequence[str] = ()) -> T:
    """The frozen ``cls`` from words NAME=VALUE of a command, with values as in YAML.

    Raises an `MvestError` for a word of another form, an unknown name (the message lists the known
    ones and the ``others`` of the command), or an inadmissible value.
    """
    defaults = OmegaConf.structured(schema(typing.cast(Any, cls)))
    for word in words:
        if "=" not in word:
            raise ConfigurationError(f"{word}: expected NAME=VALUE")
    try:
        merged = OmegaConf.merge(defaults, OmegaConf.from_dotlist(list(words)))
    except OmegaConfBaseException as error:
        known = ", ".join([*others, *map(str, defaults)])
        fault = str(error).partition("\n")[0]
        raise ConfigurationError(f"{command}: {fault}; known are {known}") from error
    return build(cls, typing.cast("dict[str, Any]", OmegaConf.to_container(merged)))


def defaults_of(cls: type) -> str:
    """The settings of a frozen dataclass and their defaults, as YAML for a help text."""
    text = OmegaConf.to_yaml(OmegaConf.structured(schema(cls)))
    return "Defaults:\n" + "".join(f"  {line}\n" for line in text.splitlines())


def require_admissible_values(kind: Any, value: Any, key: str = "") -> None:
    """Raise an `MvestError` for a number outside its range, or an unusable text."""
    validated(kind, value, key)
    _require_plain(value, key)


def _require_plain(value: Any, key: str) -> None:
    """Refuse missing values, texts with control characters, and numbers that are not finite."""
    if value == MISSING:
        raise ConfigurationError(f"{key} has no value")
    if isinstance(value, str):
        try:
            check_words(value, MAX_LETTERS)
        except InputError as error:
            raise ConfigurationError(f"{key} has {error}") from error
    elif isinstance(value, Mapping | list | tuple):
        named = value.items() if isinstance(value, Mapping) else (("", part) for part in value)
        for name, part in named:
            _require_plain(part, ".".join(filter(None, (key, str(name)))))
    elif isinstance(value, int | float) and not abs(value) <= LARGEST:
        raise ConfigurationError(
            f"{key} = {value:.10g}, expected {-LARGEST:.10g} to {LARGEST:.10g}"
        )


@cache
def schema(*classes: type, part: str = "") -> type:
    """A mutable dataclass that OmegaConf accepts, with the fields of frozen dataclasses.

    Tuples become lists, and nested dataclasses schemas of their own. Defaults are the same. With
    ``part`` the last class is not joined to the others, but a field of this name.
    """
    fields: dict[str, Any] = {}
    if part:
        own = schema(classes[-1])
        fields[part] = (part, own, dataclasses.field(default_factory=own))
    for cls in classes[:-1] if part else classes:
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
        return kind() if isinstance(kind, type) and dataclasses.is_dataclass(kind) else MISSING
    return _config_value(field.default)


def _config_type(hint: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return schema(typing.cast(type, hint))
    if origin is tuple:
        # OmegaConf takes 1 for a float, but not within a list of lists.
        nested = typing.get_origin(arguments[0]) is tuple
        return list[Any] if nested else list[_config_type(arguments[0])]  # type: ignore[misc]
    if origin is typing.Literal:
        return str
    if origin in (dict, Mapping):
        return dict[str, _config_type(arguments[1])]  # type: ignore[misc]
    if origin in (types.UnionType, typing.Union):
        return typing.Optional[_config_type(arguments[0])]  # noqa: UP045
    return hint


def _config_value(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {f.name: _config_value(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return schema(type(value))(**parts)
    return [_config_value(item) for item in value] if isinstance(value, tuple) else value
