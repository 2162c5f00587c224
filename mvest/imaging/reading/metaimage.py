"""MetaImage files (``.mha``, ``.mhd`` with its data beside it).

The place is read by SimpleITK, whose world is LPS in mm. The fourth spacing is the time
between frames; the format knows no unit for it. What the header leaves out, ITK would make up; here
it is asked for.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mvest.imaging.reading.data import beside, from_zlib, plainly, read_exactly
from mvest.imaging.reading.plausible import check_size
from mvest.imaging.reading.stated import FieldNames, Header, StatedTimes, StatedVolume, fault

__all__ = ["is_metaimage", "read_metaimage"]

NAMES = FieldNames("DimSize", "ElementSpacing", "TransformMatrix", "Offset", "ElementDataFile")
MAX_HEADER_BYTES = 2**16
"""Within which the line ElementDataFile, the last one, must come."""

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


def read_metaimage(path: Path) -> tuple[StatedVolume, tuple[Path, ...]]:
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
    for field in (NAMES.size, NAMES.spacing, NAMES.direction, NAMES.origin):
        _check_numbers(header, field, int(n) ** (2 if field == NAMES.direction else 1))
    for field, (value, expected) in SUPPORTED.items():
        if header.fields.get(field, value) != value:
            raise fault(path, field, header.fields[field], expected)
    dtype = _voxel_type(header)
    compressed = _flag(header, "CompressedData", "False")
    sizes = [*map(int, header.fields[NAMES.size].split()), 1][:4]
    check_size(path, NAMES.size, [sizes[3], *sizes[:3]], dtype.itemsize)
    name = header.fields["ElementDataFile"]
    local = name.upper() == "LOCAL"
    source = path if local else beside(path, "ElementDataFile", name)
    with source.open("rb") as file:
        file.seek(header.length if local else 0)
        chunks = from_zlib(file) if compressed else plainly(file)
        size = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
        flat = read_exactly(path, "ElementDataFile", chunks, size)
    frames = np.moveaxis(flat.view(dtype).reshape(sizes, order="F"), 3, 0)
    return _placed(path, frames), (path,) if local else (path, source)


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
            raise fault(path, "header", f"line {line[:80]!r}", "'Field = value' to ElementDataFile")
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


def _check_numbers(header: Header, field: str, count: int) -> None:
    """Every number is stated, as ITK would go on without."""
    value = header.required(field, f"{count} numbers")
    try:
        numbers = [float(word) for word in value.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise fault(header.path, field, repr(value), f"{count} numbers")
    if field in (NAMES.size, NAMES.spacing) and min(numbers) <= 0:
        raise fault(header.path, field, value, "positive numbers")
    if field == NAMES.size and not all(word.isdecimal() for word in value.split()):
        raise fault(header.path, field, value, "whole numbers")


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


def _placed(path: Path, frames: np.ndarray) -> StatedVolume:
    """The frames with their place as SimpleITK reads it from the header."""
    import SimpleITK

    reader: Any = SimpleITK.ImageFileReader()  # type: ignore[no-untyped-call]
    reader.SetImageIO("MetaImageIO")
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        words = str(error).split("ITK ERROR:")[-1]
        raise fault(path, "header", words, "what SimpleITK reads as MetaImage") from error
    n = reader.GetDimension()
    spacing, origin = np.array(reader.GetSpacing()), np.array(reader.GetOrigin())
    direction = np.array(reader.GetDirection()).reshape(n, n)
    times = StatedTimes(None, "", "NDims")
    if n == 4:
        if direction[3, :3].any() or direction[:3, 3].any() or direction[3, 3] != 1:
            raise fault(path, NAMES.direction, direction[3], "the fourth axis to be time alone")
        values = origin[3] + spacing[3] * np.arange(len(frames), dtype=np.float64)
        times = StatedTimes(np.asarray(values), "", NAMES.spacing)
    return StatedVolume(frames, direction[:3, :3] * spacing[:3], origin[:3], times, None, NAMES)
