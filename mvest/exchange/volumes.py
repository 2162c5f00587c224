"""Volumes over time and label maps, from every format that is read.

A file's content counts, not its name. Nothing is guessed: what the file does not state must be
given, and what it states must not be contradicted. All of a file is read in the child process:
first what it states, then its voxels within a limit of memory that follows from their number.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.exchange import _plausible
from mvest.exchange.child import in_child
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.typing import FloatArray

MAX_BYTES = 4 * 2**30
"""Of all frames, decoded, if the caller states no other number.

Twenty frames of CT, 512 x 512 x 300 voxels of two bytes, have 2.9 GiB.
"""
MAX_UNASKED, MAX_RATIO = 2**28, 1000
"""Bytes that any compressed file may hold, and how many times its own size beyond that: images of
the heart have 1.5 to 20 times, label maps some hundred."""
COPIES = 3
"""Of the voxels, that a reader may hold for a while beside 1 GiB."""
BYTES_PER_SECOND = 2**25
"""Decoded by a slow machine; reading may take that long and a minute."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment of a ``.seg.nrrd`` file.

    Attributes
    ----------
    name, tags : str
    label : int
        Value of its voxels.
    layer : int
        Number of the frame that holds them.
    """

    name: str
    tags: str
    label: int
    layer: int


@dataclass(frozen=True, slots=True, eq=False)
class LabelMap:
    """Labelled voxels of one region. World coordinates are LPS, in mm.

    Attributes
    ----------
    frames : (F, I, J, K) integers
        Frames over time, or the layers of a segmentation.
    is_layers : bool
        Whether they are layers, which show one instant.
    spacing : (3,) mm
    direction : (3, 3)
        Its columns are the unit vectors of i, j and k; orthonormal, perhaps left-handed.
    origin : (3,) mm
        Centre of voxel (0, 0, 0).
    times : (F,) s or None
        None where the file states none that a beating heart could have.
    segments : tuple of Segment
        Those that a ``.seg.nrrd`` names; empty for other files.
    sha256 : str
        Of the file, with its data file if that is another one.
    """

    frames: NDArray[np.integer]
    is_layers: bool
    spacing: FloatArray
    direction: FloatArray
    origin: FloatArray
    times: FloatArray | None
    segments: tuple[Segment, ...]
    sha256: str


def read_volume(
    path: Path | str,
    *,
    modality: Modality | None = None,
    frame_interval_s: float | None = None,
    time_unit: str | None = None,
    max_bytes: int = MAX_BYTES,
) -> VolumeSequence:
    """Read a volume over time. Directions stay as the file has them, left-handed ones included.

    A file may hold a single frame.

    Parameters
    ----------
    path
        NRRD (``.nrrd``, ``.seq.nrrd``, ``.nhdr``), MetaImage (``.mha``, ``.mhd``), NIfTI (``.nii``,
        ``.nii.gz``) or Philips Cartesian DICOM.
    modality
        What the voxels are, for files that do not say: all but DICOM and those of this package.
    frame_interval_s
        Seconds between frames, for files that state no times in a unit of time.
    time_unit
        ``"s"`` or ``"ms"``, for files that state times without a unit.
    max_bytes
        Of all frames, decoded; reading them takes up to three times as much memory for a while.

    Raises
    ------
    InputError
        In one line the file, the field, what was found and what was expected: a file that is
        damaged or of another kind, something that it does not state or the caller contradicts, or
        what no image of a heart has (the bounds of `mvest.exchange._plausible`).
    """
    source = Path(path)
    if source.is_dir():
        convert = "convert a DICOM series with 3D Slicer, to .nrrd or .seq.nrrd"
        raise InputError(f"{source}: a folder, expected one file: {_plausible.READABLE}; {convert}")
    name = None if modality is None else modality.value
    found = _read(source, False, max_bytes, name, frame_interval_s, time_unit)
    return VolumeSequence(
        **found | {"modality": Modality(found["modality"]), "source": source.name}
    )


def read_labels(path: Path | str, *, max_bytes: int = MAX_BYTES) -> LabelMap:
    """Read a label map or segmentation: NRRD, MetaImage or NIfTI of three or four axes.

    Frames and layers may be empty, and need no times.

    Raises
    ------
    InputError
        As `read_volume`; an image, no label at all, or values that are no whole numbers.
    """
    found = _read(Path(path), True, max_bytes)
    segments = tuple(Segment(*segment) for segment in found["segments"])
    return LabelMap(**found | {"segments": segments})


def files_of_volume(path: Path) -> dict[str, Path]:
    """Name -> file of all that reading a volume opens: itself, and its data file if it has one."""
    try:
        files = _files(path, in_child(_plausible.data_file, path))
    except InputError:
        files = [path]
    return {file.name: file for file in files if file.is_file()}


def _files(path: Path, data_file: str) -> list[Path]:
    return [path, path.resolve().parent / data_file] if data_file else [path]


def _read(path: Path, labels: bool, *options: Any) -> dict[str, Any]:
    """What a file states, its voxels, and the SHA-256 of all of its bytes."""
    found: dict[str, Any] = in_child(_plausible.about, path, labels, *options)
    size, files = found.pop("bytes"), _files(path, found.pop("data_file"))
    stored = sum(file.stat().st_size for file in files)
    if size > max(MAX_UNASKED, MAX_RATIO * stored):
        raise InputError(
            f"{path}: data: {size} bytes compressed to {stored}, expected at most {MAX_RATIO} "
            "times as many; save it without compression"
        )
    memory_gb = round(COPIES * size / 2**30 + 1, 1)
    limits = {"memory_gb": memory_gb, "seconds": 60 + size // BYTES_PER_SECOND}
    digest = hashlib.sha256()
    for source in files:
        with source.open("rb") as file:
            while chunk := file.read(2**20):
                digest.update(chunk)
    frames = in_child(_plausible.values, path, labels, **limits)
    return found | {"frames": frames, "sha256": digest.hexdigest()}
