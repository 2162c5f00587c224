"""Files and folders that appear under their names only once they are whole."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

from mvest.errors import cannot_write

__all__ = ["remove_parts", "write_atomically"]

PREFIX = ".part-"
"""With which every temporary name begins."""


def write_atomically(
    path: Path | str, content: str | bytes | Callable[[Path], object], *, sync: bool = False
) -> Path:
    """Write a file or a folder under a temporary name beside it, which then takes its own.

    Neither an interruption nor a second process ever leaves or sees half of it. What was there
    before is replaced.

    Parameters
    ----------
    path : Path or str
        Its folder must exist.
    content : str, bytes or callable
        Text is written as UTF-8; a callable is given the temporary path, which ends as ``path``
        does, and makes a file or a folder there.
    sync : bool
        Whether all of it is on the disk, and not merely on its way, before it takes its name.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    target = Path(path)
    part = target.with_name(f"{PREFIX}{uuid.uuid4().hex}-{target.name}")
    try:
        try:
            if callable(content):
                content(part)
            else:
                part.write_bytes(content.encode() if isinstance(content, str) else content)
            for file in _files(part) if sync else ():
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


def remove_parts(folder: Path, name: str = "") -> None:
    """Take away what killed processes left of files and folders in ``folder``, or of one ``name``.

    Nobody may be writing them.
    """
    for part in folder.glob(f"{PREFIX}*"):
        if part.name.endswith(f"-{name}" if name else ""):
            _remove(part)


def _files(part: Path) -> list[Path]:
    return [file for file in [part, *part.rglob("*")] if file.is_file()]


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)
