"""The one family of exceptions that a user of mvest meets.

A message says what is wrong, where (file, field, element number), and what would be right. A
computation that does not converge is no exception: it is a result whose `reason` says so.
"""

import errno
import math
from pathlib import Path


class MvestError(ValueError):
    """Root of everything that mvest raises on purpose."""


class InputError(MvestError):
    """A value, an array or a file is not what it must be."""


class GeometryError(InputError):
    """A surface, a mesh or a valve is inadmissible: inverted, open, non-manifold, disconnected."""


class MaterialError(InputError):
    """Material parameters describe no stable elastic solid."""


class ConfigurationError(InputError):
    """An experiment's settings contradict each other or name something that does not exist."""


class MeshingError(MvestError):
    """An admissible surface could not be filled with an admissible mesh."""


def message_of(error: BaseException) -> str:
    """What an error says: one of a file with its name, one that nobody foresaw with its type."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    text, kind = str(error).strip(), type(error).__name__
    if isinstance(error, MvestError | OSError | MemoryError):
        return text or kind
    return f"{kind}: {text}"


def require_numbers(owner: object, what: str, *names: str, least: float | None = None) -> None:
    """Raise InputError where an attribute is no finite number above 0, or of at least ``least``.

    Parameters
    ----------
    owner : object
    what : str
        What the owner is, for the message.
    names : str
        Of the attributes.
    least : float, optional
    """
    expected = "> 0" if least is None else f">= {least:g}"
    for name in names:
        value = getattr(owner, name)
        if not math.isfinite(value) or (value <= 0 if least is None else value < least):
            raise InputError(f"{what} {name} = {value}, expected {expected}")


def cannot_write(path: Path, error: OSError) -> InputError:
    """What to raise where a file could not be written."""
    wrong_place = error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EPERM)
    hint = "; its folder must exist and be writable" if wrong_place else ""
    return InputError(f"cannot write {path}: {error.strerror or error}{hint}")
