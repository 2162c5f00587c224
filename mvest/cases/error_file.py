"""Joint errors of all frames of a case as a file: arrays by name, in NumPy's ``.npz``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvest.cases.case import ErrorSamples
from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reading.text import one_line

ARRAYS = ("frames", "vertices", "tips")
SOURCE = "source"


def read_error_samples(file: Path, frames: Sequence[str]) -> ErrorSamples:
    """Read the samples of a case whose frames have these names, in this order.

    ``frames`` are names ``(f,)``, ``vertices (K, f, n, 3)`` and ``tips (K, f, t, 3)`` displacements
    in mm from where a point was seen to where it may have been. ``source (K,)`` may be there:
    integers, alike for samples that are not independent of each other.

    Raises
    ------
    InputError
        The file is no ``.npz``, holds other arrays, is of other frames, or a value is no
        displacement.
    """
    if file.suffix.lower() != ".npz":
        raise InputError(f"{file.name}: extension {file.suffix!r}, expected .npz")
    stored = read_npz(file, ARRAYS, exact=True, optional=(SOURCE,), where=file.name)
    names, vertices, tips = (stored[name] for name in ARRAYS)
    if names.ndim != 1 or names.dtype.kind != "U" or names.tolist() != list(frames):
        shown = (
            one_line(names.tolist(), 80)
            if names.dtype.kind == "U"
            else f"an array of {names.dtype}"
        )
        raise InputError(f"{file.name}: frames {shown}, expected {one_line(list(frames), 120)}")
    return ErrorSamples(vertices, tips, stored.get(SOURCE))


def write_error_samples(file: Path, samples: ErrorSamples, frames: Sequence[str]) -> None:
    """Write samples so that they are read back unchanged."""
    names, vertices, tips = np.array(list(frames)), samples.vertices, samples.tips
    if samples.source is None:
        np.savez_compressed(file, frames=names, vertices=vertices, tips=tips)
    else:
        np.savez_compressed(file, frames=names, vertices=vertices, tips=tips, source=samples.source)
