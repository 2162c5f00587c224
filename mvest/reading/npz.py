"""Reading NumPy's ``.npz``: plain arrays, whose stated sizes are checked before any is made."""

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
from mvest.reading.text import one_line

MAX_BYTES = 2**29
"""Of the arrays that are read from one file; what is compressed inflates to no more than stated."""
MAX_LENGTH_OF_NOTHING = 1_000_000
"""Of a dimension of an array without elements."""
KINDS = "biufSU"
"""Of numbers and text."""

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_DAMAGE = (
    *(OSError, ValueError, LookupError, EOFError, RuntimeError, ArithmeticError, TypeError),
    *(SyntaxError, MemoryError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""What ``zipfile``, ``zlib`` and NumPy raise of files that somebody damaged."""


def read_npz(
    path: Path | IO[bytes],
    names: Sequence[str] | None = None,
    *,
    exact: bool = False,
    optional: Sequence[str] = (),
    where: str = "",
) -> dict[str, NDArray[Any]]:
    """The arrays in a file, without pickled objects.

    Parameters
    ----------
    path : Path or binary stream
    names : sequence of str, optional
        Arrays that must be there, and the only ones that are read; without them all are.
    exact : bool
        Whether the file may hold no others.
    optional : sequence of str
        Arrays beside these that are read if they are there.
    where : str
        What an error calls the file; its path without.

    Returns
    -------
    dict
        Arrays of numbers or text by their names, in the byte order of the machine.

    Raises
    ------
    InputError
        If the file is missing or damaged, lacks an array or holds others, or states more than
        `MAX_BYTES`; the message is one line and names the array.
    """
    where = where or str(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            wanted = list(members) if names is None else list(names)
            wanted += [name for name in optional if name in members and name not in wanted]
            if missing := ", ".join(name for name in wanted if name not in members):
                raise InputError(f"{where}: arrays {one_line(missing, 120)} are missing")
            more = ", ".join(name for name in members if name not in wanted)
            if exact and more:
                raise InputError(f"{where}: holds arrays {one_line(more, 120)} beside those needed")
            total = sum(members[name].file_size for name in wanted)
            if total > MAX_BYTES:
                raise InputError(f"{where}: {total} bytes of arrays, expected at most {MAX_BYTES}")
            return {
                name: _array(archive, members[name], f"{where}: {one_line(name, 60)}")
                for name in wanted
            }
    except FileNotFoundError as fault:
        raise InputError(f"{where} is missing") from fault
    except _DAMAGE as fault:
        if isinstance(fault, InputError):
            raise
        raise InputError(
            f"{where}: cannot be read: {one_line(fault, 100)}; expected .npz of plain arrays, "
            "without pickles"
        ) from fault


def check_array(
    array: NDArray[Any], where: str, kind: str, shape: Sequence[int | None]
) -> NDArray[Any]:
    """An array as text (kind U), or as 64-bit integers (i) or finite numbers (f), of a shape.

    A length of None fits any. ``where`` names the array in an error.

    Raises
    ------
    InputError
        It is of another kind or shape, or holds numbers that are not finite.
    """
    sizes = zip(shape, array.shape, strict=False)
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in sizes)
    if not fits or array.dtype.kind not in {"i": "iu"}.get(kind, kind):
        wanted = {"i": "integers", "f": "finite numbers", "U": "text"}[kind]
        lengths = ", ".join("any" if want is None else str(want) for want in shape)
        raise InputError(
            f"{where} is {array.dtype} of shape {array.shape}, expected {wanted} of shape "
            f"({lengths}{',' if len(shape) == 1 else ''})"
        )
    if kind == "f" and not np.isfinite(array).all():
        raise InputError(f"{where} has values that are not finite")
    return array if kind == "U" else array.astype({"f": np.float64, "i": np.int64}[kind])


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, where: str) -> NDArray[Any]:
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(f"{where}: compressed otherwise than NumPy does")
    with archive.open(entry) as stream:
        shape, in_columns, dtype = _HEADERS[np.lib.format.read_magic(stream)](stream)
        if dtype.kind not in KINDS or not dtype.itemsize:
            raise InputError(
                f"{where} is of {one_line(dtype, 60)}; expected plain arrays of numbers or text"
            )
        size = math.prod(shape) * dtype.itemsize
        whole = size == entry.file_size - stream.tell() and min(shape, default=0) >= 0
        if not whole or (not size and max(shape) > MAX_LENGTH_OF_NOTHING):
            raise InputError(
                f"{where}: shape {one_line(shape, 60)} of {one_line(dtype, 40)} does not fit the "
                f"{entry.file_size} bytes of the array"
            )
        content = bytearray(stream.read())
    array = np.frombuffer(content, dtype).reshape(shape, order="F" if in_columns else "C")
    if dtype.kind == "U":
        codes = np.frombuffer(content, dtype.str[0] + "u4")
        if ((codes > 0x10FFFF) | (codes >> 11 == 0x1B)).any():  # 0x1B << 11: surrogates
            raise InputError(f"{where}: characters that are no Unicode")
    return array.astype(dtype.newbyteorder("="), copy=False)
