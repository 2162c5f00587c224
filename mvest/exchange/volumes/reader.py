"""One door for all files that hold a volume over time; MetaImage and NIfTI are read here.

MetaImage files (``.mha``, ``.mhd`` with its data beside it): the world is LPS in mm. The fourth
spacing is the time between frames; the format knows no unit for it. What the header leaves out, ITK
would make up; here it is asked for. Each row of TransformMatrix is the direction of one axis (ITK,
``itkMetaImageIO.cxx``).

NIfTI files (``.nii``, ``.nii.gz``), versions 1 and 2: the world is RAS. The header is read by
nibabel. The unit of length may be missing: of those that the format knows (m, mm, um) only mm
passes the checks of spacing. The unit of time has to be there.
"""

from __future__ import annotations

import gzip
import hashlib
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.exchange.volumes.data import (
    FieldNames,
    Header,
    StatedTimes,
    StatedVolume,
    beside,
    fault,
    read_exactly,
)
from mvest.exchange.volumes.nrrd_file import read_nrrd
from mvest.exchange.volumes.philips import is_dicom, read_philips
from mvest.exchange.volumes.plausible import MAX_BYTES, check_size, checked_sequence
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.reading.bounded import array_of_words, refusing
from mvest.typing import FloatArray

METAIMAGE_NAMES = FieldNames(
    "DimSize", "ElementSpacing", "TransformMatrix", "Offset", "ElementDataFile"
)
MAX_HEADER_BYTES = 2**16
"""Within which the line ElementDataFile, the last one, must come."""
UNIT_LENGTH = 1e-3
"""By how much the length of an axis may differ from 1; files give three digits or more."""

TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
FLAGS = {"true": True, "1": True, "false": False, "0": False}
SYNONYMS = {
    "Position": "Offset",
    "Origin": "Offset",
    "Rotation": "TransformMatrix",
    "Orientation": "TransformMatrix",
    "ElementByteOrderMSB": "BinaryDataByteOrderMSB",
}
SUPPORTED = {
    "ElementNumberOfChannels": ("1", "1: one grey value, no colour or vector"),
    "HeaderSize": ("0", "0"),
}
"""The only value of fields that may be left out, and what a message expects."""


def is_metaimage(head: bytes) -> bool:
    """Whether a file that begins so is a MetaImage."""
    first = head.split(b"\n", 1)[0].split(b"=")[0].strip()
    return first in (b"ObjectType", b"NDims", b"Comment") and b"NDims" in head


def read_metaimage(path: Path, max_bytes: int) -> tuple[StatedVolume, tuple[Path, ...]]:
    """Read a MetaImage of three or four axes, with the files that it consists of.

    Raises
    ------
    InputError
        A field that is missing, contradicts another or is not supported; truncated data.
    """
    header = _header(path)
    n = header.required("NDims", "3 or 4")
    if n not in ("3", "4"):
        raise fault(path, "NDims", n, "3 (one volume) or 4 (volumes over time)")
    axes = int(n)
    size = _numbers(header, METAIMAGE_NAMES.size, axes)
    spacing = _numbers(header, METAIMAGE_NAMES.spacing, axes)
    direction = _numbers(header, METAIMAGE_NAMES.direction, axes**2).reshape(axes, axes).T
    origin = _numbers(header, METAIMAGE_NAMES.origin, axes)
    for field, (value, expected) in SUPPORTED.items():
        if header.fields.get(field, value) != value:
            raise fault(path, field, header.fields[field], expected)
    dtype = _voxel_type(header)
    compressed = _flag(header, "CompressedData", "False")
    sizes = [*map(int, size), 1][:4]
    check_size(path, METAIMAGE_NAMES.size, [sizes[3], *sizes[:3]], dtype.itemsize, max_bytes)
    name = header.fields["ElementDataFile"]
    local = name.upper() == "LOCAL"
    source = path if local else beside(path, "ElementDataFile", name)
    with source.open("rb") as file:
        file.seek(header.length if local else 0)
        count = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
        flat = read_exactly(path, "ElementDataFile", file, count, "zlib" if compressed else "")
    frames = np.moveaxis(flat.view(dtype).reshape(sizes, order="F"), 3, 0)
    steps, times = _placed(path, spacing, direction, origin, sizes[3])
    return StatedVolume(frames, steps, origin[:3], times, None, METAIMAGE_NAMES), (
        (path,) if local else (path, source)
    )


