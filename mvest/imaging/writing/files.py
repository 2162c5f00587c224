"""What the writers of the image step have in common."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.files import write_atomically

__all__ = ["checked_path", "write_nrrd"]


def checked_path(path: Path | str, suffix: str) -> Path:
    """The path, which must end in `suffix`."""
    target = Path(path)
    if not target.name.endswith(suffix) or target.name == suffix:
        raise InputError(f"{target}: name {target.name!r}, expected one that ends in {suffix}")
    return target


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
    lines: list[bytes] = []
    while (line := content.readline()) != b"\n":
        # pynrrd's comments hold the time of writing.
        if not line.startswith(b"#"):
            lines.append(line)
    write_atomically(path, b"".join([*lines, b"\n", content.read()]))
