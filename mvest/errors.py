"""The one family of exceptions that a user of mvest meets.

A message says what is wrong, where (file, field, element number), and what would be right. A
computation that does not converge is no exception: it is a result whose `reason` says so.
"""

import errno
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


def cannot_write(path: Path, error: OSError) -> InputError:
    """What to raise where a file could not be written."""
    wrong_place = error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EPERM)
    hint = "; its folder must exist and be writable" if wrong_place else ""
    return InputError(f"cannot write {path}: {error.strerror or error}{hint}")
