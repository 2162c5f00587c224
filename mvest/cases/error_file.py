"""Joint errors of all frames of a case as a file: arrays by name, in NumPy's ``.npz``."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvest.cases.case import ErrorSamples
from mvest.errors import InputError

__all__ = ["ARRAYS", "read_error_samples", "write_error_samples"]

ARRAYS = ("frames", "vertices", "tips")
MAX_FILE_SIZE = 2**29
"""Bytes of all arrays."""


def read_error_samples(file: Path, frames: Sequence[str]) -> ErrorSamples:
    """Read the samples of a case whose frames have these names, in this order.

    ``frames`` are names ``(f,)``, ``vertices (K, f, n, 3)`` and ``tips (K, f, t, 3)`` displacements
    in mm from where a point was seen to where it may have been.

    Raises
    ------
    InputError
        The file is no ``.npz``, holds other arrays, is of other frames, or a value is no
        displacement.
    """
    if file.suffix.lower() != ".npz":
        raise InputError(f"{file.name}: extension {file.suffix!r}, expected .npz")
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_FILE_SIZE:
            raise InputError(
                f"{file.name}: {size} bytes of arrays, expected at most {MAX_FILE_SIZE}"
            )
        with np.load(file, allow_pickle=False) as stored:
            if sorted(stored.files) != sorted(ARRAYS):
                raise InputError(
                    f"{file.name}: arrays {', '.join(stored.files) or 'none'}, expected "
                    f"{', '.join(ARRAYS)}"
                )
            names, vertices, tips = (stored[name] for name in ARRAYS)
    except (OSError, zipfile.BadZipFile, EOFError, ValueError) as fault:
        if isinstance(fault, InputError):
            raise
        raise InputError(f"{file.name}: cannot be read as .npz without pickles: {fault}") from fault
    if names.ndim != 1 or names.dtype.kind != "U" or names.tolist() != list(frames):
        shown = names.tolist() if names.dtype.kind == "U" else f"an array of {names.dtype}"
        raise InputError(f"{file.name}: frames {shown}, expected {list(frames)}")
    return ErrorSamples(vertices, tips)


def write_error_samples(file: Path, samples: ErrorSamples, frames: Sequence[str]) -> None:
    """Write samples so that they are read back unchanged."""
    np.savez_compressed(
        file, frames=np.array(list(frames)), vertices=samples.vertices, tips=samples.tips
    )
