"""What a file states of a volume over time, before any of it is believed, and its data.

Exactly as many bytes are read as a header promises, from this file or from one beside it. The
libraries allocate what a header says and read until a file ends: what a few compressed bytes grow
to has no bound there, and a missing end or a wrong checksum passes unseen.
"""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.imaging.volume import Modality
from mvest.reading.bounded import max_inflated
from mvest.reading.text import MAX_LINE, one_line
from mvest.typing import FloatArray

MIN_VALUE = 40
"""Characters of a value that are shown in any case."""


def fault(path: Path, field: str, value: object, expected: str) -> InputError:
    """What to raise where a file's field is not what it must be, in one line of bounded length."""
    field = one_line(field, 80)
    left = MAX_LINE - len(f"{path.name}: {field}: , expected {expected}")
    return InputError(
        f"{path}: {field}: {one_line(value, max(left, MIN_VALUE))}, expected {expected}"
    )


@dataclass(frozen=True, slots=True)
class Header:
    """The fields of a file of text before its voxels.

    Attributes
    ----------
    path : Path
    fields : dict
        Values by the format's own names.
    length : int
        Bytes up to the voxels.
    """

    path: Path
    fields: Mapping[str, Any]
    length: int

    def required(self, field: str, expected: str) -> Any:
        """Value of a field that must be there.

        Raises
        ------
        InputError
            The file does not state it.
        """
        if field not in self.fields:
            raise fault(self.path, field, "not stated", expected)
        return self.fields[field]


@dataclass(frozen=True, slots=True)
class FieldNames:
    """How the format calls what a message may be about.

    Attributes
    ----------
    size, spacing, direction, origin, values : str
    """

    size: str
    spacing: str
    direction: str
    origin: str
    values: str


@dataclass(frozen=True, slots=True, eq=False)
class StatedTimes:
    """When the frames were taken, as far as a file says.

    Attributes
    ----------
    values : (T,) or None
        In `unit`; None where the file says nothing.
    unit : str
        As the file writes it; empty where it does not.
    field : str
        Where they stand, or where they would.
    """

    values: FloatArray | None
    unit: str
    field: str


@dataclass(frozen=True, slots=True, eq=False)
class StatedVolume:
    """Frames with their place in space and time as a file states them.

    Attributes
    ----------
    frames : (T, I, J, K)
        Numbers of any type, in any order of memory.
    steps : (3, 3) mm
        Its columns lead from one voxel to the next along i, j and k, in LPS.
    origin : (3,) mm
        Centre of voxel (0, 0, 0), in LPS.
    times : StatedTimes
    modality : Modality or None
        None where the file does not say.
    names : FieldNames
    """

    frames: NDArray[np.generic]
    steps: FloatArray
    origin: FloatArray
    times: StatedTimes
    modality: Modality | None
    names: FieldNames


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


MAX_HEADER = 2**20
"""Bytes within which a header that has its data elsewhere names them."""


def files_of_volume(path: Path) -> dict[str, Path]:
    """Name -> file of all that reading a volume can open, as far as it is there.

    These are the file, and files beside it whose names are in its header, whichever field it is.
    """
    try:
        with path.open("rb") as file:
            head = file.read(MAX_HEADER)
        detached = head.startswith(b"NRRD") or b"ElementDataFile" in head
        others = [other for other in path.parent.iterdir() if detached and other.is_file()]
    except (OSError, ValueError):
        # It is refused when it is read.
        return {}
    return {other.name: other for other in others if os.fsencode(other.name) in head} | {
        path.name: path
    }


def read_exactly(
    path: Path, field: str, file: BinaryIO, size: int, packed: str = ""
) -> NDArray[np.uint8]:
    """The `size` bytes that a file must hold from where it is, and no more.

    Parameters
    ----------
    path, field
        For messages.
    file
        At the first of the bytes.
    size
        As the header declares it; nothing is allocated that the file cannot fill.
    packed
        Empty for bytes as they are, ``"gzip"`` for members one after the other, or ``"zlib"`` for
        one stream of zlib or gzip, with its checksum.

    Raises
    ------
    InputError
        Truncated or damaged data, more than there should be, or more than what is compressed may
        hold (`mvest.reading.bounded`).
    """
    stored = os.fstat(file.fileno()).st_size - file.tell()
    expected = f"the {size} bytes that the header says"
    if packed and size > max_inflated(stored):
        raise fault(
            path,
            field,
            f"{size} bytes compressed to {stored}",
            f"at most {max_inflated(stored)}, or data without compression",
        )
    if not packed and stored != size:
        raise fault(path, field, f"{stored} bytes", expected)
    result = np.empty(size, dtype=np.uint8)
    done = 0
    try:
        for chunk in _CHUNKS[packed](file):
            if done + len(chunk) > size:
                raise fault(path, field, f"more than {size} bytes", expected)
            result[done : done + len(chunk)] = np.frombuffer(chunk, dtype=np.uint8)
            done += len(chunk)
    except (EOFError, OSError, zlib.error) as error:
        raise fault(path, field, f"{done} bytes, then {error}", expected) from error
    if done < size:
        raise fault(path, field, f"{done} bytes", expected)
    return result


def _plainly(file: BinaryIO) -> Iterator[bytes]:
    while chunk := file.read(CHUNK):
        yield chunk


def _from_gzip(file: BinaryIO) -> Iterator[bytes]:
    with gzip.GzipFile(fileobj=file) as stream:
        while chunk := stream.read(CHUNK):
            yield chunk


def _from_zlib(file: BinaryIO) -> Iterator[bytes]:
    stream = zlib.decompressobj(zlib.MAX_WBITS | 32)
    rest = b""
    while not stream.eof:
        rest = rest or file.read(CHUNK)
        if not rest:
            raise EOFError("the compressed data end before their mark of the end")
        yield stream.decompress(rest, CHUNK)
        rest = stream.unconsumed_tail


_CHUNKS: dict[str, Callable[[BinaryIO], Iterator[bytes]]] = {
    "": _plainly,
    "gzip": _from_gzip,
    "zlib": _from_zlib,
}
