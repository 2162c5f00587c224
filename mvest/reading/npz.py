"""Reads plain arrays from NumPy's ``.npz``; checks the stated sizes before allocating any."""

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
"""Largest decoded size of the arrays read from one file."""
KINDS = "biufSU"
"""NumPy kinds of numbers and text."""

_DAMAGE = (
    *(OSError, ValueError, LookupError, EOFError, RuntimeError, ArithmeticError, TypeError),
    *(SyntaxError, MemoryError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""Exceptions that ``zipfile``, ``zlib`` and NumPy raise for damaged files."""


def read_npz(
    path: Path | IO[bytes],
    names: Sequence[str] | None = None,
    *,
    exact: bool = False,
    optional: Sequence[str] = (),
    where: str = "",
) -> dict[str, NDArray[Any]]:
    """Read the arrays in a file, in native byte order; pickled objects are errors.

    InputError if the file is missing or damaged, lacks an array or has others, or declares more
    than `MAX_BYTES`.

    Parameters
    ----------
    path : Path or binary stream
    names : sequence of str, optional
        Required arrays; only these are read. By default all arrays are read.
    exact : bool
        Whether other arrays raise an error.
    optional : sequence of str
        Further arrays to read if present.
    where : str
        Name of the file in errors; its path by default.
    """
    where = where or str(path)
    try:
        # NumPy itself would also read a pickle or a single array.
        with zipfile.ZipFile(path) as archive:
            sizes = {one.filename.removesuffix(".npy"): one.file_size for one in archive.filelist}
        wanted = list(sizes) if names is None else list(names)
        wanted += [name for name in optional if name in sizes and name not in wanted]
        if missing := ", ".join(name for name in wanted if name not in sizes):
            raise InputError(f"{where}: arrays {one_line(missing, 120)} are missing")
        if exact and (more := ", ".join(name for name in sizes if name not in wanted)):
            raise InputError(
                f"{where}: holds arrays {one_line(more, 120)} in addition to those needed"
            )
        total = sum(sizes[name] for name in wanted)
        if total > MAX_BYTES:
            raise InputError(f"{where}: {total} bytes of arrays, expected at most {MAX_BYTES}")
        if not isinstance(path, Path):
            path.seek(0)
        with np.load(path, allow_pickle=False) as arrays:
            return {name: _plain(arrays[name], f"{where}: {one_line(name, 60)}") for name in wanted}
    except FileNotFoundError as fault:
        raise InputError(f"{where} is missing") from fault
    except InputError:
        raise
    except _DAMAGE as fault:
        raise InputError(
            f"{where}: cannot be read: {one_line(fault, 100)}; expected .npz of plain arrays, "
            "without pickles"
        ) from fault


def _plain(array: Any, where: str) -> NDArray[Any]:
    # NumPy returns members without its header as bytes. An empty array may declare any length.
    plain = isinstance(array, np.ndarray) and array.dtype.kind in KINDS and array.dtype.itemsize
    if not plain or max(array.shape, default=0) > MAX_BYTES:
        raise InputError(f"{where}: expected a plain array of numbers or text")
    array = np.asarray(array, array.dtype.newbyteorder("="))
    if array.dtype.kind == "U":
        codes = np.ascontiguousarray(array).view(np.uint32)
        if ((codes > 0x10FFFF) | (codes >> 11 == 0x1B)).any():  # 0x1B << 11: surrogates
            raise InputError(f"{where}: characters that are no Unicode")
    return array


def check_array(
    array: NDArray[Any], where: str, kind: str, shape: Sequence[int | None]
) -> NDArray[Any]:
    """Convert an array to text (kind U), 64-bit integers (i) or finite numbers (f) of a shape.

    A length of None matches any. ``where`` names the array in errors.

    InputError if the kind or shape differs, or a number is not finite.
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
