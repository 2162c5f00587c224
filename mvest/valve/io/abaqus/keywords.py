"""The text of an Abaqus input deck, as blocks of a keyword and its data lines.

Format: *Abaqus Analysis User's Guide*, "Input syntax rules": a keyword line begins with one star, a
comment with two; words are separated by commas, options are ``NAME=VALUE``; case does not matter
but within quotes; a keyword line that ends with a comma goes on.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.reading.bounded import array_of_words
from mvest.reading.text import MAX_NUMBER, one_line
from mvest.typing import FloatArray

_WORD = re.compile(r'(?:[^,"]|"[^"]*")+')


@dataclass(frozen=True, slots=True)
class Block:
    """A keyword, and what follows it.

    Attributes
    ----------
    keyword : str
        In capitals, words apart by one space.
    options : mapping
        In capitals -> value without quotes, empty where there is none.
    lines : tuple of str
        Data lines, without empty ones and comments.
    at : int
        Line of the keyword in the file, from 1.
    """

    keyword: str
    options: Mapping[str, str]
    lines: tuple[str, ...]
    at: int

    def __str__(self) -> str:
        return f"line {self.at}, *{one_line(self.keyword, 40)}"

    def option(self, name: str) -> str:
        """An option in capitals.

        Raises
        ------
        InputError
            If it is not there, or empty.
        """
        value = self.options.get(name, "")
        if not value:
            raise InputError(f"{self}: no {name}=")
        return value.upper()

    @property
    def rows(self) -> list[list[str]]:
        """Words of each data line; a comma at the end of a line stands for nothing."""
        return [[word.strip() for word in line.removesuffix(",").split(",")] for line in self.lines]

    @property
    def words(self) -> list[str]:
        """Words of all data lines, one after another, without empty ones."""
        return [word for row in self.rows for word in row if word]

    def table(self, width: int) -> FloatArray:
        """Data lines of so many numbers each, ``(n, width)``.

        Raises
        ------
        InputError
            If a line has another number of them.
        """
        for row in self.rows:
            if len(row) != width:
                raise InputError(f"{self}: {len(row)} numbers in a line, expected {width}")
        return self.checked([word for row in self.rows for word in row]).reshape(-1, width)

    def checked(self, words: Sequence[str]) -> FloatArray:
        """Words of this block as finite numbers ``(n,)``.

        Raises
        ------
        InputError
            If one is none, or too large.
        """
        try:
            values: FloatArray = array_of_words(words, np.float64)
        except InputError as fault:
            raise InputError(f"{self}: {fault}") from fault
        if not np.all(np.abs(values) <= MAX_NUMBER):
            raise InputError(f"{self}: numbers that are not finite, or above {MAX_NUMBER:g}")
        return values


def blocks_of(text: str) -> Iterator[Block]:
    """The blocks of a deck one after another.

    Raises
    ------
    InputError
        If there are data before the first keyword, or a keyword has none.
    """
    head, at, lines = "", 0, list[str]()
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        if not line or line.startswith("**"):
            continue
        if head.endswith(",") and not lines and not line.startswith("*"):
            head += line
        elif line.startswith("*"):
            if head:
                yield _block(head, lines, at)
            head, at, lines = line, number, []
        elif not head:
            raise InputError(f"line {number}: {one_line(line, 40)!r}, expected a keyword first")
        else:
            lines.append(line)
    if head:
        yield _block(head, lines, at)


def _block(head: str, lines: list[str], at: int) -> Block:
    first, *rest = _WORD.findall(head[1:]) or [""]
    keyword = " ".join(first.split()).upper()
    if not keyword:
        raise InputError(f"line {at}: a star without a keyword")
    options = {}
    for word in rest:
        name, _, value = word.partition("=")
        options[" ".join(name.split()).upper()] = value.strip().strip('"')
    return Block(keyword, options, tuple(lines), at)
