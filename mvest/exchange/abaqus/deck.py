"""What an Abaqus input deck states of a mesh, its tissue and one step, and the text of the deck.

The text is split into blocks of a keyword and its data lines. A deck has no units.

Format: *Abaqus Analysis User's Guide*, "Input syntax rules": a keyword line begins with one star, a
comment with two; words are separated by commas, options are ``NAME=VALUE``; case does not matter
but within quotes; a keyword line that ends with a comma goes on.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mvest.errors import InputError
from mvest.reading.bounded import array_of_words
from mvest.reading.text import MAX_NUMBER, one_line
from mvest.typing import FloatArray, IntArray

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


T = TypeVar("T")

SHELLS = {"S4": 4, "S4R": 4, "S4RS": 4, "S4RSW": 4, "S3": 3, "S3R": 3, "S3RS": 3}
TRUSSES = {"T3D2": 2, "CONN3D2": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Amplitude:
    """A share that runs in time: constant outside, smooth steps or straight lines between points.

    Attributes
    ----------
    times, values : ndarray
        ``(n,)`` s, increasing, and the share there.
    smooth : bool
        Whether it is made of Abaqus' smooth steps, ``10 u^3 - 15 u^4 + 6 u^5`` between two points.
    """

    times: FloatArray
    values: FloatArray
    smooth: bool

    def __call__(self, t: FloatArray) -> FloatArray:
        """Share at times ``(k,)`` s."""
        if not self.smooth:
            return np.interp(t, self.times, self.values)
        i = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        u = np.clip((t - self.times[i]) / (self.times[i + 1] - self.times[i]), 0.0, 1.0)
        rise = u**3 * (10 - 15 * u + 6 * u**2)
        return self.values[i] + rise * (self.values[i + 1] - self.values[i])


@dataclass(frozen=True, slots=True, eq=False)
class Elements:
    """Elements of one type.

    Attributes
    ----------
    kind : str
        As the deck has it, ``S4R`` say.
    first : int
        Number of the first of them in the deck.
    nodes : ndarray
        ``(m, k)`` numbers of nodes.
    """

    kind: str
    first: int
    nodes: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class ElementSection:
    """What elements are made of.

    Attributes
    ----------
    elements : ndarray
        Their numbers.
    material : str
    size : float or None
        Thickness of a shell (mm), cross section of a truss (mm^2); None where it says none.
    """

    elements: IntArray
    material: str
    size: float | None


@dataclass(frozen=True, slots=True, eq=False)
class FaceLoad:
    """Pressure on elements.

    Attributes
    ----------
    elements : ndarray
        Their numbers.
    value : float
        At a share of 1; positive where it pushes against the elements' normals.
    amplitude : str
        Name; empty where there is none.
    """

    elements: IntArray
    value: float
    amplitude: str


@dataclass(frozen=True, slots=True, eq=False)
class Deck:
    """What a deck states; nodes and elements of all instances count from 0 in its order.

    Attributes
    ----------
    nodes : ndarray
        ``(n, 3)``.
    elements : tuple of Elements
    node_sets, element_sets : mapping
        ``INSTANCE.SET`` or ``SET``, in capitals -> numbers, increasing.
    sections : tuple of ElementSection
    materials : mapping
        Name -> its elastic and hyperelastic blocks by keyword.
    amplitudes : mapping
    displacement : ndarray
        ``(n, 3)`` prescribed at a share of 1; NaN where a coordinate is free.
    paced_by : ndarray
        ``(n, 3)`` number of the amplitude in ``pace_names``.
    pace_names : tuple of str
    pressures : tuple of FaceLoad
    period : float
        s, of the step.
    """

    nodes: FloatArray
    elements: tuple[Elements, ...]
    node_sets: Mapping[str, IntArray]
    element_sets: Mapping[str, IntArray]
    sections: tuple[ElementSection, ...]
    materials: Mapping[str, Mapping[str, Block]]
    amplitudes: Mapping[str, Amplitude]
    displacement: FloatArray
    paced_by: IntArray
    pace_names: tuple[str, ...]
    pressures: tuple[FaceLoad, ...]
    period: float

    def node_set(self, name: str) -> IntArray:
        """Numbers of the nodes of a set, whose instance may be left out where one alone has it.

        Raises
        ------
        InputError
            If there is no such set, or several.
        """
        return lookup(self.node_sets, name, "node set")

    def element_set(self, name: str) -> IntArray:
        """Numbers of the elements of a set; as `node_set`."""
        return lookup(self.element_sets, name, "element set")

    def share(self, amplitude: str, times: FloatArray) -> FloatArray:
        """Share of a prescribed quantity at times ``(k,)`` s.

        Raises
        ------
        InputError
            If there is no such amplitude.
        """
        if amplitude not in self.amplitudes:
            name = f"amplitude {amplitude!r}" if amplitude else "a quantity without an amplitude"
            raise InputError(f"{one_line(name, 60)}, expected one of {some(self.amplitudes)}")
        return self.amplitudes[amplitude](times)

    def moved(self, nodes: IntArray, times: FloatArray) -> FloatArray:
        """Displacement ``(k, n, 3)`` of constrained nodes at times ``(k,)`` s.

        Raises
        ------
        InputError
            If a node is free, or moves without an amplitude.
        """
        end = self.displacement[nodes]
        if np.isnan(end).any():
            free = int(nodes[np.isnan(end).any(axis=1)][0])
            raise InputError(f"node {free + 1} of the mesh is free, expected it prescribed")
        result = np.zeros((len(times), len(nodes), 3))
        for k in np.unique(self.paced_by[nodes][end != 0]):
            share = self.share(self.pace_names[k], times)
            here = np.where(self.paced_by[nodes] == k, end, 0.0)
            result += share[:, None, None] * here
        return result


def lookup(sets: Mapping[str, T], name: str, what: str) -> T:
    """What has a name, whose instance may be left out where one alone has it.

    Raises
    ------
    InputError
        If nothing has it, or several have.
    """
    wanted = name.upper()
    found = [key for key in sets if key == wanted or key.endswith(f".{wanted}")]
    if wanted not in found and len(found) != 1:
        raise InputError(
            f"{len(found) or 'no'} {what}s {one_line(name, 60)!r}; there are {some(sets)}"
        )
    return sets[wanted if wanted in found else found[0]]


def some(names: Iterable[str]) -> str:
    """Names for a message, shortened where they are many."""
    return one_line(", ".join(names), 160) or "none"
