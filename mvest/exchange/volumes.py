"""Volumes over time and label maps: reads every supported format, writes ``.seq.nrrd``.

The format is detected from a file's content, not its name. Nothing is guessed: the caller must give
what the file does not state, and must not contradict what it states. The child process reads the
file: first its header, then its voxels, within a memory limit set by the number of voxels.

The bounds admit any 4D image of a heart and reject everything else: pixels in the wrong order,
centimetres taken for millimetres, a mask, a localiser. A label map may be smaller and emptier than
an image.
"""

import gzip
import hashlib
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.exchange._images import (
    Opened,
    Segment,
    Stated,
    Voxels,
    check,
    fault,
    metaimage,
    nifti,
    philips,
)
from mvest.exchange._nrrd import MODALITY_KEY, nrrd_file
from mvest.exchange.child import in_child
from mvest.files import write_atomically
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.typing import FloatArray

MAX_BYTES = 4 * 2**30
"""Largest decoded size of all frames. Twenty CT frames of 512 x 512 x 300 two-byte voxels take
2.9 GiB."""
MAX_UNCHECKED, MAX_RATIO = 2**28, 1000
"""Decoded bytes always allowed, and the largest compression ratio beyond that. Images of the heart
have ratios of 1.5 to 20, label maps of a few hundred."""
COPIES = 3
"""Memory limit for reading, in copies of the voxels, in addition to 1 GiB."""
BYTES_PER_SECOND = 2**25
"""Decoding rate of a slow machine; reading may take that long plus a minute."""

READABLE = "NRRD, MetaImage, NIfTI or Philips Cartesian DICOM"
MAX_HEADER = 2**20
"""Largest size of a header (bytes)."""

SECONDS_PER_UNIT = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), 1e-6),
}
"""Names of units of time in files."""

MIN_INTERVAL_S, MAX_INTERVAL_S = 0.002, 1.0
"""Bounds of the interval between two frames of a beating heart, the upper one excluded.

No scanner takes 500 volumes per second. One second is the default of many programs, and would
leave one frame per beat. The bounds distinguish milliseconds from seconds.
"""
SPACING_MM = (0.05, 5.0)
"""Voxel spacing; 3D echo has 0.3 to 1.5, CT 0.2 to 1, MR up to 5."""
EXTENT_MM, LABELS_MM = (20.0, 500.0), (2.0, 500.0)
"""Extent along each axis: an image shows anything from an annulus to a whole chest; a label map may
be cropped to the leaflets of a child."""
MIN_VOXELS, MIN_LABELS = 16, 2
"""Smallest number of voxels along each axis of an image, and of a label map."""
MAX_OFFSET_MM = 1e4
"""Largest coordinate of the origin."""
ORTHOGONAL = 1e-3
"""Largest cosine between axes; files give axes to three digits or more."""
WRITABLE = ("uint8", "int16", "float32")


@dataclass(frozen=True, slots=True, eq=False)
class LabelMap:
    """Labelled voxels. World coordinates are LPS, in mm.

    The columns of ``direction`` are the unit vectors of i, j and k: orthonormal, possibly
    left-handed.
    """

    frames: NDArray[np.integer]  # (F, I, J, K), F times, or layers of a segmentation
    is_layers: bool  # whether F counts layers, all of one instant
    spacing: FloatArray  # (3,) mm
    direction: FloatArray  # (3, 3)
    origin: FloatArray  # (3,) mm, centre of voxel (0, 0, 0)
    segments: tuple[Segment, ...]  # named in a ``.seg.nrrd``; empty for other files


