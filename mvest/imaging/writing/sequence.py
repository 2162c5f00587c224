"""Volumes over time as sequences that 3D Slicer reads (``.seq.nrrd``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.imaging.reading.nrrd_file import MODALITY_KEY
from mvest.imaging.volume import VolumeSequence
from mvest.imaging.writing.files import checked_path, write_nrrd

__all__ = ["write_sequence_nrrd"]

TYPES = ("uint8", "int16", "float32")


def write_sequence_nrrd(
    path: Path | str, sequence: VolumeSequence, *, compressed: bool = True
) -> Path:
    """Write a volume over time with its times, evenly spaced or not, and its modality.

    The axis of frames comes first, as all versions of Slicer read it; times are s. `read_volume`
    gives the same sequence back, its source and hash aside.

    Parameters
    ----------
    path
        Ends in ``.seq.nrrd``.
    sequence
        Of uint8, int16 or float32.
    compressed
        With gzip; quick rather than small.

    Raises
    ------
    InputError
        Another name or type, or a file that cannot be written.
    """
    target = checked_path(path, ".seq.nrrd")
    if sequence.frames.dtype.name not in TYPES:
        raise InputError(
            f"{target}: frames of type {sequence.frames.dtype}, expected {', '.join(TYPES)}"
        )
    steps = (sequence.direction * sequence.spacing).T
    header: dict[str, Any] = {
        "space": "left-posterior-superior",
        "space directions": np.vstack([np.full(3, np.nan), steps]),
        "space origin": np.asarray(sequence.origin, dtype=np.float64),
        "kinds": ["list", "domain", "domain", "domain"],
        "labels": ["time", "", "", ""],
        "units": ["s", "", "", ""],
        "encoding": "gzip" if compressed else "raw",
        "DataNodeClassName": "vtkMRMLScalarVolumeNode",
        "axis 0 index type": "numeric",
        "axis 0 index values": " ".join(repr(float(time)) for time in sequence.times),
        MODALITY_KEY: sequence.modality.value,
    }
    write_nrrd(target, sequence.frames, header)
    return target
