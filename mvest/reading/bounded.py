"""What a file of others may take: bytes once it is inflated, and one line that says what is wrong.

What is compressed may hold `MAX_UNASKED` bytes however small it is, and beyond that `MAX_RATIO`
times its own size. Images and surfaces of the heart have 1.5 to 20 times; 100 leaves a volume that
is almost empty its place, and keeps a file of 1 MB below 100 MB, of which a reader holds a few
copies at most.
"""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mvest.errors import InputError, MvestError
from mvest.reading.text import MAX_LINE, one_line

MAX_UNASKED = 2**26
MAX_RATIO = 100
MAX_DICTIONARY = 2**27
"""Bytes that LZMA may look back on."""


def max_inflated(stored: int) -> int:
    """How many bytes a compressed file of a size may hold."""
    return max(MAX_UNASKED, MAX_RATIO * stored)


def inflate(data: bytes, max_size: int, *, of_lzma: bool = False) -> bytes:
    """What one whole stream of zlib or LZMA holds, of at most so many bytes.

    Raises
    ------
    InputError
        It holds more, or is damaged or cut off.
    """
    try:
        if of_lzma:
            packed = lzma.LZMADecompressor(memlimit=MAX_DICTIONARY)
            result, whole = packed.decompress(data, max_size + 1), packed.eof
        else:
            stream = zlib.decompressobj()
            result, whole = stream.decompress(data, max_size + 1), stream.eof
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise InputError(f"compressed data are damaged: {error}") from error
    if len(result) > max_size:
        raise InputError(
            f"compressed data hold more than {max_size} bytes; save it without compression"
        )
    if not whole:
        raise InputError("compressed data end too early")
    return result


def array_of_words(words: Sequence[str], dtype: DTypeLike) -> NDArray[Any]:
    """Decimal numbers in text as an array ``(n,)``.

    Raises
    ------
    InputError
        A word that is no such number, also one that only Python reads (``1_0``), or too large.
    """
    try:
        if any("_" in word or not word.isascii() for word in words):
            raise ValueError("digits that only Python reads")
        return np.array(words, dtype=dtype)
    except (ValueError, OverflowError) as error:
        raise InputError(f"damaged numbers: {one_line(error, 100)}") from error


@contextmanager
def refusing(path: Path, what: str) -> Iterator[None]:
    """Let nothing out but errors of this package, in one line that names the file.

    The one guard of readers that go through a library: those fail in many ways on what is damaged.

    Raises
    ------
    MvestError
        As raised within, its words cleaned and cut to `MAX_LINE` characters, the folder of the file
        aside; an `InputError` for everything else.
    """
    try:
        yield
    except MvestError as error:
        words = str(error).removeprefix(f"{path}: ")
        raise type(error)(_line(path, words)) from error
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise InputError(_line(path, f"damaged or no {what}: {reason}")) from error


def _line(path: Path, words: str) -> str:
    return f"{path}: {one_line(words, MAX_LINE - len(path.name) - 2)}"
