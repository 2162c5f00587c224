"""What takes long to make is made once: entries of a store on disk.

Beside each entry lies its digest, ``.NAME.sha256``. An entry that does not match it, or that has
none, is not what was written under this name, whatever its reader thinks of it, and is made again.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from filelock import FileLock

from mvest.errors import cannot_write
from mvest.files import remove_parts, sha256_of, write_atomically

T = TypeVar("T")

DAMAGE = (OSError, ValueError, LookupError, TypeError)
"""What readers raise of a file that a broken disk or a user has changed."""


@dataclass(slots=True)
class Counts:
    """How often an entry was read (``hits``) and made (``misses``)."""

    hits: int = 0
    misses: int = 0


@dataclass(frozen=True, slots=True)
class Entry(Generic[T]):
    """A file or a folder that is there whole or not at all.

    Attributes
    ----------
    path : Path
        Named by all that decides what is in it.
    read : callable
        What lies at a path; refuses what is damaged.
    remake : bool
        Whether a damaged entry is made again. One that would not be the same again is refused.
    counts : Counts
    """

    path: Path
    read: Callable[[Path], T]
    remake: bool = True
    counts: Counts = field(default_factory=Counts)

    def found(self) -> T | None:
        """What is kept; None if there is nothing, or something damaged to be made again."""
        if not self.path.exists():
            return None
        try:
            # What cannot be made again has its digest within, which its reader checks.
            if self.remake and self._digest(self.path) != self.seal.read_text(encoding="utf-8"):
                return None
            value = self.read(self.path)
        except DAMAGE:
            if not self.remake:
                raise
            return None
        with suppress(OSError):  # a store that may only be read
            os.utime(self.path)
        return value

    @property
    def seal(self) -> Path:
        """The file of its digest."""
        return self.path.with_name(f".{self.path.name}.sha256")

    def _digest(self, path: Path) -> str:
        """Of what lies at a path as the content of this entry: one that was moved is another."""
        about = f"{self.path.parent.name}/{self.path.name} {sha256_of(path)}"
        return hashlib.sha256(about.encode()).hexdigest()

    def get_or_make(
        self,
        make: Callable[[], Any],
        write: Callable[[Path, Any], object],
        keep: Callable[[Any], bool] = lambda _: True,
    ) -> T:
        """What is kept, or is made and kept now: see :func:`get_or_make`."""
        return get_or_make([self], lambda _: [make()], write, keep)[0]

    def keep(self, value: Any, write: Callable[[Path, Any], object]) -> T:
        """Keep a value; what others will read."""
        write_atomically(self.path, lambda part: write(part, value), sync=True)
        # Who dies in between leaves an entry without its digest, which is made again.
        write_atomically(self.seal, self._digest(self.path))
        return self.read(self.path)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Of several processes that need the entry, one is let in and the others wait."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.path.with_name(f".{self.path.name}.lock"))
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
    """What is kept in entries; those that are missing are made together.

    Of several processes that need the same ones, the first makes them and the others wait.

    Parameters
    ----------
    entries : sequence of Entry
    make : callable
        Values for the entries of these numbers, one after another; each is kept as it comes.
    write : callable
        Writes a value to a path, as a file or as a folder.
    keep : callable
        Whether a value is kept. One that is not is returned as it is.

    Returns
    -------
    list
        What was read, also of what was made now: no digit depends on who made it.

    Raises
    ------
    InputError
        If the store cannot be written.
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
        for k in left:
            entry = entries[k]
            remove_parts(entry.path.parent, entry.path.name)
            if entry.path.exists():
                print(f"note: {entry.path} is damaged and is made again", file=sys.stderr)
        for k, value in zip(left, make(left) if left else (), strict=True):
            entry = entries[k]
            if keep(value):
                value = entry.keep(value, write)
            values[k] = value
            entry.counts.misses += 1
    for k in set(range(len(entries))) - set(left):
        entries[k].counts.hits += 1
    return values


def prune(folder: Path, pattern: str, largest_mb: float) -> None:
    """Keep the files of a store within a size: those go first that were not used for longest.

    Parameters
    ----------
    folder : Path
    pattern : str
        Of the names of the entries, which are files.
    largest_mb : float
        Size in 10^6 bytes up to which they stay; of a larger store nine tenths of it.
    """
    used = []
    for path in folder.glob(pattern):
        with suppress(OSError):  # gone meanwhile
            about = path.stat()
            used.append((about.st_mtime_ns, about.st_size, path))
    size, removed = sum(bytes_ for _, bytes_, _ in used), 0
    if size <= 1e6 * largest_mb:
        return
    for _, bytes_, path in sorted(used)[:-1]:
        if size <= 0.9e6 * largest_mb:
            break
        for part in (path, Entry(path, Path.read_bytes).seal):
            part.unlink(missing_ok=True)
        size, removed = size - bytes_, removed + 1
    print(
        f"note: {folder} holds more than {largest_mb:g} MB; of its entries {removed} were removed "
        "that were not used for longest",
        file=sys.stderr,
    )
