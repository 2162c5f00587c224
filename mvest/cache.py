"""A cache on disk for expensive results, and keys of the code that makes them.

Beside each entry lies its digest, ``.NAME.sha256``. An entry without it, or that does not match it,
was not written under this name as it is; it is made again, even if its reader accepts it.

Any change of the code of `mvest` makes all entries anew; for a maker outside `mvest` its own
package counts as well. Files of data and settings are not code: callers describe them.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

import numpy as np

from mvest.errors import InputError, cannot_write
from mvest.files import remove_parts, sha256_of, write_atomically

T = TypeVar("T")

DAMAGE = (OSError, ValueError, LookupError, TypeError)
"""What readers raise for a file that a broken disk or a user has changed."""


@dataclass(frozen=True, slots=True)
class Entry(Generic[T]):
    """A cached file or folder, which is there whole or not at all.

    Attributes
    ----------
    path : Path
        Named by everything that decides its content.
    read : callable
        Reads a path; refuses what is damaged.
    remake : bool
        Whether a damaged entry is made again. One that cannot be reproduced is refused instead.
    """

    path: Path
    read: Callable[[Path], T]
    remake: bool = True

    def found(self) -> T | None:
        """The cached value; None if there is none, or a damaged one that can be made again."""
        if not self.path.exists():
            return None
        try:
            # What cannot be made again holds its digest itself, which its reader checks.
            if self.remake and self._digest(self.path) != self.seal.read_text(encoding="utf-8"):
                return None
            return self.read(self.path)
        except DAMAGE:
            if not self.remake:
                raise
            return None

    @property
    def seal(self) -> Path:
        """The file of its digest."""
        return self.path.with_name(f".{self.path.name}.sha256")

    def _digest(self, path: Path) -> str:
        """Digest of the content and the name: an entry that was moved is another one."""
        about = f"{self.path.parent.name}/{self.path.name} {sha256_of(path)}"
        return hashlib.sha256(about.encode()).hexdigest()

    def get_or_make(
        self,
        make: Callable[[], Any],
        write: Callable[[Path, Any], object],
        keep: Callable[[Any], bool] = lambda _: True,
    ) -> T:
        """The cached value, made now if there is none: see :func:`get_or_make`."""
        return get_or_make([self], lambda _: [make()], write, keep)[0]

    def keep(self, value: Any, write: Callable[[Path, Any], object]) -> T:
        """Cache a value; returns what others will read."""
        write_atomically(self.path, lambda part: write(part, value), sync=True)
        # A process that dies in between leaves an entry without its digest, which is made again.
        write_atomically(self.seal, self._digest(self.path))
        return self.read(self.path)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Let one of several processes in; the others wait."""
        import filelock  # which takes longer to import than all else here

        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(self.path.with_name(f".{self.path.name}.lock"))
            lock.acquire()
        except OSError as error:
            raise cannot_write(self.path, error) from error
        try:
            yield
        finally:
            lock.release()


def get_or_make(
    entries: Sequence[Entry[T]],
    make: Callable[[list[int]], Iterable[Any]],
    write: Callable[[Path, Any], object],
    keep: Callable[[Any], bool] = lambda _: True,
) -> list[T]:
    """The cached values of entries; missing ones are made together.

    Of several processes that need the same entries, the first makes them and the others wait.

    Parameters
    ----------
    entries : sequence of Entry
    make : callable
        Numbers of entries -> their values, one after another; each is cached as it comes.
    write : callable
        Writes a value to a path, as a file or as a folder.
    keep : callable
        Whether a value is cached. One that is not is returned as it is.

    Returns
    -------
    list
        What was read from the cache, also right after it was made.

    Raises
    ------
    InputError
        If the cache cannot be written.
    """
    values: list[Any] = [entry.found() for entry in entries]
    left = [k for k, value in enumerate(values) if value is None]
    with ExitStack() as locks:
        # In one order, so that no two processes wait for each other.
        for _, entry in sorted({entries[k].path: entries[k] for k in left}.items()):
            locks.enter_context(entry.alone())
        for k in left:
            values[k] = entries[k].found()
        left = [k for k in left if values[k] is None]
        for entry in (entries[k] for k in left):
            remove_parts(entry.path.parent, entry.path.name)
            if entry.path.exists():
                print(f"note: {entry.path} is damaged and is made again", file=sys.stderr)
        for k, value in zip(left, make(left) if left else (), strict=True):
            values[k] = entries[k].keep(value, write) if keep(value) else value
    return values


@functools.cache
def code_digest(folder: Path) -> str:
    """SHA-256 of all Python files below a folder, as they are when this is first called."""
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.py")):
        digest.update(f"{file.relative_to(folder).as_posix()} {sha256_of(file)} ".encode())
    return digest.hexdigest()


def source_key(*made_by: Any) -> str:
    """Key of all code of `mvest`, and of the packages that makers are of.

    Parameters
    ----------
    *made_by
        Modules, functions or classes.
    """
    names = (made.__name__ if isinstance(made, ModuleType) else made.__module__ for made in made_by)
    packages = sorted({"mvest", *(str(name).partition(".")[0] for name in names)})
    folders = (Path(str(sys.modules[package].__file__)).parent for package in packages)
    return hashlib.sha256(" ".join(map(code_digest, folders)).encode()).hexdigest()


def content_digest(*values: Any) -> str:
    """SHA-256 of the content of arrays, dataclasses, mappings, sequences, numbers and texts.

    Raises
    ------
    InputError
        If something is none of these.
    """
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape} ".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__}(".encode())
        for each in fields(value):
            digest.update(f"{each.name}=".encode())
            _feed(digest, getattr(value, each.name))
        digest.update(b")")
    elif isinstance(value, Mapping):
        _feed(digest, sorted(value.items()))
    elif isinstance(value, tuple | list):
        digest.update(f"sequence {len(value)} ".encode())
        for item in value:
            _feed(digest, item)
    elif value is None or isinstance(value, str | bool | int | float | np.generic):
        plain = value.item() if isinstance(value, np.generic) else value
        digest.update(f"{plain!r};".encode())
    else:
        raise InputError(f"no digest of a {type(value).__name__}")
