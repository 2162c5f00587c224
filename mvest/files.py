"""Atomic writing of files and folders, and their digests."""

import hashlib
import os
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

from mvest.errors import InputError, cannot_write

PREFIX = ".part-"
"""Beginning of temporary names."""


def write_atomically(
    path: Path | str, content: str | bytes | Callable[[Path], object], *, sync: bool = False
) -> Path:
    """Write a file or a folder under a temporary name, and then rename it.

    An existing one is replaced. Interruptions leave no partial content, and other processes see
    none.

    Returns ``path``. InputError if it cannot be written.

    Parameters
    ----------
    path : Path or str
        Its folder must exist.
    content : str, bytes or callable
        Text is written as UTF-8, with a ? for what has none. A callable gets the temporary path,
        which ends as ``path`` does, and makes a file or a folder there.
    sync : bool
        Whether to flush the content to the disk before renaming.
    """
    target = Path(path)
    part = target.with_name(f"{PREFIX}{uuid.uuid4().hex}-{target.name}")
    try:
        try:
            if callable(content):
                content(part)
            else:
                if isinstance(content, str):
                    content = content.encode(errors="replace")
                part.write_bytes(content)
            for file in filter(Path.is_file, [part, *part.rglob("*")]) if sync else ():
                with file.open("rb+") as stream:
                    os.fsync(stream.fileno())
            if part.is_dir() and target.is_dir():
                shutil.rmtree(target)
            part.replace(target)
        finally:
            _remove(part)
    except OSError as error:
        raise cannot_write(target, error) from error
    return target


def require_writable(folder: Path) -> None:
    """Create a folder if necessary; an InputError says that it cannot be created or written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f"{PREFIX}{uuid.uuid4().hex}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from error


def sha256_of(path: Path) -> str:
    """SHA-256 (64 hexadecimal digits) of a file, or of all names and contents in a folder.

    Links are followed. If something cannot be read, an InputError names it.
    """
    try:
        if not path.is_dir():
            return _sha256(path)
        digest = hashlib.sha256()
        for name, file in sorted((file.relative_to(path).as_posix(), file) for file in _tree(path)):
            digest.update(f"{len(name.encode())} {name} {_sha256(file)} ".encode())
        return digest.hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {error.filename or path}: {error.strerror}") from error


def _tree(folder: Path) -> Iterator[Path]:
    for place, inner, names in os.walk(folder, followlinks=True):
        here = Path(place)
        # Skip links to a parent folder, which would never end.
        above = {here.resolve(), *here.resolve().parents}
        inner[:] = [name for name in inner if (here / name).resolve() not in above]
        yield from (here / name for name in names if (here / name).is_file())


SETTLED_NS = 2_000_000_000
"""A file of this age changes its times with its next change, on any file system."""


def _sha256(file: Path) -> str:
    about = file.stat()
    if not stat.S_ISREG(about.st_mode):
        # Reading a pipe would wait.
        raise InputError(f"cannot read {file}: no file")
    key = (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns)
    if abs(time.time_ns() - max(about.st_mtime_ns, about.st_ctime_ns)) < SETTLED_NS:
        return _digest(file)
    return _remembered(file, key)


@lru_cache(maxsize=4096)
def _remembered(file: Path, key: tuple[int, ...]) -> str:
    """The digest of a large volume is computed once."""
    return _digest(file)


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def remove_parts(folder: Path, name: str = "") -> None:
    """Remove the temporary files of killed processes in ``folder``, or those of one ``name``."""
    for part in folder.glob(f"{PREFIX}*"):
        if part.name.endswith(f"-{name}" if name else ""):
            _remove(part)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)