def read_volume(
    path: Path | str,
    *,
    modality: Modality | None = None,
    frame_interval_s: float | None = None,
    time_unit: str | None = None,
) -> VolumeSequence:
    """Read a volume over time, or a single frame. Left-handed directions stay left-handed.

    InputError if the file is damaged, has an unsupported format, lacks required information,
    contradicts an argument, or is not a plausible image of a heart.

    Parameters
    ----------
    path
        NRRD (``.nrrd``, ``.seq.nrrd``, ``.nhdr``), MetaImage (``.mha``, ``.mhd``), NIfTI (``.nii``,
        ``.nii.gz``) or Philips Cartesian DICOM.
    modality
        Required unless the file states it, as DICOM and files written by this package do.
    frame_interval_s
        Seconds between frames, for files that give no times in a unit of time.
    time_unit
        ``"s"`` or ``"ms"``, for files that give times without a unit.
    """
    source = Path(path)
    if source.is_dir():
        convert = "convert a DICOM series with 3D Slicer, to .nrrd or .seq.nrrd"
        raise InputError(f"{source}: a folder, expected one file: {READABLE}; {convert}")
    name = None if modality is None else modality.value
    found = _read(source, False, name, frame_interval_s, time_unit)
    return VolumeSequence(
        **found | {"modality": Modality(found["modality"]), "source": source.name}
    )


def read_labels(path: Path | str) -> LabelMap:
    """Read a label map or segmentation: NRRD, MetaImage or NIfTI of three or four axes.

    InputError as `read_volume`; or the file is an image, has no labels, or has non-integer values.
    """
    found = _read(Path(path), True)
    del found["sha256"]
    return LabelMap(**found | {"segments": tuple(Segment(*one) for one in found["segments"])})


def sequence_path(path: Path | str) -> Path:
    """Return the path; raise an InputError unless it ends in ``.seq.nrrd``."""
    target = Path(path)
    if not target.name.endswith(".seq.nrrd") or target.name == ".seq.nrrd":
        raise InputError(f"{target}: name {target.name!r}, expected one that ends in .seq.nrrd")
    return target


def write_sequence_nrrd(path: Path | str, sequence: VolumeSequence) -> Path:
    """Write a volume over time (uint8, int16 or float32) to a ``.seq.nrrd`` file.

    Equal content gives equal bytes. The frame axis comes first; all versions of Slicer can read
    that order.

    InputError if the name or voxel type is not supported, or the file cannot be written.
    """
    target = sequence_path(path)
    if (found := sequence.frames.dtype.name) not in WRITABLE:
        raise InputError(f"{target}: frames of type {found}, expected {', '.join(WRITABLE)}")
    steps = (sequence.direction * sequence.spacing).T
    header = {
        "space": "left-posterior-superior",
        "space directions": np.vstack([np.full((1, 3), np.nan), steps]),
        "space origin": np.asarray(sequence.origin, dtype=np.float64),
        "kinds": ["list", "domain", "domain", "domain"],
        "labels": ["time", "", "", ""],
        "units": ["s", "", "", ""],
        "encoding": "gzip",
        "DataNodeClassName": "vtkMRMLScalarVolumeNode",
        "axis 0 index type": "numeric",
        "axis 0 index values": " ".join(repr(float(time)) for time in sequence.times),
        MODALITY_KEY: sequence.modality.value,
    }
    content = io.BytesIO()
    nrrd.write(content, sequence.frames, header, compression_level=1)
    head, end, voxels = content.getvalue().partition(b"\n\n")
    # pynrrd writes the current time into comments.
    lines = [line for line in head.split(b"\n") if not line.startswith(b"#")]
    return write_atomically(target, b"\n".join(lines) + end + voxels)


def files_of_volume(path: Path) -> dict[str, Path]:
    """Files opened to read a volume, by name: the file itself, and its data file if any."""
    try:
        files = _files(path, in_child(data_file_of, path))
    except InputError:
        files = [path]
    return {file.name: file for file in files if file.is_file()}


def _files(path: Path, data_file: str) -> list[Path]:
    return [path, path.resolve().parent / data_file] if data_file else [path]


def _read(path: Path, labels: bool, *options: Any) -> dict[str, Any]:
    """The header of a file, its voxels, and the SHA-256 of all its bytes."""
    found: dict[str, Any] = in_child(describe, path, labels, *options)
    size, files = found.pop("bytes"), _files(path, found.pop("data_file"))
    stored = sum(file.stat().st_size for file in files)
    if size > max(MAX_UNCHECKED, MAX_RATIO * stored):
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
    frames = in_child(read_voxels, path, labels, **limits)
    return found | {"frames": frames, "sha256": digest.hexdigest()}


