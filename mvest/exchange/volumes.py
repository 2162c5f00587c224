"""Volumes over time and label maps, from every format that is read.

A file's content counts, not its name. Nothing is guessed: what the file does not state must be
given, and what it states must not be contradicted. The file is read in the child process
(`mvest.exchange._images`): first what it states, which is checked here, then its voxels within a
limit of memory that follows from their number.

The bounds leave room for any 4D image of a heart. They catch what is no such image: pixels read in
the wrong order, centimetres taken for millimetres, a mask, a localiser. A label map may be smaller
and emptier than an image.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.exchange import _images
from mvest.exchange._images import READABLE, Stated, fault
from mvest.exchange.child import in_child
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.typing import FloatArray

SECONDS_PER_UNIT = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), 1e-6),
}
"""Units of time by the names that files give them."""

MIN_INTERVAL_S, MAX_INTERVAL_S = 0.002, 1.0
"""Bounds of the interval between two frames of a beating heart, the upper one excluded.

No scanner takes 500 volumes per second; a second between frames leaves one to a beat, and is what
many programs write where they know nothing. So milliseconds taken for seconds are seen, and seconds
taken for milliseconds.
"""
SPACING_MM = (0.05, 5.0)
"""Between neighbouring voxels; 3D echo has 0.3 to 1.5, CT 0.2 to 1, MR up to 5."""
EXTENT_MM, LABELS_MM = (20.0, 500.0), (2.0, 500.0)
"""Of an image along each axis: from an annulus to a whole chest; and of a label map, whose box may
be cropped to the leaflets of a child."""
MIN_VOXELS, MIN_LABELS = 16, 2
"""Voxels along each axis of an image, and of a label map."""
MAX_BYTES = 4 * 2**30
"""Of all frames, decoded, if the caller states no other number.

