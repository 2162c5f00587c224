"""The voxels of NRRD files, raw or compressed, beside their header or after it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.reading.data import beside, from_gzip, plainly, read_exactly
from mvest.imaging.reading.nrrd_header import NrrdHeader
from mvest.imaging.reading.stated import fault

__all__ = ["read_data", "voxel_type"]

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
        chunks = plainly(file) if encoding == "raw" else from_gzip(file)
        flat = read_exactly(path, field, chunks, size)
    files = (path,) if name is None else (path, source)
    return flat.view(dtype).reshape(sizes, order="F"), files
