"""Changes of a file: of its bytes, its words and numbers, its lines, and what it compresses."""

from __future__ import annotations

import gzip
import io
import lzma
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable

__all__ = ["changed"]

MAX_BYTES = 10**6
"""Of a damaged file."""
HEAD = 2048
"""Bytes in which a header is looked for, where half of all changes take place."""
NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][\w.-]*")
SHORT_NUMBERS = (
    "0 -1 1 2 -0 0.5 255 65536 1000000 1000000000 2147483647 2147483648 -2147483649 4294967295 "
    "4294967296 1000000000000 9223372036854775807 9223372036854775808 18446744073709551616 1e200 "
    "-1e200 1e309 1e-320 1e9999999999 nan NaN -inf Infinity 1_0 0x10 0o7 0b1 1:1 1:1:1:1 010 +5 1. "
    ".5 1,5 true null ~ 1e --1 1j (1) ٣ １２ ½ −1"
)
NUMBERS = [
    *SHORT_NUMBERS.split(),
    *("", "1 2", "1" + "0" * 400, "9" * 5000, "0." + "3" * 500),
]
SHORT_WORDS = (
    r"null none NaN true False [] {} .. ../../x /etc/hostname /dev/zero C:\x %s%n {0} $HOME \ud800 "
    r"\u0000 !!python/object:os.system &a *a << é"
)
WORDS = [
    *SHORT_WORDS.split(),
    *("", " ", '""', "\0", "\x1b[31m", "\u202e", "\ufeff", "\r", "a" * 300, "a" * 40000),
    *("[" * 5000, "{" * 5000, "- " * 5000, "<a>" * 5000, "((" * 3000),
]
INTEGERS = [0, 1, 2, *(2**k - 1 for k in (7, 8, 15, 16, 31, 32, 63, 64)),
            *(2**k for k in (7, 15, 16, 24, 31, 40, 62, 63))]  # fmt: skip
REALS = [0.0, -0.0, 1e-320, 1e30, 1e308, -1e38, float("inf"), float("-inf"), float("nan")]
ENCODINGS = ["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp037", "utf-7"]
BROKEN = (OSError, EOFError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error,
          lzma.LZMAError)  # fmt: skip


def place(content: bytes, draw: random.Random) -> int:
    """Half of the time within what may be a header."""
    return draw.randrange(1 + (min(len(content), HEAD) if draw.random() < 0.5 else len(content)))


def put(content: bytes, at: int, piece: bytes, over: int | None = None) -> bytes:
    """A piece over as many bytes as it has, or others."""
    return content[:at] + piece + content[at + (len(piece) if over is None else over) :]


def length(draw: random.Random) -> int:
    """Of a run: mostly short."""
    return int(2 ** draw.uniform(0, 14))


def match(pattern: re.Pattern[bytes], content: bytes, draw: random.Random) -> slice:
    """One of the matches after a place, so that no large file is searched whole."""
    start = place(content, draw)
    found = [*pattern.finditer(content, start, start + 400)]
    found = found or [*pattern.finditer(content, 0, HEAD)]
    return slice(*draw.choice(found).span()) if found else slice(0, 0)


def bits(content: bytes, draw: random.Random) -> bytes:
    result = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8)) if content else 0):
        result[place(content[:-1], draw)] ^= 1 << draw.randrange(8)
    return bytes(result)


def integer(content: bytes, draw: random.Random) -> bytes:
    """Two, four or eight bytes made an extreme number in either order of bytes."""
    width, at = draw.choice((2, 4, 4, 8, 8)), place(content, draw)
    number = draw.choice(INTEGERS) % 256**width
    at -= at % draw.choice((1, 2, 4))
    return put(content, at, number.to_bytes(width, draw.choice(("little", "big"))))


def real(content: bytes, draw: random.Random) -> bytes:
    at, number = place(content, draw), draw.choice(REALS)
    form = draw.choice("<>") + ("d" if 1e38 < abs(number) < float("inf") else draw.choice("fd"))
    return put(content, at - at % 4, struct.pack(form, number))


def truncation(content: bytes, draw: random.Random) -> bytes:
    return content[: place(content, draw)]


def removal(content: bytes, draw: random.Random) -> bytes:
    return put(content, place(content, draw), b"", length(draw))


def splice(content: bytes, draw: random.Random) -> bytes:
    """A piece of the file elsewhere, over other bytes or between them."""
    source = place(content, draw)
    piece = content[source : source + length(draw)]
    return put(content, place(content, draw), piece, draw.choice((0, len(piece))))


def run(content: bytes, draw: random.Random) -> bytes:
    """A long run of one byte."""
    byte = draw.choice((b"\0", b"\n", b" ", b"0", b"9", b"[", b"(", b"\xff"))
    return put(content, place(content, draw), byte * int(2 ** draw.uniform(3, 19)), 0)


def number(content: bytes, draw: random.Random) -> bytes:
    at = match(NUMBER, content, draw)
    return put(content, at.start, draw.choice(NUMBERS).encode(), at.stop - at.start)


def word(content: bytes, draw: random.Random) -> bytes:
    """An odd word, or another one of the file, in place of one."""
    at, other = match(WORD, content, draw), content[match(WORD, content, draw)]
    by = other if draw.random() < 0.3 else draw.choice(WORDS).encode(draw.choice(
        ("utf-8", "utf-8", "latin-1")), errors="replace")  # fmt: skip
    return put(content, at.start, by, at.stop - at.start)


def line(content: bytes, draw: random.Random) -> bytes:
    """A line of the first ones twice, away, in another's place or repeated many times."""
    lines = content.split(b"\n", 200)
    a, b = draw.randrange(len(lines)), draw.randrange(len(lines))
    match draw.randrange(4):
        case 0:
            lines.insert(b, lines[a])
        case 1:
            del lines[a]
        case 2:
            lines[a], lines[b] = lines[b], lines[a]
        case _:
            lines[a : a + 1] = [lines[a]] * min(20000, MAX_BYTES // (2 + len(lines[a])))
    return b"\n".join(lines)


def encoding(content: bytes, draw: random.Random) -> bytes:
    return content.decode("latin-1").encode(draw.choice(ENCODINGS), errors="replace")


def inside(content: bytes, draw: random.Random) -> bytes:
    """A change of what is compressed in a gzip or zip file, with checksums that are right."""
    change = draw.choice(CHANGES)
    try:
        if content[:2] == b"\x1f\x8b":
            return gzip.compress(change(gzip.decompress(content), draw), 1)
        if content[:2] != b"PK":
            return change(content, draw)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {item: archive.read(item) for item in archive.namelist()}
    except BROKEN:
        return content
    chosen = draw.choice(sorted(members)) if members else "x"
    members[chosen] = change(members.get(chosen, b""), draw)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", draw.choice((0, 8, 12, 14))) as archive:
        for item, data in members.items():
            archive.writestr(item or "x", data)
    return packed.getvalue()


CHANGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    *(truncation, bits, number, word, line, integer, real, removal, splice, run, encoding),
)
WEIGHTS = [1, 1, 4, 3, 1, 3, 1, 1, 1, 0.5, 0.3, 4]


def changed(content: bytes, draw: random.Random) -> bytes:
    """A file's bytes after one to four changes."""
    for change in draw.choices((*CHANGES, inside), WEIGHTS, k=draw.choice((1, 1, 1, 2, 3, 4))):
        content = change(content, draw)[:MAX_BYTES]
    return content
