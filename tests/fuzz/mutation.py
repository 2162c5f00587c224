"""Changes of a valid file: of its bytes, its words and numbers, its lines, and what it compresses.

Each change is a value, so that `hypothesis` can draw it and make it smaller.
"""

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
from dataclasses import dataclass

__all__ = ["CHANGES", "MAX_BYTES", "Change", "changed", "random_changes"]

MAX_BYTES = 10**6
"""Of a damaged file."""
HEAD = 2048
"""Bytes in which a header is looked for, where half of all changes take place."""
NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][\w.-]*")

NUMBERS = (
    *(b"0", b"-1", b"1", b"2", b"-0", b"0.5", b"255", b"65536", b"1000000", b"1000000000"),
    *(b"2147483647", b"2147483648", b"-2147483649", b"4294967295", b"4294967296", b"1000000000000"),
    *(b"9223372036854775807", b"9223372036854775808", b"18446744073709551616", b"-1" + b"0" * 400),
    *(b"1" + b"0" * 400, b"9" * 5000, b"0." + b"3" * 500, b"1e200", b"-1e200", b"1e309", b"1e-320"),
    *(b"1e9999999999", b"nan", b"NaN", b"-inf", b"Infinity", b"1_0", b"0x10", b"0o7", b"0b1"),
    *(b"1:1", b"1:1:1:1", b"010", b"+5", b"1.", b".5", b"1,5", b"1 2", b"", b"true", b"null", b"~"),
    *("٣".encode(), "１２".encode(), "½".encode(), "−1".encode(), b"1e", b"--1", b"1j", b"(1)"),
)
WORDS = (
    *(
        b"",
        b" ",
        b"null",
        b"none",
        b"NaN",
        b"true",
        b"False",
        b"[]",
        b"{}",
        b'""',
        b"..",
        b"../../x",
    ),
    *(b"/etc/hostname", b"/dev/zero", b"C:\\x", b"%s%n", b"{0}", b"$HOME", b"\\ud800", b"\\u0000"),
    *(b"\xed\xa0\x80", b"\xff\xfe", b"\xef\xbb\xbf", b"\0", b"\x1b[31m", "\u202e".encode(), b"\r"),
    *(
        "é".encode("latin-1"),
        "\U0001f600".encode(),
        b"a" * 300,
        b"a" * 40000,
        b"[" * 5000,
        b"{" * 5000,
    ),
    *(b"!!python/object:os.system", b"&a", b"*a", b"<<", b"- " * 5000, b"<a>" * 5000, b"((" * 3000),
)
INTEGERS = (
    *(0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0xFFFFFF, 0x7FFFFFFF, 0x80000000),
    *(0xFFFFFFFE, 0xFFFFFFFF, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1),
)
REALS = (0.0, -0.0, 1e-320, 1e30, 1e308, -1e38, float("inf"), float("-inf"), float("nan"))
BROKEN = (zipfile.BadZipFile, zlib.error, lzma.LZMAError)
ENCODINGS = ("utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp037", "utf-7")
Operator = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True)
class Change:
    """An operator by its name, and the number from which its random choices follow."""

    name: str
    seed: int


def _place(content: bytes, draw: random.Random) -> int:
    """Half of the time within what may be a header."""
    return draw.randrange(1 + (min(len(content), HEAD) if draw.random() < 0.5 else len(content)))


def _length(content: bytes, draw: random.Random) -> int:
    """Of a run: mostly short."""
    return min(len(content), int(2 ** draw.uniform(0, 14)))


def _match(
    pattern: re.Pattern[bytes], content: bytes, draw: random.Random
) -> re.Match[bytes] | None:
    """One of the matches after a place, so that no large file is searched whole."""
    start = _place(content, draw)
    found = list(pattern.finditer(content, start, start + 400)) or list(
        pattern.finditer(content, 0, HEAD)
    )
    return draw.choice(found) if found else None


def _replaced(content: bytes, match: re.Match[bytes] | None, by: bytes) -> bytes:
    return content if match is None else content[: match.start()] + by + content[match.end() :]


def bits(content: bytes, draw: random.Random) -> bytes:
    result = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8))):
        place = _place(content[:-1], draw)
        if result:
            result[place] ^= 1 << draw.randrange(8)
    return bytes(result)


def integer(content: bytes, draw: random.Random) -> bytes:
    """Two, four or eight bytes made an extreme number in either order of bytes."""
    width, place = draw.choice((2, 4, 4, 8, 8)), _place(content, draw)
    place -= place % draw.choice((1, 2, 4))
    number = (draw.choice(INTEGERS) % 256**width).to_bytes(width, draw.choice(("little", "big")))
    return content[:place] + number + content[place + width :]


