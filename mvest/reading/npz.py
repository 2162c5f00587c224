"""Reading NumPy's ``.npz``: plain arrays, whose declared sizes are checked before any is made."""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.reading.bounded import max_inflated
from mvest.reading.text import one_line

MAX_ARRAYS = 2**29
"""Bytes of all arrays in one file."""
MAX_MEMBERS = 10_000
MAX_HEADER = 4096
"""Bytes that say what an array is; those of plain ones are 128."""
MAX_DIMENSIONS = 8
MAX_LENGTH_OF_NOTHING = 1_000_000
"""Of a dimension of an array without elements."""
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
CHUNK = 2**20
"""Bytes that are inflated at a time."""
KINDS = "biufSU"
"""Of numbers and text."""
NAMES = {"b": "booleans", "i": "integers", "f": "finite numbers", "U": "text"}
"""What is asked for by a letter; integers and numbers of every width."""

_DAMAGE = (
    *(OSError, ValueError, LookupError, EOFError, RuntimeError, ArithmeticError, TypeError),
    *(SyntaxError, MemoryError, AttributeError, AssertionError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""What ``zipfile``, ``zlib`` and NumPy raise of files that somebody damaged."""


def read_npz(
    path: Path | IO[bytes],
    names: Sequence[str] | None = None,
    *,
    exact: bool = False,
    optional: Sequence[str] = (),
    max_bytes: int = MAX_ARRAYS,
    where: str = "",
) -> dict[str, NDArray[Any]]:
    """The arrays in a file, without pickled objects.

    Parameters
    ----------
    path : Path or binary stream
    names : sequence of str, optional
        Arrays that must be there, and the only ones that are read; without them all are.
    exact : bool
        Whether others may not be there.
    optional : sequence of str
        Arrays that are read as well if they are there.
    max_bytes : int
        Of the arrays that are read.
    where : str
        What an error calls the file; its path without.

    Returns
    -------
    dict
        Arrays of numbers or text by their names, in the byte order of the machine.

    Raises
    ------
    InputError
        If the file is missing or damaged, is no such file, is encrypted, lacks an array or holds
        others, or declares more bytes than it may; the message is one line and names the array.
    """
    where = where or str(path)
    try:
        size = path.stat().st_size if isinstance(path, Path) else path.seek(0, 2)
        if isinstance(path, Path) and not path.is_file():
            raise InputError(f"{where}: cannot be read: it is no regular file")
        with zipfile.ZipFile(path) as archive:
            members = _members(archive, where)
            asked = list(members) if names is None else list(names)
            asked += [name for name in optional if name in members and name not in asked]
            missing = [name for name in asked if name not in members]
            if missing:
                shown = one_line(", ".join(missing), 120)
                raise InputError(f"{where}: arrays {shown} are missing")
            if exact and len(members) != len(asked):
                more = one_line(", ".join(name for name in members if name not in asked), 120)
                raise InputError(f"{where}: holds arrays {more} beside those that are expected")
            limit = min(max_bytes, max_inflated(size))
            total = sum(members[name].file_size for name in asked)
            if total > limit:
                raise InputError(f"{where}: {total} bytes of arrays, expected at most {limit}")
            return {name: _array(archive, members[name], f"{where}: {name}") for name in asked}
    except InputError:
        raise
    except FileNotFoundError as fault:
        raise InputError(f"{where} is missing") from fault
    except _DAMAGE as fault:
        raise InputError(
            f"{where}: cannot be read: {one_line(fault, 100)}; expected .npz of plain arrays, "
            "without pickles"
        ) from fault


def check_array(
    array: NDArray[Any], where: str, kind: str, shape: Sequence[int | None]
) -> NDArray[Any]:
    """An array as 64-bit numbers, booleans or text, if it is of its kind and shape.

    Parameters
    ----------
    array : ndarray
    where : str
        File and name, for an error.
    kind : {"f", "i", "b", "U"}
        Finite real numbers, integers, booleans, text.
    shape : sequence of int or None
        None: any length.

    Raises
    ------
    InputError
    """
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in {"i": "iu"}.get(kind, kind):
        wanted = tuple("any" if want is None else want for want in shape)
        raise InputError(
            f"{where} is {array.dtype} of shape {array.shape}, expected {NAMES[kind]} of shape "
            f"{wanted}".replace("'any'", "any")
        )
    if kind == "f":
        if not np.isfinite(array).all():
            raise InputError(f"{where} has values that are not finite")
        return array.astype(np.float64)
    if kind == "i":
        if array.size and int(array.max()) > np.iinfo(np.int64).max:
            raise InputError(f"{where}: {array.max()}, expected integers of 64 bits with a sign")
        return array.astype(np.int64)
    return array


def _members(archive: zipfile.ZipFile, where: str) -> dict[str, zipfile.ZipInfo]:
    """Member by the name of its array."""
    entries = archive.infolist()
    if len(entries) > MAX_MEMBERS:
        raise InputError(f"{where}: {len(entries)} arrays, expected at most {MAX_MEMBERS}")
    members: dict[str, zipfile.ZipInfo] = {}
    for entry in entries:
        name = entry.filename.removesuffix(".npy")
        if name in members:
            raise InputError(f"{where}: {one_line(name, 60)}: occurs twice")
        if entry.flag_bits & 1 or entry.compress_type not in METHODS:
            raise InputError(
                f"{where}: {one_line(name, 60)}: encrypted, or compressed otherwise than NumPy does"
            )
        members[name] = entry
    return members


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, where: str) -> NDArray[Any]:
    with archive.open(entry) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise InputError(f"{where}: version {version} of the format, expected 1 or 2")
        header = np.lib.format.read_array_header_1_0
        if version == (2, 0):
            header = np.lib.format.read_array_header_2_0
        shape, in_columns, dtype = header(stream, max_header_size=MAX_HEADER)
        if dtype.kind not in KINDS or not dtype.itemsize:
            raise InputError(
                f"{where} is of {one_line(dtype, 60)}; expected .npz of plain arrays of numbers or "
                "text, without pickles"
            )
        if len(shape) > MAX_DIMENSIONS or any(n < 0 for n in shape):
            raise InputError(f"{where}: shape {one_line(shape, 60)}")
        size = math.prod(shape) * dtype.itemsize
        if size != entry.file_size - stream.tell() or (
            not size and max(shape) > MAX_LENGTH_OF_NOTHING
        ):
            raise InputError(
                f"{where}: shape {one_line(shape, 60)} of {one_line(dtype, 40)} does not fit the "
                f"{entry.file_size} bytes of the array"
            )
        content, at = bytearray(size), 0
        while at < size:
            part = stream.read(min(CHUNK, size - at))
            if not part:
                raise InputError(f"{where}: ends after {at} of {size} bytes")
            content[at : at + len(part)] = part
            at += len(part)
        # Only at the end of a member its checksum is compared.
        if stream.read(1):
            raise InputError(f"{where}: more than {size} bytes")
    array = np.frombuffer(content, dtype).reshape(shape, order="F" if in_columns else "C")
    if dtype.kind == "U":
        _check_characters(array, where)
    return array.astype(dtype.newbyteorder("="), copy=False)


def _check_characters(array: NDArray[np.str_], where: str) -> None:
    codes = np.frombuffer(array.tobytes(), array.dtype.str[0] + "u4")
    if np.any((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes < 0xE000))):
        raise InputError(f"{where}: characters that are no Unicode")
