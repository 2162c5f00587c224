"""A cache on disk for expensive results, and keys of the code that makes them.

The digest of an entry is stored as ``.NAME.sha256``. An entry without a matching digest is made
again, even if its reader would accept it.

Keys change with any code of `mvest`, and of other packages that callers name. Data files and
settings are not code; callers describe them.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from mvest.errors import InputError, cannot_write
from mvest.files import remove_parts, sha256_of, write_atomically

T = TypeVar("T")

DAMAGE = (OSError, ValueError, LookupError, TypeError)
"""Raised by readers of files that a broken disk or a user has changed."""


@dataclass(frozen=True, slots=True)
class Entry(Generic[T]):
    """A cached file or folder, which is either complete or absent."""

    path: Path  #: named after everything that decides its content
    read: Callable[[Path], T]  #: reads a path; raises one of `DAMAGE` for a damaged entry
    #: whether a damaged entry is made again. One that cannot be reproduced raises instead.
    remake: bool = True

    def found(self) -> T | None:
        """The cached value; None if there is none, or if it is damaged and can be made again."""
        if not self.path.exists():
            return None
        try:
            # An entry that cannot be made again contains its digest, which its reader checks.
            if self.remake and self._digest() != self.seal.read_text(encoding="utf-8"):
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

    def _digest(self) -> str:
        """Digest of the content and the name, so that a moved entry does not match."""
        about = f"{self.path.parent.name}/{self.path.name} {sha256_of(self.path)}"
        return hashlib.sha256(about.encode()).hexdigest()

    def get_or_make(
        self,
        make: Callable[[], Any],
        write: Callable[[Path, Any], object],
        keep: Callable[[Any], bool] = lambda _: True,
    ) -> T:
        """The cached value, made if there is none; see :func:`get_or_make`."""
        return get_or_make([self], lambda _: [make()], write, keep)[0]

    def keep(self, value: Any, write: Callable[[Path, Any], object]) -> T:
        """Cache a value; returns what is read back."""
        write_atomically(self.path, lambda part: write(part, value), sync=True)
        # If the process dies here, the entry has no digest and is made again.
        write_atomically(self.seal, self._digest())
        return self.read(self.path)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Lock the entry; other processes wait."""
        import filelock  # slow to import

        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(self.path.with_name(f".{self.path.name}.lock")).acquire()
        except OSError as error:
            raise cannot_write(self.path, error) from error
        with lock:
            yield


def get_or_make(
    entries: Sequence[Entry[T]],
    make: Callable[[list[int]], Iterable[Any]],
    write: Callable[[Path, Any], object],
    keep: Callable[[Any], bool] = lambda _: True,
) -> list[T]:
    """The cached values of entries; missing ones are made together.

    If several processes need the same entries, the first makes them and the others wait.

    InputError if the cache cannot be written.

    Returns the values as read from the cache, also if they were just made.

    Parameters
    ----------
    entries : sequence of Entry
    make : callable
        Numbers of entries -> iterable of their values; each is cached as soon as it is made.
    write : callable
        Writes a value to a path, as a file or as a folder.
    keep : callable
        Whether a value is cached; otherwise it is returned unchanged.
    """
    values: list[Any] = [entry.found() for entry in entries]
    left = [k for k, value in enumerate(values) if value is None]
    with ExitStack() as locks:
        # Locking in a fixed order prevents deadlocks.
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
    """SHA-256 of all Python files below a folder at the time of the first call."""
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.py")):
        digest.update(f"{file.relative_to(folder).as_posix()} {sha256_of(file)} ".encode())
    return digest.hexdigest()


def source_key(*packages: str) -> str:
    """Key of all code of `mvest` and of further packages that are imported."""
    names = sorted({"mvest", *packages})
    folders = (Path(str(sys.modules[name].__file__)).parent for name in names)
    return hashlib.sha256(" ".join(map(code_digest, folders)).encode()).hexdigest()


def content_digest(*values: Any) -> str:
    """SHA-256 of the content of arrays, dataclasses, mappings, sequences, numbers and texts.

    InputError if something is none of these.
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
