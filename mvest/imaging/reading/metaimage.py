"""MetaImage files (``.mha``, ``.mhd`` with its data beside it).

Geometry is read by SimpleITK, whose world is LPS in mm. The fourth spacing is the time between
frames; the format knows no unit for it. What the header leaves out, ITK would fill in; here it is
asked for.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from mvest.imaging.reading.checks import check_size
from mvest.imaging.reading.data import beside, from_zlib, plainly, read_exactly
from mvest.imaging.reading.stated import FieldNames, StatedTimes, StatedVolume, fault

__all__ = ["is_metaimage", "read_metaimage"]

NAMES = FieldNames("DimSize", "ElementSpacing", "TransformMatrix", "Offset", "ElementDataFile")
LONGEST_HEADER = 2**16
"""Bytes within which the line ElementDataFile, the last one, must come."""

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
    fields, start = _header(path)
    dimension = _required(path, fields, "NDims", "3 or 4")
    if dimension not in ("3", "4"):
        raise fault(path, "NDims", dimension, "3 (one volume) or 4 (volumes over time)")
    for field in (NAMES.size, NAMES.spacing, NAMES.direction, NAMES.origin):
        count = int(dimension) ** (2 if field == NAMES.direction else 1)
        _check_numbers(path, field, _required(path, fields, field, f"{count} numbers"), count)
    if fields.get("ElementNumberOfChannels", "1") != "1":
        raise fault(
            path,
            "ElementNumberOfChannels",
            fields["ElementNumberOfChannels"],
            "1: one grey value, no colour or vector",
        )
    dtype = _voxel_type(path, fields)
    sizes = [int(float(word)) for word in fields["DimSize"].split()]
    sizes += [1] * (4 - len(sizes))
    check_size(path, NAMES.size, [sizes[3], *sizes[:3]], dtype.itemsize)

    name = fields["ElementDataFile"]
    local = name.upper() == "LOCAL"
    source = path if local else beside(path, "ElementDataFile", name)
    if fields.get("HeaderSize", "0") != "0":
        raise fault(path, "HeaderSize", fields["HeaderSize"], "0")
    compressed = _flag(path, fields, "CompressedData", "False")
    size = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
    with source.open("rb") as file:
        file.seek(start if local else 0)
        chunks = from_zlib(file) if compressed else plainly(file)
        flat = read_exactly(path, "ElementDataFile", chunks, size)
    frames = flat.view(dtype).reshape(sizes, order="F")
    return _placed(path, np.moveaxis(frames, 3, 0)), (path,) if local else (path, source)


def _header(path: Path) -> tuple[dict[str, str], int]:
    """Fields under their usual names, and where local data begin."""
    with path.open("rb") as file:
        head = file.read(LONGEST_HEADER)
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
    return fields, position


def _required(path: Path, fields: dict[str, str], field: str, expected: str) -> str:
    if field not in fields:
        raise fault(path, field, "not stated", expected)
    return fields[field]


def _flag(path: Path, fields: dict[str, str], field: str, default: str) -> bool:
    word = fields.get(field, default)
    if word.lower() not in FLAGS:
        raise fault(path, field, repr(word), "True or False")
    return FLAGS[word.lower()]


def _check_numbers(path: Path, field: str, value: str, count: int) -> None:
    try:
        numbers = [float(word) for word in value.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise fault(path, field, repr(value), f"{count} numbers")
    if field in (NAMES.size, NAMES.spacing) and min(numbers) <= 0:
        raise fault(path, field, value, "positive numbers")
    if field == NAMES.size and not all(number.is_integer() for number in numbers):
        raise fault(path, field, value, "whole numbers")


def _voxel_type(path: Path, fields: dict[str, str]) -> np.dtype[np.generic]:
    name = _required(path, fields, "ElementType", "the type of a voxel")
    if name not in TYPES:
        raise fault(path, "ElementType", name, ", ".join(TYPES))
    if not _flag(path, fields, "BinaryData", "True"):
        raise fault(path, "BinaryData", fields["BinaryData"], "True: numbers in binary form")
    dtype = np.dtype(TYPES[name])
    if dtype.itemsize == 1:
        return dtype
    _required(path, fields, "BinaryDataByteOrderMSB", "the order of bytes")
    return dtype.newbyteorder(">" if _flag(path, fields, "BinaryDataByteOrderMSB", "") else "<")


def _placed(path: Path, frames: np.ndarray) -> StatedVolume:
    """The frames with their place as SimpleITK reads it from the header."""
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
        times = StatedTimes(
            np.asarray(origin[3] + spacing[3] * np.arange(len(frames)), dtype=np.float64),
            "",
            NAMES.spacing,
        )
    return StatedVolume(frames, direction[:3, :3] * spacing[:3], origin[:3], times, None, NAMES)
