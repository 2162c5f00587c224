"""The exceptions of mvest.

A message names the place (file, field, element number), the value found and the value expected. A
computation that does not converge raises nothing; the `reason` of its result says so.
"""

import errno
import math
from collections.abc import Sequence
from pathlib import Path


class MvestError(ValueError):
    """Base class of all errors that mvest raises on purpose."""


class InputError(MvestError):
    """A value, an array or a file is invalid."""


class GeometryError(InputError):
    """A surface, a mesh or a valve is inadmissible: inverted, open, non-manifold, disconnected."""


class CrossingError(GeometryError):
    """Triangles of a surface pass through each other."""

    def __init__(self, message: str, vertices: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.vertices = vertices  #: numbers of some of their corners


class MaterialError(InputError):
    """Material parameters describe no stable elastic solid."""


class ConfigurationError(InputError):
    """An experiment's settings contradict each other or name something that does not exist."""


class MeshingError(MvestError):
    """An admissible surface could not be filled with an admissible mesh."""


def message_of(error: BaseException) -> str:
    """The text of an error, with the name of its file, or with its type if it is unexpected."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    text, kind = str(error).strip(), type(error).__name__
    if isinstance(error, MvestError | OSError | MemoryError):
        return text or kind
    return f"{kind}: {text}"


def require_numbers(owner: object, what: str, *names: str, least: float | None = None) -> None:
    """Raise an InputError unless all attributes ``names`` are finite and > 0, or >= ``least``.

    ``what`` describes the owner in the message.
    """
    expected = "> 0" if least is None else f">= {least:g}"
    for name in names:
        value = getattr(owner, name)
        if not math.isfinite(value) or (value <= 0 if least is None else value < least):
            raise InputError(f"{what} {name} = {value}, expected {expected}")


def cannot_write(path: Path, error: OSError) -> InputError:
    """The error to raise if a file could not be written."""
    wrong_place = error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EPERM)
    hint = "; its folder must exist and be writable" if wrong_place else ""
    return InputError(f"cannot write {path}: {error.strerror or error}{hint}")
