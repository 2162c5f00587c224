"""The voxels of NRRD files, raw or compressed, beside their header or after it."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.reading.nrrd_header import NrrdHeader
from mvest.imaging.reading.stated import fault

__all__ = ["beside", "read_data", "read_exactly", "voxel_type"]

TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(
        ("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"
    ),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    "float": "f4",
    "double": "f8",
}
"""Types of the format by all their names, 8-byte integers and blocks aside."""

CHUNK = 2**24
"""Bytes decompressed at a time."""


def voxel_type(header: NrrdHeader) -> np.dtype[np.generic]:
    """The type of a voxel, with its order of bytes."""
    name = header.required("type", "the type of a voxel")
    if name not in TYPES:
        raise fault(header.path, "type", repr(name), "integers of up to 4 bytes, float or double")
    dtype = np.dtype(TYPES[name])
    if dtype.itemsize == 1:
        return dtype
    order = header.required("endian", "little or big")
    if order not in ("little", "big"):
        raise fault(header.path, "endian", repr(order), "little or big")
    return dtype.newbyteorder("<" if order == "little" else ">")


def beside(path: Path, field: str, name: str) -> Path:
    """The data file that a header names; it must lie in the header's own folder.

    Raises
    ------
    InputError
        A name that leads elsewhere, or no such file.
    """
    plain = name.removeprefix("./")
    data = path.parent / plain
    inside = "/" not in plain and "\\" not in plain and plain not in ("", ".", "..")
    if not inside or data.resolve().parent != path.parent.resolve():
        raise fault(path, field, repr(name), "the name of a file in the same folder")
    if not data.is_file():
        raise fault(path, field, f"{name!r} does not exist", "a file in the same folder")
    return data


def read_exactly(path: Path, field: str, stream: BinaryIO, size: int) -> NDArray[np.uint8]:
    """Read `size` bytes from a stream that must hold them and no more.

    Raises
    ------
    InputError
        Truncated or damaged data, or more than there should be.
    """
    result = np.empty(size, dtype=np.uint8)
    view = result.data
    done = 0
    expected = f"the {size} bytes that the header says"
    try:
        while done < size:
            count = stream.readinto(view[done : done + CHUNK])  # type: ignore[attr-defined]
            if not count:
                raise fault(path, field, f"{done} bytes", expected)
            done += count
        more = stream.read(1)
    except (EOFError, OSError, zlib.error) as error:
        raise fault(path, field, f"{done} bytes, then {error}", expected) from error
    if more:
        raise fault(path, field, f"more than {size} bytes", expected)
    return result


def read_data(
    header: NrrdHeader, dtype: np.dtype[np.generic], sizes: tuple[int, ...]
) -> tuple[NDArray[np.generic], tuple[Path, ...]]:
    """Voxels in the shape `sizes`, first axis fastest, and the files that they came from."""
    path, name = header.path, header.fields.get("data file")
    encoding = header.required("encoding", "raw or gzip")
    if encoding not in ("raw", "gzip", "gz"):
        raise fault(path, "encoding", repr(encoding), "raw or gzip")
    source, field = (path, "data") if name is None else (beside(path, "data file", name), name)
    size = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
    lines = int(header.fields.get("line skip", 0))
    skip = int(header.fields.get("byte skip", 0))
    if lines < 0 or skip < -1 or (skip and encoding != "raw"):
        raise fault(path, "byte skip", f"{skip}, with {lines} lines", "as NRRD defines it, no gzip")
    with source.open("rb") as file:
        file.seek(header.length if name is None else 0)
        for _ in range(lines):
            file.readline()
        if skip == -1:
            start = source.stat().st_size - size
            if start < file.tell():
                raise fault(path, field, f"{size + start} bytes", f"{size} bytes or more")
            file.seek(start)
        else:
            file.seek(skip, 1)
        if encoding == "raw":
            found = source.stat().st_size - file.tell()
            if found != size:
                raise fault(path, field, f"{found} bytes", f"the {size} bytes that sizes say")
            flat = read_exactly(path, field, file, size)
        else:
            with gzip.GzipFile(fileobj=file) as stream:
                flat = read_exactly(path, field, stream, size)  # type: ignore[arg-type]
    files = (path,) if name is None else (path, source)
    return flat.view(dtype).reshape(sizes, order="F"), files