Twenty frames of CT, 512 x 512 x 300 voxels of two bytes, have 2.9 GiB.
"""
MEMORY = 3
"""Copies of the voxels that a reader may hold for a while, beside 1 GiB."""
BYTES_PER_SECOND = 2**25
"""Decoded by a slow machine; the time limit of reading."""
MAX_OFFSET_MM = 1e4
"""Of the origin from the world's zero."""
ORTHOGONAL = 1e-3
"""Largest cosine between axes, which files give with three digits or more."""


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
        what no image of a heart has (see the bounds above).
    """
    source = Path(path)
    if source.is_dir():
        convert = "convert a DICOM series with 3D Slicer, to .nrrd or .seq.nrrd"
        raise fault(source, "path", "a folder", f"one file: {READABLE}; {convert}")
    stated = Stated(**in_child(_images.stated, source))
    if stated.labels:
        raise fault(source, stated.labels, "a segmentation or label map", "an image")
    spacing, direction = _place(source, stated, MIN_VOXELS, EXTENT_MM, max_bytes)
    times = _times(source, stated, frame_interval_s, time_unit)
    kind = _modality(source, stated.modality, modality)
    frames = _image_values(source, stated, _voxels(source, stated))
    sha256 = _sha256(source, stated)
    return VolumeSequence(
        frames, spacing, direction, stated.origin, times, kind, source.name, sha256
    )


def read_labels(path: Path | str, *, max_bytes: int = MAX_BYTES) -> LabelMap:
    """Read a label map or segmentation: NRRD, MetaImage or NIfTI of three or four axes.

    Frames and layers may be empty, and need no times.

    Raises
    ------
    InputError
        As `read_volume`; an image, no label at all, or values that are no whole numbers.
    """
    source = Path(path)
    stated = Stated(**in_child(_images.stated, source))
    if stated.modality:
        raise fault(source, "modality", stated.modality, "a label map, no image")
    spacing, direction = _place(source, stated, MIN_LABELS, LABELS_MM, max_bytes)
    times = None
    if stated.times is not None and not stated.is_layers:
        try:
            times = _times(source, stated, None, None)
        except InputError:
            times = None  # as many programs write where they know none
    frames = _voxels(source, stated)
    if frames.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            whole = frames.astype(np.int32)
        if not (whole == frames).all():
            raise fault(source, stated.names[3], "other numbers", "whole numbers, the labels")
        frames = whole
    if not frames.any():
        raise fault(source, stated.names[3], "all voxels are 0", "labels from 1 on")
    return LabelMap(
        frames,
        stated.is_layers,
        spacing,
        direction,
        stated.origin,
        times,
        tuple(Segment(*segment) for segment in stated.segments),
        _sha256(source, stated),
    )


def files_of_volume(path: Path) -> dict[str, Path]:
    """Name -> file of all that reading a volume opens: itself, and its data file if it has one."""
    try:
        stated = Stated(**in_child(_images.stated, path))
    except InputError:
        return {path.name: path} if path.is_file() else {}
    return {file.name: file for file in _files(path, stated)}


def _files(path: Path, stated: Stated) -> list[Path]:
    """The file, and the data file beside it if it has one."""
    beside = path.resolve().parent / stated.data_file
    return [path, beside] if stated.data_file else [path]


def _voxels(path: Path, stated: Stated) -> NDArray[Any]:
    """Voxels ``(F, I, J, K)`` in the byte order of the machine."""
    size = int(np.prod(stated.shape, dtype=object)) * np.dtype(stated.dtype).itemsize
    frames: NDArray[Any] = in_child(
        _images.voxels,
        path,
        memory_gb=round(MEMORY * size / 2**30 + 1, 1),
        seconds=60 + size // BYTES_PER_SECOND,
    )
    return frames.astype(frames.dtype.newbyteorder("="), copy=False)


def _sha256(path: Path, stated: Stated) -> str:
    """Of the bytes of the file and of its data file, one after the other."""
    digest = hashlib.sha256()
    for source in _files(path, stated):
        with source.open("rb") as file:
            while chunk := file.read(2**20):
                digest.update(chunk)
    return digest.hexdigest()


def _place(
    path: Path,
    stated: Stated,
    min_voxels: int,
    extent_mm: tuple[float, float],
    max_bytes: int,
) -> tuple[FloatArray, FloatArray]:
    """Spacing and orthonormal axes, once size and place are plausible.

    A left-handed system stays one.
    """
    names, shape, steps = stated.names, stated.shape, stated.steps
    counted = f"{' x '.join(map(str, shape))} frames and voxels"
    if shape[0] < 1 or min(shape[1:]) < min_voxels:
        expected = f"at least one frame, and at least {min_voxels} voxels along each axis"
        raise fault(path, names[0], counted, expected)
    dtype = np.dtype(stated.dtype)
    if dtype.kind not in "iuf":
        raise fault(path, names[3], f"type {dtype}", "one real number, no colour or vector")
    total = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if total > max_bytes:
        found = f"{counted} of {dtype.itemsize} bytes, together {total / 2**30:.1f} GiB"
        expected = f"at most {max_bytes / 2**30:g} GiB; crop it, or take fewer frames"
        raise fault(path, names[0], found, expected)
    spacing = np.linalg.norm(steps, axis=0)
    low, high = SPACING_MM
    if not ((spacing >= low) & (spacing <= high)).all():
        expected = f"{low:g} to {high:g} mm along each axis"
        raise fault(path, names[1], f"{_numbers(spacing)} mm between voxels", expected)
    axes = steps / spacing
    if np.abs(axes.T @ axes - np.eye(3)).max() > ORTHOGONAL:
        raise fault(path, names[1], f"axes {_numbers(axes.T)}", "axes at right angles")
    extent, (low, high) = spacing * shape[1:], extent_mm
    if (extent < low).any() or (extent > high).any():
        found = f"volume of {' x '.join(f'{e:.4g}' for e in extent)} mm"
        raise fault(path, names[1], found, f"{low:g} to {high:g} mm along each axis")
    if not (np.abs(stated.origin) <= MAX_OFFSET_MM).all():
        expected = f"coordinates in mm, none beyond {MAX_OFFSET_MM:g}"
        raise fault(path, names[2], _numbers(stated.origin), expected)
    # The closest orthonormal axes take away what rounding in the file left; none is turned round.
    left, _, right = np.linalg.svd(axes)
    return spacing, left @ right


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{value:g}" for value in np.ravel(values))


def _times(
    path: Path, stated: Stated, frame_interval_s: float | None, time_unit: str | None
) -> FloatArray:
    """Times ``(F,)`` s of the frames; a single frame without a time is at 0.

    Raises
    ------
    InputError
        Times without unit, or none at all, and the user did not say; the user contradicts the file;
        times that do not increase, or by steps that no recording of a heart has.
    """
    field, count = stated.names[4], stated.shape[0]
    factor = SECONDS_PER_UNIT.get(stated.unit.lower())
    known = stated.times is not None and factor is not None
    if frame_interval_s is not None and time_unit is not None:
        raise InputError("frame_interval_s: given beside time_unit, expected one of the two")
    if frame_interval_s is not None and known:
        raise InputError(f"frame_interval_s: {path} states its own times in {field}")
    if time_unit is not None and time_unit not in SECONDS_PER_UNIT:
        raise InputError(f"time_unit: {time_unit!r}, expected 's' or 'ms'")
    if time_unit is not None and factor not in (None, SECONDS_PER_UNIT[time_unit]):
        raise InputError(f"time_unit: {time_unit!r}, but {path} states {stated.unit!r}")
    if frame_interval_s is not None:
        if not (np.isfinite(frame_interval_s) and frame_interval_s > 0):
            raise InputError(f"frame_interval_s: {frame_interval_s:g}, expected a positive number")
        times = frame_interval_s * np.arange(count, dtype=np.float64)
    elif stated.times is not None and (known or time_unit is not None):
        times = stated.times * (factor or SECONDS_PER_UNIT[time_unit or "s"])
    elif count == 1:
        return np.zeros(1)
    else:
        unit = f"in the unit {stated.unit!r}" if stated.unit else "without a unit"
        found = "no times of frames" if stated.times is None else f"times {unit}"
        options = "frame_interval_s" if stated.times is None else "time_unit or frame_interval_s"
        expected = f"times in s or ms; else give {options}"
        raise fault(path, field, found, expected)
    steps, low, high = np.diff(times), MIN_INTERVAL_S, MAX_INTERVAL_S
    if times.shape != (count,) or not np.isfinite(times).all():
        raise fault(path, field, _numbers(times), f"a time of each of {count} frames")
    if not ((steps >= low) & (steps < high)).all():
        expected = f"increasing times, by at least {low:g} s and less than {high:g} s"
        raise fault(path, field, f"{_numbers(times)} s", expected)
    return np.asarray(times)


def _modality(path: Path, stated: str, given: Modality | None) -> Modality:
    names = [m.value for m in Modality]
    if stated and stated not in names:
        raise fault(path, _images.MODALITY_KEY, repr(stated), ", ".join(names))
    if stated and given is not None and stated != given.value:
        raise InputError(f"modality: {given.value}, but {path} states {stated}")
    if not stated and given is None:
        raise fault(path, "modality", "not stated by the file", f"as a setting: {', '.join(names)}")
    return given or Modality(stated)


def _image_values(path: Path, stated: Stated, frames: NDArray[Any]) -> NDArray[np.generic]:
    """The frames as uint8, int16 or float32, each of which shows something."""
    field = stated.names[3]
    lows, highs = (f(frames, axis=(1, 2, 3)).astype(np.float64) for f in (np.min, np.max))
    for number, (low, high) in enumerate(zip(lows, highs, strict=True)):
        if not (np.isfinite(low) and np.isfinite(high)):
            bad = int(np.count_nonzero(~np.isfinite(frames[number])))
            raise fault(path, field, f"{bad} voxels of frame {number} are no numbers", "numbers")
        if low == high:
            found = f"all voxels of frame {number} are {low:g}"
            raise fault(path, field, found, "an image in every frame")
    limits = np.iinfo(np.int16)
    if frames.dtype == np.uint8:
        return frames
    if frames.dtype.kind in "iu" and lows.min() >= limits.min and highs.max() <= limits.max:
        return frames.astype(np.int16, copy=False)
    if max(-lows.min(), highs.max()) > np.finfo(np.float32).max:
        raise fault(path, field, f"{highs.max():g}", "numbers in the range of 4 bytes")
    return frames.astype(np.float32, copy=False)
