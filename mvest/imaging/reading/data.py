"""Exactly as many bytes as a header promises, from this file or from one beside it.

The libraries read until a file ends: what a few compressed bytes grow to has no bound there, and a
missing end or a wrong checksum passes unseen.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.reading.stated import fault

__all__ = ["beside", "from_gzip", "from_zlib", "plainly", "read_exactly"]

CHUNK = 2**22
"""Bytes read or decompressed at a time."""


def beside(path: Path, field: str, name: str) -> Path:
    """The data file that a header names; it must lie in the header's own folder.

    Raises
    ------
    InputError
        A name that leads elsewhere, or no such file.
    """
    plain = name.removeprefix("./")
    inside = plain.isprintable() and plain not in ("", ".", "..") and not set("/\\") & set(plain)
    if not inside or (path.parent / plain).resolve().parent != path.parent.resolve():
        raise fault(path, field, repr(name), "the name of a file in the same folder")
    if not (path.parent / plain).is_file():
        raise fault(path, field, f"{name!r} does not exist", "a file in the same folder")
    return path.parent / plain


def plainly(file: BinaryIO) -> Iterator[bytes]:
    """The bytes as they are."""
    while chunk := file.read(CHUNK):
        yield chunk


def from_gzip(file: BinaryIO) -> Iterator[bytes]:
    """The bytes that gzip members hold, one after the other."""
    with gzip.GzipFile(fileobj=file) as stream:
        while chunk := stream.read(CHUNK):
            yield chunk


def from_zlib(file: BinaryIO) -> Iterator[bytes]:
    """The bytes that one stream of zlib or gzip holds, with its checksum."""
    stream = zlib.decompressobj(zlib.MAX_WBITS | 32)
    rest = b""
    while not stream.eof:
        rest = rest or file.read(CHUNK)
        if not rest:
            raise EOFError("the compressed data end before their mark of the end")
        yield stream.decompress(rest, CHUNK)
        rest = stream.unconsumed_tail


def read_exactly(path: Path, field: str, chunks: Iterator[bytes], size: int) -> NDArray[np.uint8]:
    """Collect `size` bytes from chunks that must hold them and no more.

    Raises
    ------
    InputError
        Truncated or damaged data, or more than there should be.
    """
    result = np.empty(size, dtype=np.uint8)
    expected = f"the {size} bytes that the header says"
    done = 0
    try:
        for chunk in chunks:
            if done + len(chunk) > size:
                raise fault(path, field, f"more than {size} bytes", expected)
            result[done : done + len(chunk)] = np.frombuffer(chunk, dtype=np.uint8)
            done += len(chunk)
    except (EOFError, OSError, zlib.error) as error:
        raise fault(path, field, f"{done} bytes, then {error}", expected) from error
    if done < size:
        raise fault(path, field, f"{done} bytes", expected)
    return result
