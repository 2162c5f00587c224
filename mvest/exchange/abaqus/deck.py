"""Abaqus input decks (``.inp``) in the form of Texas TriValve: one instance, one step.

The reader takes nodes, shells (``S4R``, ``S3``) and trusses (``T3D2``), their sets and sections,
Ogden materials, amplitudes, and the step with its duration, constrained nodes and pressure. It
refuses a deck that generates nodes or elements, has a moved instance, or includes other files. It
ignores other keywords.

Format: *Abaqus Keywords Reference Guide*, and *Analysis User's Guide*, "Input syntax rules". A
keyword line begins with one star, a comment with two; options are ``NAME=VALUE``; case does not
matter. The instance prefix of a name is ignored.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import InputError, MvestError
from mvest.reading.text import MAX_NUMBER, one_line, read_bytes
from mvest.typing import FloatArray, IntArray

CORNERS = {"S4R": 4, "S3": 3, "T3D2": 2}
"""Number of nodes of each supported element."""
_REFUSED = {
    *("INCLUDE", "NGEN", "NCOPY", "NFILL", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "TRANSFORM"),
    *("SUBMODEL", "IMPORT", "RESTART", "MAP SOLUTION", "DLOAD", "STATIC"),
}


@dataclass(slots=True)
class _Block:
    """A keyword (in capitals), its line number, its options, and the words of its data lines."""

    keyword: str
    options: dict[str, str]
    at: int
    rows: list[list[str]] = field(default_factory=list)

    def option(self, name: str, default: str | None = None) -> str:
        """An option in capitals, without its instance prefix."""
        value = self.options.get(name) or default
        if value is None:
            raise InputError(f"no {name}=")
        return _plain(value)

    @property
    def words(self) -> list[str]:
        """Words of all data lines."""
        return [word for row in self.rows for word in row if word]


class Deck:
    """The content of a deck, with nodes and elements numbered from 0 in file order.

    InputError if the file is damaged or has unsupported content; the message names the line.
    """

    def __init__(self, path: Path) -> None:
        self.nodes: list[list[float]] = []  # (n, 3)
        self.cells: list[list[int]] = []  # nodes: 4 per shell (S3 repeats the last), 2 per truss
        # NSET or ELSET -> name in capitals -> increasing numbers
        self.sets: dict[str, dict[str, IntArray]] = {"NSET": {}, "ELSET": {}}
        # Elements, material, and thickness (mm) or cross section (mm^2), 0 if not given. A later
        # section of an element overrides an earlier one.
        self.sections: list[tuple[IntArray, str, float]] = []
        self.ogden: dict[str, FloatArray] = {}  # material -> (t, 2) mu (MPa) and alpha
        # Elements, pressure (MPa) against their normals, and its amplitude
        self.pressures: list[tuple[IntArray, float, str]] = []
        self.period = 0.0  # s, of the step
        self._labels: dict[str, dict[int, int]] = {"NSET": {}, "ELSET": {}}
        self._surfaces: dict[str, list[tuple[IntArray, float]]] = defaultdict(list)
        self._amplitudes: dict[str, tuple[FloatArray, FloatArray]] = {}
        self._axes: dict[int, set[int]] = defaultdict(set)
        self._material = self._instance = ""
        for block in _blocks(read_bytes(path).decode("utf-8-sig", "replace")):
            at = f"line {block.at}, *{one_line(block.keyword, 40)}"
            try:
                self._read(block)
            except KeyError as fault:
                raise InputError(f"{at}: {one_line(fault, 60)} does not exist") from fault
            except MvestError as fault:
                raise InputError(f"{at}: {fault}") from fault
        if not self.nodes or not self.cells or not self.period:
            raise InputError("holds no nodes, no elements or no step with a duration")

    @property
    def section(self) -> IntArray:
        """Section number ``(m,)`` of each element; -1 without one."""
        result = np.full(len(self.cells), -1)
        for k, (members, _, _) in enumerate(self.sections):
            result[members] = k
        return result

    @property
    def trusses(self) -> IntArray:
        """Numbers of the trusses; all other elements are shells."""
        return np.flatnonzero([len(cell) == 2 for cell in self.cells])

    @property
    def held(self) -> IntArray:
        """Nodes whose three coordinates are all prescribed."""
        held = [node for node, axes in self._axes.items() if {1, 2, 3} <= axes]
        return np.array(sorted(held), dtype=np.int64)

    def members(self, kind: str, name: str) -> IntArray:
        """Members of a set (NSET or ELSET), as numbers. InputError if there is no such set."""
        what = {"NSET": "node set", "ELSET": "element set"}[kind]
        members: IntArray = self._known(self.sets[kind], name, what)
        return members

    def share(self, amplitude: str, times: FloatArray) -> FloatArray:
        """Fraction of the pressure at times ``(k,)`` s, constant outside the amplitude's points.

        Between two points it is Abaqus' smooth step ``10 u^3 - 15 u^4 + 6 u^5``.

        InputError if there is no such amplitude.
        """
        at, values = self._known(self._amplitudes, amplitude, "amplitude")
        i = np.clip(np.searchsorted(at, times, side="right") - 1, 0, len(at) - 2)
        u = np.clip((times - at[i]) / (at[i + 1] - at[i]), 0.0, 1.0)
        rise = u**3 * (10 - 15 * u + 6 * u**2)
        return np.asarray(values[i] + rise * (values[i + 1] - values[i]))

    @staticmethod
    def _known(found: dict[str, Any], name: str, what: str) -> Any:
        if _plain(name) not in found:
            listed = one_line(", ".join(found), 160) or "none"
            raise InputError(f"no {what} {one_line(name, 60)!r}; there are {listed}")
        return found[_plain(name)]

    def _read(self, block: _Block) -> None:
        key = block.keyword
        if key in _REFUSED or {"INPUT", "GENERATE"} & set(block.options):
            raise InputError("is not read; expected a deck that writes out all it has")
        match key:
            case "INSTANCE":
                if self._instance or block.rows:
                    raise InputError("expected one instance, where its part is")
                self._instance = block.option("NAME")
            case "NODE":
                points = self._labelled("NSET", block, 4, len(self.nodes))
                self.nodes.extend(points.tolist())
            case "ELEMENT":
                kind, known = block.option("TYPE"), self._labels["NSET"]
                if kind not in CORNERS:
                    raise InputError(f"type {one_line(kind, 20)}, expected {', '.join(CORNERS)}")
                nodes = self._labelled("ELSET", block, 1 + CORNERS[kind], len(self.cells))
                nodes = nodes if kind != "S3" else nodes[:, [0, 1, 2, 2]]
                self.cells.extend([known[label] for label in row] for row in nodes.tolist())
            case "NSET" | "ELSET":
                self._add_set(key, block.option(key), self._numbers_of(key, block.words))
            case "SHELL SECTION" | "SOLID SECTION":
                size = float(_numbers([*(row[0] for row in block.rows if row[0]), "0"])[0])
                if size < 0:
                    raise InputError(f"thickness or cross section {size:g}, expected > 0")
                members = self._numbers_of("ELSET", [block.option("ELSET")])
                self.sections.append((members, block.option("MATERIAL"), size))
            case "SURFACE" if block.option("TYPE", "ELEMENT") == "ELEMENT":
                for word, *face in block.rows:
                    side = {"SPOS": 1.0, "SNEG": -1.0}["".join(face[:1]).upper()]
                    own = self._numbers_of("ELSET", [word]), side
                    self._surfaces[block.option("NAME")].append(own)
            case "MATERIAL":
                self._material = block.option("NAME")
            case "HYPERELASTIC" if "OGDEN" in block.options:
                count, values = 2 * int(block.option("N", "1")), _numbers(block.words)
                if len(values) < count:
                    raise InputError(f"N = {count // 2}, expected so many pairs mu, alpha")
                self.ogden[self._material] = values[:count].reshape(-1, 2)
            case "AMPLITUDE":
                kind, values = block.option("DEFINITION", "TABULAR"), _numbers(block.words)
                if kind != "SMOOTH STEP":
                    raise InputError(f"{one_line(kind, 40)}, expected SMOOTH STEP")
                if len(values) < 4 or len(values) % 2 or np.any(np.diff(values[::2]) <= 0):
                    raise InputError("expected two or more times, increasing, each with a value")
                self._amplitudes[block.option("NAME")] = values[::2], values[1::2]
            case "DYNAMIC":
                if self.period:
                    raise InputError("a second step, expected one")
                words = [*next(iter(block.rows), []), "", ""]
                self.period = float(_numbers([words[1] or "0"])[0])
                if not self.period > 0:
                    raise InputError("no duration of the step, expected > 0 s")
            case "BOUNDARY":
                for word, *rest in block.rows:
                    first, last = [*_numbers(rest[:2]).tolist(), 0.0, 0.0][:2]
                    if not 1 <= first <= last <= 6:
                        shown = one_line(",".join([word, *rest]), 60)
                        raise InputError(f"{shown}, expected degrees of freedom")
                    for node in self._numbers_of("NSET", [word]).tolist():
                        self._axes[node] |= set(range(int(first), int(last) + 1))
            case "DSLOAD":
                for row in block.rows:
                    if len(row) != 3 or row[1].upper() != "P":
                        raise InputError(f"{one_line(','.join(row), 40)}, expected pressure P")
                    if _plain(row[0]) not in self._surfaces:
                        raise KeyError(row[0])
                    value, amplitude = float(_numbers(row[2:])[0]), block.option("AMPLITUDE", "")
                    for members, side in self._surfaces[_plain(row[0])]:
                        self.pressures.append((members, side * value, amplitude))

    def _labelled(self, kind: str, block: _Block, width: int, first: int) -> FloatArray:
        """Store labels and set of new nodes or elements; return their values ``(n, width - 1)``."""
        for row in block.rows:
            if len(row) != width:
                raise InputError(f"{len(row)} numbers in a line, expected {width}")
        values, known = _numbers(block.words).reshape(-1, width), self._labels[kind]
        for number, label in enumerate(values[:, 0].tolist(), first):
            if label != int(label) or known.setdefault(int(label), number) != number:
                raise InputError(f"label {label:g} is no whole number, or occurs twice")
        if kind in block.options:
            self._add_set(kind, block.option(kind), first + np.arange(len(values)))
        return values[:, 1:]

    def _add_set(self, kind: str, name: str, members: IntArray) -> None:
        self.sets[kind][name] = np.union1d(self.sets[kind].get(name, members), members)

    def _numbers_of(self, kind: str, words: Iterable[str]) -> IntArray:
        """Increasing numbers of the members that labels and set names refer to."""
        found = set[int]()
        for word in map(_plain, words):
            if word.isdecimal():
                found.add(self._labels[kind][int(word)])
            else:
                found.update(self.sets[kind][word].tolist())
        return np.array(sorted(found), dtype=np.int64)


def _blocks(text: str) -> list[_Block]:
    blocks: list[_Block] = []
    for at, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        if line.startswith("*") and not line.startswith("**"):
            keyword, *rest = line[1:].split(",")
            pairs = (word.partition("=") for word in rest)
            options = {_plain(name): value for name, _, value in pairs}
            blocks.append(_Block(_plain(keyword), options, at))
        elif line and not line.startswith("**"):
            if not blocks:
                raise InputError(f"line {at}: {one_line(line, 40)!r}, expected a keyword first")
            blocks[-1].rows.append([word.strip() for word in line.removesuffix(",").split(",")])
    return blocks


def _plain(name: str) -> str:
    """A name in capitals, with single spaces and without its instance prefix."""
    return " ".join(name.split()).upper().rpartition(".")[2]


def _numbers(words: Iterable[str]) -> FloatArray:
    try:
        values = np.array(list(words), dtype=np.float64)
    except ValueError as fault:
        raise InputError(one_line(fault, 80)) from fault
    if not np.all(np.abs(values) <= MAX_NUMBER):
        raise InputError(f"numbers that are not finite, or above {MAX_NUMBER:g}")
    return values