def real(content: bytes, draw: random.Random) -> bytes:
    place, form = _place(content, draw), draw.choice(("<f", ">f", "<d", ">d"))
    place -= place % 4
    try:
        number = struct.pack(form, draw.choice(REALS))
    except OverflowError:
        number = struct.pack(form, float("inf"))
    return content[:place] + number + content[place + len(number) :]


def truncation(content: bytes, draw: random.Random) -> bytes:
    return content[: _place(content, draw)]


def removal(content: bytes, draw: random.Random) -> bytes:
    place = _place(content, draw)
    return content[:place] + content[place + _length(content, draw) :]


def duplication(content: bytes, draw: random.Random) -> bytes:
    place, length = _place(content, draw), _length(content, draw)
    return content[: place + length] + content[place:]


def splice(content: bytes, draw: random.Random) -> bytes:
    source, place, length = _place(content, draw), _place(content, draw), _length(content, draw)
    piece = content[source : source + length]
    return content[:place] + piece + content[place + draw.choice((0, length)) :]


def run(content: bytes, draw: random.Random) -> bytes:
    """A long run of one byte."""
    place, length = _place(content, draw), int(2 ** draw.uniform(3, 19))
    return (
        content[:place]
        + draw.choice((b"\0", b"\n", b" ", b"0", b"9", b"[", b"(", b"\xff")) * (length)
        + content[place:]
    )


def number(content: bytes, draw: random.Random) -> bytes:
    return _replaced(content, _match(NUMBER, content, draw), draw.choice(NUMBERS))


def word(content: bytes, draw: random.Random) -> bytes:
    return _replaced(content, _match(WORD, content, draw), draw.choice(WORDS))


def other_word(content: bytes, draw: random.Random) -> bytes:
    """A word of the file in place of another one."""
    other = _match(WORD, content, draw)
    return _replaced(content, _match(WORD, content, draw), b"" if other is None else other.group())


def line(content: bytes, draw: random.Random) -> bytes:
    """A line of the first ones twice, away, in another's place or repeated many times."""
    lines = content.split(b"\n", 200)
    a, b = draw.randrange(len(lines)), draw.randrange(len(lines))
    kind = draw.randrange(4)
    if kind == 0:
        lines.insert(b, lines[a])
    elif kind == 1:
        del lines[a]
    elif kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    else:
        lines[a : a + 1] = [lines[a]] * min(20000, MAX_BYTES // (2 + len(lines[a])))
    return b"\n".join(lines)


def encoding(content: bytes, draw: random.Random) -> bytes:
    return content.decode("latin-1").encode(draw.choice(ENCODINGS), errors="replace")


def inside(content: bytes, draw: random.Random) -> bytes:
    """Other changes of what is compressed in a gzip or zip file, with checksums that are right."""
    name = draw.choice([name for name in CHANGES if name != "inside"])
    if content[:2] == b"\x1f\x8b":
        try:
            return gzip.compress(CHANGES[name](gzip.decompress(content), draw), 1)
        except (OSError, EOFError, *BROKEN):
            return content
    if content[:2] != b"PK":
        return CHANGES[name](content, draw)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {item: archive.read(item) for item in archive.namelist()}
    except (OSError, EOFError, ValueError, NotImplementedError, *BROKEN):
        return content
    chosen = draw.choice(sorted(members)) if members else ""
    members[chosen] = CHANGES[name](members.get(chosen, b""), draw)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", draw.choice((0, 8, 12, 14))) as archive:
        for item, data in members.items():
            archive.writestr(item or "x", data)
    return packed.getvalue()


CHANGES: dict[str, Operator] = {
    operator.__name__: operator
    for operator in (
        *(truncation, bits, number, word, line, integer, real, other_word, removal, duplication),
        *(splice, run, encoding, inside),
    )
}
"""By name, those first that say most about a failure."""
WEIGHTS = {"number": 4, "inside": 4, "word": 3, "integer": 3, "encoding": 0.3, "run": 0.5}


def changed(content: bytes, changes: list[Change]) -> bytes:
    """A file's bytes after some changes, at most `MAX_BYTES` of them."""
    for change in changes:
        content = CHANGES[change.name](content, random.Random(change.seed))[:MAX_BYTES]
    return content


def random_changes(draw: random.Random) -> list[Change]:
    """One to four of them."""
    names = draw.choices(
        list(CHANGES),
        [WEIGHTS.get(name, 1.0) for name in CHANGES],
        k=draw.choice((1, 1, 1, 2, 3, 4)),
    )
    return [Change(name, draw.getrandbits(32)) for name in names]
