"""Changes of a file: of its bytes, words, numbers and lines, and of what it compresses."""

from __future__ import annotations

import gzip
import random
import re
import zlib
from collections.abc import Callable

MAX_BYTES = 10**6
"""Of a damaged file."""
HEAD = 2048
"""Bytes that may be a header; half of all changes are made there."""
NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][\w.-]*")
NUMBERS = (
    *("0", "-1", "2", "0.5", "2147483648", "9223372036854775808", "1e309", "nan", "1_0", "0x10"),
    *("1:1", "1,5", "true", "--1", "٣", "", "1 2", "9" * 5000),
)
WORDS = (
    *("null", "[]", "{}", "../../x", "/dev/zero", "%s%n", "{0}", "&a", "*a", "<<", "é", "", "\0"),
    *("!!python/x:y", "\\ud800", "\x1b[31m", "\u202e", "\r", "a" * 40000, "[" * 5000),
    *("- " * 5000, "<a>" * 5000),
)
INTEGERS = [0, 1, 2, *(2**k - j for k in (7, 8, 15, 16, 31, 32, 63, 64) for j in (0, 1))]
EXTREMES = [
    n.to_bytes(k, order)
    for n in INTEGERS for k in (2, 4, 8) for order in ("little", "big") if n < 256**k
]  # fmt: skip


def place(content: bytes, draw: random.Random) -> int:
    return draw.randrange(1 + (min(len(content), HEAD) if draw.random() < 0.5 else len(content)))


def put(content: bytes, at: int, piece: bytes, over: int) -> bytes:
    return content[:at] + piece + content[at + over :]


def match(pattern: re.Pattern[bytes], content: bytes, draw: random.Random) -> slice:
    """A match near a random place, so that large files are not searched whole."""
    start = place(content, draw)
    found = [*pattern.finditer(content, start, start + 400)]
    found = found or [*pattern.finditer(content, 0, HEAD)]
    return slice(*draw.choice(found).span()) if found else slice(0, 0)


def bits(content: bytes, draw: random.Random) -> bytes:
    result = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8)) if content else 0):
        result[place(content[:-1], draw)] ^= 1 << draw.randrange(8)
    return bytes(result)


def extreme(content: bytes, draw: random.Random) -> bytes:
    at, piece = place(content, draw), draw.choice(EXTREMES)
    return put(content, at - at % draw.choice((1, 2, 4)), piece, len(piece))


def removal(content: bytes, draw: random.Random) -> bytes:
    size = draw.choice((int(2 ** draw.uniform(0, 14)), len(content)))
    return put(content, place(content, draw), b"", size)


def splice(content: bytes, draw: random.Random) -> bytes:
    """A piece of the file somewhere else, in addition or in place of other bytes."""
    source = place(content, draw)
    piece = content[source : source + int(2 ** draw.uniform(0, 14))]
    return put(content, place(content, draw), piece, draw.choice((0, len(piece))))


def number(content: bytes, draw: random.Random) -> bytes:
    at = match(NUMBER, content, draw)
    return put(content, at.start, draw.choice(NUMBERS).encode(), at.stop - at.start)


def word(content: bytes, draw: random.Random) -> bytes:
    """An odd word, or another word of the file, in place of one."""
    at, other = match(WORD, content, draw), content[match(WORD, content, draw)]
    by = other if draw.random() < 0.3 else draw.choice(WORDS).encode(errors="replace")
    return put(content, at.start, by, at.stop - at.start)


def line(content: bytes, draw: random.Random) -> bytes:
    """One of the first lines removed, moved or repeated many times."""
    lines = content.split(b"\n", 200)
    a, b = draw.randrange(len(lines)), draw.randrange(len(lines))
    many = min(20000, MAX_BYTES // (2 + len(lines[a])))
    lines[b : b + draw.randrange(2)] = [lines[a]] * draw.choice((0, 1, 1, many))
    return b"\n".join(lines)


def inside(content: bytes, draw: random.Random) -> bytes:
    """A change within a gzip stream, with a correct checksum."""
    change = draw.choice(CHANGES)
    try:
        return gzip.compress(change(gzip.decompress(content), draw), 1)
    except (OSError, EOFError, zlib.error):
        return change(content, draw)


CHANGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    *(bits, number, word, line, extreme, removal, splice),
)
WEIGHTS = [1, 4, 3, 1, 4, 2, 1, 4]


def changed(content: bytes, draw: random.Random) -> bytes:
    """A file's bytes after one to four changes."""
    for change in draw.choices((*CHANGES, inside), WEIGHTS, k=draw.choice((1, 1, 1, 2, 3, 4))):
        content = change(content, draw)[:MAX_BYTES]
    return content