def describe(
    path: Path,
    labels: bool,
    modality: str | None = None,
    frame_interval_s: float | None = None,
    time_unit: str | None = None,
) -> dict[str, Any]:
    """The checked header of an image or label map: all fields of the result except the voxels.

    Also contains ``bytes`` (decoded size of the voxels) and ``data_file``.
    """
    stated, _ = _opened(path)
    result = _common(stated, labels)
    if not labels:
        check(not stated.labels, stated.labels, "a segmentation or label map", "an image")
        result["times"] = _times(stated, frame_interval_s, time_unit)
        return result | {"modality": _modality(stated.modality, modality)}
    check(not stated.modality, "modality", stated.modality, "a label map, no image")
    return result | {"segments": stated.segments, "is_layers": stated.is_layers}


def read_voxels(path: Path, labels: bool) -> Voxels:
    """Checked voxels ``(F, I, J, K)``: integer labels, or uint8, int16 or float32 of an image."""
    stated, load = _opened(path)
    field, frames = stated.names[3], np.ascontiguousarray(load())
    if labels:
        with np.errstate(invalid="ignore"):
            whole = frames.astype(np.int32) if frames.dtype.kind == "f" else frames
        check((whole == frames).all(), field, "other numbers", "whole numbers, the labels")
        check(whole.any(), field, "all voxels are 0", "labels from 1 on")
        return whole.astype(whole.dtype.newbyteorder("="), copy=False)
    lows, highs = (f(frames, axis=(1, 2, 3)).astype(np.float64) for f in (np.min, np.max))
    for number, (low, high) in enumerate(zip(lows, highs, strict=True)):
        finite = np.isfinite(low) and np.isfinite(high)
        check(finite, field, f"voxels of frame {number} that are no numbers", "numbers")
        found = f"all voxels of frame {number} are {low:g}"
        check(low < high, field, found, "an image in every frame")
    limits, largest = np.iinfo(np.int16), max(-lows.min(), highs.max())
    if frames.dtype == np.uint8:
        return frames
    if frames.dtype.kind in "iu" and lows.min() >= limits.min and highs.max() <= limits.max:
        return frames.astype(np.int16, copy=False)
    fits = largest <= np.finfo(np.float32).max
    check(fits, field, f"{largest:g}", "numbers in the range of 4 bytes")
    return frames.astype(np.float32, copy=False)


def data_file_of(path: Path) -> str:
    """Name of a separate file with the voxels, or an empty string."""
    return _opened(path)[0].data_file


def _opened(path: Path) -> Opened:
    """The header of a file, and a function that reads its voxels."""
    with path.open("rb") as file:
        head = begin = file.read(MAX_HEADER)
    if head[:2] == b"\x1f\x8b":
        with gzip.open(path) as stream:
            begin = stream.read(540)
    if head.startswith(b"NRRD"):
        return nrrd_file(path, head)
    if begin[344:347] in (b"n+1", b"ni1") or begin[4:7] in (b"n+2", b"ni2"):
        return nifti(path, begin)
    if head[128:132] == b"DICM" or head[:2] in (b"\x08\x00", b"\x02\x00"):
        return philips(path)
    if re.match(rb"\s*(ObjectType|NDims|Comment)\s*=", head) and b"ElementDataFile" in head:
        return metaimage(path, head)
    raise fault("content", f"{head[:8]!r}", READABLE)


