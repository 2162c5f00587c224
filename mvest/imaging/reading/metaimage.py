"""MetaImage files (``.mha``, ``.mhd`` with its data beside it).

The world is LPS in mm. The fourth spacing is the time between frames; the format knows no unit for
it. What the header leaves out, ITK would make up; here it is asked for. Each row of TransformMatrix
is the direction of one axis (ITK, ``itkMetaImageIO.cxx``).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvest.errors import InputError
from mvest.imaging.reading.data import beside, read_exactly
from mvest.imaging.reading.plausible import check_size
from mvest.imaging.reading.stated import FieldNames, Header, StatedTimes, StatedVolume, fault
from mvest.reading.bounded import array_of_words
from mvest.typing import FloatArray

NAMES = FieldNames("DimSize", "ElementSpacing", "TransformMatrix", "Offset", "ElementDataFile")
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
    size = _numbers(header, NAMES.size, axes)
    spacing = _numbers(header, NAMES.spacing, axes)
    direction = _numbers(header, NAMES.direction, axes**2).reshape(axes, axes).T
    origin = _numbers(header, NAMES.origin, axes)
    for field, (value, expected) in SUPPORTED.items():
        if header.fields.get(field, value) != value:
            raise fault(path, field, header.fields[field], expected)
    dtype = _voxel_type(header)
    compressed = _flag(header, "CompressedData", "False")
    sizes = [*map(int, size), 1][:4]
    check_size(path, NAMES.size, [sizes[3], *sizes[:3]], dtype.itemsize, max_bytes)
    name = header.fields["ElementDataFile"]
    local = name.upper() == "LOCAL"
    source = path if local else beside(path, "ElementDataFile", name)
    with source.open("rb") as file:
        file.seek(header.length if local else 0)
        count = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
        flat = read_exactly(path, "ElementDataFile", file, count, "zlib" if compressed else "")
    frames = np.moveaxis(flat.view(dtype).reshape(sizes, order="F"), 3, 0)
    steps, times = _placed(path, spacing, direction, origin, sizes[3])
    return StatedVolume(frames, steps, origin[:3], times, None, NAMES), (
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
    if field in (NAMES.size, NAMES.spacing) and numbers.min() <= 0:
        raise fault(header.path, field, value, "positive numbers")
    if field == NAMES.size and not all(word.isdecimal() for word in value.split()):
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
        raise fault(path, NAMES.direction, f"axes of length {lengths}", "unit vectors")
    steps = direction[:3, :3] * spacing[:3]
    if len(spacing) == 3:
        return steps, StatedTimes(None, "", "NDims")
    if direction[3, :3].any() or direction[:3, 3].any() or direction[3, 3] != 1:
        raise fault(path, NAMES.direction, direction[3], "the fourth axis to be time alone")
    values = origin[3] + spacing[3] * np.arange(count, dtype=np.float64)
    return steps, StatedTimes(values, "", NAMES.spacing)
