"""How files of the image step are put in place: whole or not at all."""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError

__all__ = ["checked_path", "write_nrrd", "write_whole"]


def checked_path(path: Path | str, suffix: str) -> Path:
    """The path, which must end in `suffix`."""
    target = Path(path)
    if not target.name.endswith(suffix) or target.name == suffix:
        raise InputError(f"{target}: name {target.name!r}, expected one that ends in {suffix}")
    return target


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then give it that name.

    Raises
    ------
    InputError
        The folder does not exist or cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".part-", suffix=path.suffix)
        os.close(handle)
        temporary = Path(name)
        try:
            write(temporary)
            temporary.chmod(0o644)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as fault:
        raise InputError(f"{path}: cannot be written: {fault.strerror or fault}") from fault


def write_nrrd(path: Path, data: NDArray[np.generic], header: Mapping[str, Any]) -> None:
    """Write an array, first axis fastest, with pynrrd: the same bytes for the same content.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    content = io.BytesIO()
    nrrd.write(content, data, dict(header), compression_level=1)
    content.seek(0)
    lines = []
    while (line := content.readline()) != b"\n":
        # pynrrd's comments hold the time of writing.
        if not line.startswith(b"#"):
            lines.append(line)
    start = content.tell()

    def write(file: Path) -> None:
        with file.open("wb") as stream, content.getbuffer() as bytes_:
            stream.writelines([*lines, b"\n"])
            stream.write(bytes_[start:])

    write_whole(path, write)