def _header(path: Path) -> Header:
    """Words of the fields under their usual names."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    fields: dict[str, str] = {}
    position = 0
    while "ElementDataFile" not in fields:
        end = head.find(b"\n", position)
        line = head[position : end if end >= 0 else len(head)].decode("utf-8", errors="replace")
        name, equals, value = (word.strip() for word in line.partition("="))
        if not equals or (end < 0 and name != "ElementDataFile"):
            raise fault(path, "header", f"line {line!r}", "'Field = value' to ElementDataFile")
        name = SYNONYMS.get(name, name)
        if fields.setdefault(name, value) != value:
            raise fault(path, name, f"{fields[name]!r} and {value!r}", "one value")
        position = end + 1 if end >= 0 else len(head)
    return Header(path, fields, position)


def _flag(header: Header, field: str, default: str) -> bool:
    word = header.fields.get(field, default)
    if word.lower() not in FLAGS:
        raise fault(header.path, field, repr(word), "True or False")
    return FLAGS[word.lower()]


def _numbers(header: Header, field: str, count: int) -> FloatArray:
    """A field's numbers, all of which have to be stated, as ITK would go on without."""
    value = header.required(field, f"{count} numbers")
    try:
        numbers = array_of_words(value.split(), np.float64)
    except InputError:
        numbers = np.zeros(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise fault(header.path, field, repr(value), f"{count} numbers")
    if field in (METAIMAGE_NAMES.size, METAIMAGE_NAMES.spacing) and numbers.min() <= 0:
        raise fault(header.path, field, value, "positive numbers")
    if field == METAIMAGE_NAMES.size and not all(word.isdecimal() for word in value.split()):
        raise fault(header.path, field, value, "whole numbers")
    return numbers


def _voxel_type(header: Header) -> np.dtype[np.generic]:
    name = header.required("ElementType", "the type of a voxel")
    if name not in TYPES:
        raise fault(header.path, "ElementType", name, ", ".join(TYPES))
    if not _flag(header, "BinaryData", "True"):
        raise fault(header.path, "BinaryData", "False", "True: numbers in binary form")
    dtype = np.dtype(TYPES[name])
    if dtype.itemsize > 1:
        header.required("BinaryDataByteOrderMSB", "the order of bytes")
        dtype = dtype.newbyteorder(">" if _flag(header, "BinaryDataByteOrderMSB", "") else "<")
    return dtype


def _placed(
    path: Path, spacing: FloatArray, direction: FloatArray, origin: FloatArray, count: int
) -> tuple[FloatArray, StatedTimes]:
    """Steps ``(3, 3)`` between voxels, and when the frames were taken."""
    lengths = np.linalg.norm(direction, axis=0)
    if np.abs(lengths - 1).max() > UNIT_LENGTH:
        raise fault(path, METAIMAGE_NAMES.direction, f"axes of length {lengths}", "unit vectors")
    steps = direction[:3, :3] * spacing[:3]
    if len(spacing) == 3:
        return steps, StatedTimes(None, "", "NDims")
    if direction[3, :3].any() or direction[:3, 3].any() or direction[3, 3] != 1:
        raise fault(
            path, METAIMAGE_NAMES.direction, direction[3], "the fourth axis to be time alone"
        )
    values = origin[3] + spacing[3] * np.arange(count, dtype=np.float64)
    return steps, StatedTimes(values, "", METAIMAGE_NAMES.spacing)


NIFTI_NAMES = FieldNames("dim", "sform or qform", "sform or qform", "sform or qform", "data")
GZIP = b"\x1f\x8b"
MM_PER_UNIT = {"unknown": 1.0, "mm": 1.0, "meter": 1000.0, "micron": 1e-3}
TO_LPS = np.array([-1.0, -1.0, 1.0])
MAX_CODE = 5
"""Of the forms of coordinates that the format knows."""
ROUNDING = 1e-3
"""Relative difference of lengths that the header gives twice."""
BYTES_BEFORE = (352, 2**24)
"""Of header and extensions, before the voxels."""


def _begin(path: Path) -> bytes:
    """The first bytes, decompressed if need be."""
    with path.open("rb") as file:
        head = file.read(2)
        file.seek(0)
        if head != GZIP:
            return file.read(540)
        try:
            with gzip.GzipFile(fileobj=file) as stream:
                return stream.read(540)
        except (EOFError, OSError, zlib.error):
            return b""


def is_nifti(path: Path) -> bool:
    """Whether a file, compressed or not, has the mark of NIfTI 1 or 2, as one file or two."""
    head = _begin(path)
    return head[344:348] in (b"n+1\0", b"ni1\0") or head[4:8] in (b"n+2\0", b"ni2\0")


def read_nifti(path: Path, max_bytes: int) -> tuple[StatedVolume, tuple[Path, ...]]:
    """Read a NIfTI file of three or four axes.

    Raises
    ------
    InputError
        A field that is missing, contradicts another or is not supported; truncated data.
    """
    import nibabel

    begin = _begin(path)
    second = begin[4:7] in (b"n+2", b"ni2")
    kind: Any = nibabel.Nifti2Header if second else nibabel.Nifti1Header
    if b"ni" in (begin[344:346], begin[4:6]):
        raise fault(path, "magic", "a header without its image", "one file, .nii or .nii.gz")
    try:
        # Unchecked, as nibabel's checks put right by guessing what is wrong.
        header = kind(begin[: kind.template_dtype.itemsize], check=False)
        shape = header.get_data_shape()
        dtype = header.get_data_dtype()
        affine = np.asarray(header.get_best_affine(), dtype=np.float64)
        units = header.get_xyzt_units()
        scaling = header.get_slope_inter()
    except Exception as error:  # nibabel fails in many ways on a damaged header
        raise fault(path, "header", error, "one that nibabel reads") from error
    if len(shape) not in (3, 4):
        raise fault(path, "dim", " ".join(map(str, shape)), "3 or 4 axes")
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise fault(path, "datatype", dtype, "one grey value, no colour or complex number")
    sizes = (*shape, 1)[:4]
    check_size(path, "dim", [sizes[3], *sizes[:3]], dtype.itemsize, max_bytes)
    steps, origin = _geometry(path, header, affine, units[0])
    times = _times(path, header, len(shape), int(sizes[3]), units[1])
    frames = _frames(path, header, dtype, sizes)
    slope, intercept = scaling
    if slope is not None and (slope, intercept) != (1.0, 0.0):
        frames = frames.astype(np.float32)
        frames *= np.float32(slope)
        frames += np.float32(intercept)
    return StatedVolume(frames, steps, origin, times, None, NIFTI_NAMES), (path,)


def _geometry(
    path: Path, header: Any, affine: FloatArray, unit: str
) -> tuple[FloatArray, FloatArray]:
    for field in ("sform_code", "qform_code"):
        if not 0 <= int(header[field]) <= MAX_CODE:
            raise fault(path, field, int(header[field]), f"0 to {MAX_CODE}")
    if int(header["sform_code"]) == 0 and int(header["qform_code"]) == 0:
        raise fault(path, "sform_code", "0, as is qform_code", "a direction of the axes")
    if unit not in MM_PER_UNIT:
        raise fault(path, "xyzt_units", unit, "mm")
    lengths = np.linalg.norm(affine[:3, :3], axis=0)
    zooms = np.array(header.get_zooms()[:3], dtype=np.float64)
    if not np.allclose(zooms, lengths, rtol=ROUNDING, atol=0):
        raise fault(
            path,
            "pixdim",
            " ".join(f"{zoom:g}" for zoom in zooms),
            f"the spacing of sform or qform, {' '.join(f'{length:g}' for length in lengths)}",
        )
    scale = TO_LPS * MM_PER_UNIT[unit]
    return affine[:3, :3] * scale[:, np.newaxis], affine[:3, 3] * scale


def _times(path: Path, header: Any, dimension: int, count: int, unit: str) -> StatedTimes:
    if dimension == 3:
        return StatedTimes(None, "", "dim")
    if unit in ("hz", "ppm", "rads"):
        raise fault(path, "xyzt_units", unit, "a fourth axis of time")
    step = float(header["pixdim"][4])
    if not step > 0:
        return StatedTimes(None, "", "pixdim[4]")
    values = float(header["toffset"]) + step * np.arange(count, dtype=np.float64)
    return StatedTimes(values, "" if unit == "unknown" else unit, "pixdim[4] with xyzt_units")


def _frames(path: Path, header: Any, dtype: np.dtype[Any], sizes: tuple[int, ...]) -> np.ndarray:
    size = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
    offset = float(header["vox_offset"])
    if not BYTES_BEFORE[0] <= offset <= BYTES_BEFORE[1]:
        raise fault(path, "vox_offset", offset, f"{BYTES_BEFORE[0]} to {BYTES_BEFORE[1]} bytes")
    start = int(offset)
    with path.open("rb") as file:
        packed = "gzip" if file.read(2) == GZIP else ""
        file.seek(0)
        content = read_exactly(path, "data", file, start + size, packed)
    return np.moveaxis(content[start:].view(dtype).reshape(sizes, order="F"), 3, 0)


READABLE = "NRRD, MetaImage, NIfTI or Philips Cartesian DICOM"


def read_volume(
    path: Path | str,
    *,
    modality: Modality | None = None,
    frame_interval_s: float | None = None,
    time_unit: str | None = None,
    max_bytes: int = MAX_BYTES,
    labels: bool = False,
) -> VolumeSequence:
    """Read a volume over time; what the file is, its content says, not its name.

    Nothing is guessed: what the file does not state must be given, and what it states must not be
    contradicted. Directions stay as the file has them, left-handed ones included. A file may hold a
    single frame.

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
    labels
        Whether the voxels are wanted as labels: a segmentation is no image and refused otherwise.
        Frames (or layers) without times are then taken to be a second apart.

    Raises
    ------
    InputError
        In one line the file, the field, what was found and what was expected: a file of another
        kind, truncated or damaged; not three or four axes; colour; no spacing, direction or origin,
        or such as no heart fits (0.05 to 5 mm, 20 to 500 mm in all, at least 16 voxels along each
        axis); axes that are not at right angles; a frame without contrast; values that are no
        numbers; times that do not increase, or by less than 2 ms or 1 s and more; more than
        `max_bytes`, or data compressed more than 100 times.
    """
    source = Path(path)
    if source.is_dir():
        raise fault(
            source,
            "path",
            "a folder",
            f"one file: {READABLE}; convert a DICOM series with 3D Slicer, to .nrrd or .seq.nrrd",
        )
    if not source.is_file():
        raise InputError(f"{source}: no such file")
    # What overflows is refused with the numbers that are no finite ones.
    with np.errstate(all="ignore"), refusing(source, "volume"):
        stated, files = _stated(source, max_bytes, labels)
        sha256 = _sha256(files)
        if labels and stated.times.values is None:
            frame_interval_s = 1.0
        return checked_sequence(source, stated, sha256, modality, frame_interval_s, time_unit)


def _stated(path: Path, max_bytes: int, labels: bool) -> tuple[StatedVolume, tuple[Path, ...]]:
    """What the file states, and the files that it consists of."""
    with path.open("rb") as file:
        head = file.read(1024)
    if head.startswith(b"NRRD"):
        return read_nrrd(path, max_bytes, labels=labels)
    if is_nifti(path):
        return read_nifti(path, max_bytes)
    if is_dicom(head):
        return read_philips(path, max_bytes)
    if is_metaimage(head):
        return read_metaimage(path, max_bytes)
    raise fault(path, "content", f"{head[:8]!r}", READABLE)


def _sha256(files: tuple[Path, ...]) -> str:
    """Of the bytes of all files, one after the other."""
    digest = hashlib.sha256()
    for path in files:
        with path.open("rb") as file:
            while chunk := file.read(2**20):
                digest.update(chunk)
    return digest.hexdigest()