def _common(stated: Stated, labels: bool) -> dict[str, Any]:
    """Checked geometry of a volume, decoded size of its voxels, and name of its data file."""
    min_voxels, extent_mm = (MIN_LABELS, LABELS_MM) if labels else (MIN_VOXELS, EXTENT_MM)
    (size, place, origin, values, _), shape = stated.names, stated.shape
    counted = f"{' x '.join(map(str, shape))} frames and voxels"
    enough = shape[0] >= 1 and min(shape[1:]) >= min_voxels
    check(enough, size, counted, f"at least one frame, and at least {min_voxels} along each axis")
    dtype = np.dtype(stated.dtype)
    plain = dtype.kind in "iuf"
    check(plain, values, f"type {dtype}", "one real number, no colour or vector")
    total = int(np.prod(shape, dtype=object)) * dtype.itemsize
    found = f"{counted} of {dtype.itemsize} bytes, together {total / 2**30:.1f} GiB"
    expected = f"at most {MAX_BYTES / 2**30:g} GiB; crop it, or take fewer frames"
    check(total <= MAX_BYTES, size, found, expected)
    spacing = np.linalg.norm(stated.steps, axis=0)
    expected = "{:g} to {:g} mm along each axis"
    fits = ((spacing >= SPACING_MM[0]) & (spacing <= SPACING_MM[1])).all()
    check(fits, place, f"{_words(spacing)} mm between voxels", expected.format(*SPACING_MM))
    axes = stated.steps / spacing
    square = np.abs(axes.T @ axes - np.eye(3)).max() <= ORTHOGONAL
    check(square, place, f"axes {_words(axes.T)}", "axes at right angles")
    extent = spacing * shape[1:]
    fits = (extent >= extent_mm[0]).all() and (extent <= extent_mm[1]).all()
    check(fits, place, f"a volume of {_words(extent)} mm", expected.format(*extent_mm))
    near = (np.abs(stated.origin) <= MAX_OFFSET_MM).all()
    check(near, origin, _words(stated.origin), f"coordinates in mm within {MAX_OFFSET_MM:g}")
    # The closest orthonormal axes remove the file's rounding errors and preserve handedness.
    left, _, right = np.linalg.svd(axes)
    return {
        "spacing": spacing,
        "direction": left @ right,
        "origin": stated.origin,
        "bytes": total,
        "data_file": stated.data_file,
    }


def _words(values: FloatArray) -> str:
    return " ".join(f"{value:.4g}" for value in np.ravel(values))


def _times(stated: Stated, frame_interval_s: float | None, time_unit: str | None) -> FloatArray:
    """Frame times ``(F,)`` s; a single frame without a time gets 0."""
    field, count, given = stated.names[4], stated.shape[0], stated.times
    unit = SECONDS_PER_UNIT.get(stated.unit.lower())
    if frame_interval_s is not None:
        known = given is not None and unit is not None
        check(not known, "frame_interval_s", frame_interval_s, f"none: {field} states the times")
        check(time_unit is None, "frame_interval_s", "given with time_unit", "one of the two")
        positive = np.isfinite(frame_interval_s) and frame_interval_s > 0
        check(positive, "frame_interval_s", frame_interval_s, "a positive number")
        given, unit = np.arange(count, dtype=np.float64), frame_interval_s
    if time_unit is not None:
        check(time_unit in SECONDS_PER_UNIT, "time_unit", repr(time_unit), "'s' or 'ms'")
        same = unit in (None, SECONDS_PER_UNIT[time_unit])
        check(same, "time_unit", repr(time_unit), f"{stated.unit!r}, as the file states")
        unit = SECONDS_PER_UNIT[time_unit]
    if given is None or unit is None:
        if count == 1:
            return np.zeros(1)
        found = f"times in the unit {stated.unit!r}" if stated.unit else "times without a unit"
        found, options = (
            ("no times of frames", "frame_interval_s")
            if given is None
            else (found, "time_unit or frame_interval_s")
        )
        raise fault(field, found, f"times in s or ms; else give {options}")
    times, low, high = given * unit, MIN_INTERVAL_S, MAX_INTERVAL_S
    complete = times.shape == (count,) and np.isfinite(times).all()
    check(complete, field, _words(times), f"a time of each of {count} frames")
    steps = np.diff(times)
    expected = f"increasing times, by at least {low:g} s and less than {high:g} s"
    check(((steps >= low) & (steps < high)).all(), field, f"{_words(times)} s", expected)
    return np.asarray(times)


def _modality(stated: str, given: str | None) -> str:
    names = [m.value for m in Modality]
    check(not stated or stated in names, MODALITY_KEY, repr(stated), ", ".join(names))
    check(not stated or given in (None, stated), "modality", given, f"{stated}, as the file states")
    expected = f"as a setting: {', '.join(names)}"
    check(stated or given, "modality", "not stated by the file", expected)
    return stated or str(given)
