"""Reading an Abaqus input deck (``.inp``), all instances in one mesh.

Read is what a recorded closure needs: parts, instances (moved and turned) and the assembly, or a
deck without them; nodes, shells and trusses; sets of both, also generated ones; sections, elastic
and hyperelastic materials, amplitudes, and one step with its duration, prescribed motion and
pressure. What makes nodes or elements otherwise (``*NGEN``, ``*ELCOPY``, ...) or lies in other
files (``*INCLUDE``, ``INPUT=``) is refused. All other keywords are passed over.

Format: *Abaqus Keywords Reference Guide*, and *Analysis User's Guide*, "Input syntax rules": a
keyword line begins with one star, a comment with two; words are separated by commas, options are
``NAME=VALUE``; case does not matter; a keyword line that ends with a comma goes on.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.errors import InputError, MvestError
from mvest.reading.text import MAX_NUMBER, one_line
from mvest.typing import FloatArray, IntArray

T = TypeVar("T")

CORNERS = dict.fromkeys(("S4", "S4R", "S4RS", "S4RSW"), 4)
CORNERS |= dict.fromkeys(("S3", "S3R", "S3RS"), 3) | dict.fromkeys(("T3D2", "CONN3D2"), 2)
"""Nodes of the elements that are read: shells, and trusses with two."""
_REFUSED = {
    *("INCLUDE", "NGEN", "NCOPY", "NFILL", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "TRANSFORM"),
    *("SUBMODEL", "IMPORT", "RESTART", "MAP SOLUTION"),
}
_WHAT = {"NSET": "node", "ELSET": "element"}
_WORD = re.compile(r'(?:[^,"]|"[^"]*")+')


@dataclass(slots=True)
class _Block:
    """A keyword (in capitals) at a line, its options, and the words of its data lines."""

    keyword: str
    options: dict[str, str]
    at: int
    rows: list[list[str]] = field(default_factory=list)

    def __str__(self) -> str:
        return f"line {self.at}, *{one_line(self.keyword, 40)}"

    def option(self, name: str, default: str | None = None) -> str:
        """An option in capitals."""
        value = self.options.get(name) or default
        if value is None:
            raise InputError(f"no {name}=")
        return value.upper()

    def table(self, width: int) -> tuple[IntArray, FloatArray]:
        """Labels ``(n,)`` and numbers ``(n, width - 1)`` of data lines of so many words each."""
        for row in self.rows:
            if len(row) != width:
                raise InputError(f"{len(row)} numbers in a line, expected {width}")
        values = _numbers(word for row in self.rows for word in row).reshape(-1, width)
        return _whole(values[:, 0]), values[:, 1:]

    @property
    def words(self) -> list[str]:
        """Words of all data lines, without empty ones."""
        return [word for row in self.rows for word in row if word]


class Deck:
    """What a deck states; nodes and elements of all instances count from 0 in its order.

    Attributes
    ----------
    nodes : list of list
        ``(n, 3)``.
    cells : list of list
        Nodes of each element: 3 or 4 of a shell, 2 of a truss.
    sets : dict
        NSET or ELSET -> ``INSTANCE.SET`` or ``SET``, in capitals -> numbers, increasing.
    sections : list of tuple
        Elements, material, and thickness of shells (mm) or cross section of trusses (mm^2), NaN
        where none is given. Of two sections of an element the later one counts.
    laws : dict
        Material -> ELASTIC or HYPERELASTIC -> its ``options`` and ``values``.
    pressures : list of tuple
        Elements, pressure against their normals at a share of 1, and its amplitude.
    period : float
        s, of the step.

    Raises
    ------
    InputError
        If the file is damaged, or states what is not read; the message names the line.
    """

    def __init__(self, path: Path) -> None:
        self.nodes: list[list[float]] = []
        self.cells: list[list[int]] = []
        self.sets: dict[str, dict[str, IntArray]] = {"NSET": {}, "ELSET": {}}
        self.sections: list[tuple[IntArray, str, float]] = []
        self.laws: dict[str, dict[str, Any]] = {}
        self.pressures: list[tuple[IntArray, float, str]] = []
        self.period = 0.0
        self._parts: dict[str, list[_Block]] = {}
        self._part: list[_Block] | None = None
        self._instance = ""
        self._labels: dict[tuple[str, str], dict[int, int]] = defaultdict(dict)
        self._surfaces: dict[str, list[tuple[IntArray, str]]] = defaultdict(list)
        self._law: dict[str, Any] = {}
        self._amplitudes: dict[str, tuple[FloatArray, FloatArray, bool]] = {}
        self._moved: list[tuple[bool, IntArray, slice, float, str]] = []
        self._in_step = False
        content = path.read_bytes()
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
        for block in _blocks(text):
            self._take(block)
        if not self.nodes or not self.cells:
            raise InputError("holds no nodes or no elements outside parts; expected an instance")
        if not self.period:
            raise InputError("holds no step with a duration")

    @property
    def section(self) -> IntArray:
        """Number ``(m,)`` of the section of each element; -1 where there is none."""
        result = np.full(len(self.cells), -1)
        for k, (members, _, _) in enumerate(self.sections):
            result[members] = k
        return result

    @property
    def trusses(self) -> IntArray:
        """Numbers of the trusses; all other elements are shells."""
        return np.flatnonzero([len(cell) == 2 for cell in self.cells])

    def share(self, amplitude: str, times: FloatArray) -> FloatArray:
        """Share of a prescribed quantity at times ``(k,)`` s, constant before and after.

        Between two points it runs straight, or as Abaqus' smooth step
        ``10 u^3 - 15 u^4 + 6 u^5``.

        Raises
        ------
        InputError
            If there is no such amplitude.
        """
        if amplitude not in self._amplitudes:
            name = f"amplitude {amplitude!r}" if amplitude else "a quantity without an amplitude"
            raise InputError(f"{one_line(name, 60)}, expected one of {some(self._amplitudes)}")
        at, values, smooth = self._amplitudes[amplitude]
        if not smooth:
            return np.interp(times, at, values)
        i = np.clip(np.searchsorted(at, times, side="right") - 1, 0, len(at) - 2)
        u = np.clip((times - at[i]) / (at[i + 1] - at[i]), 0.0, 1.0)
        rise = u**3 * (10 - 15 * u + 6 * u**2)
        return np.asarray(values[i] + rise * (values[i + 1] - values[i]))

    def held(self) -> IntArray:
        """Nodes all of whose coordinates are prescribed."""
        fixed = np.zeros((len(self.nodes), 3), dtype=bool)
        for _, members, axes, _, _ in self._moved:
            fixed[members, axes] = True
        return np.flatnonzero(fixed.all(axis=1))

    def moved(self, nodes: IntArray, times: FloatArray) -> FloatArray:
        """Displacement ``(k, n, 3)`` of constrained nodes at times ``(k,)`` s.

        Raises
        ------
        InputError
            If a node is free, or moves without an amplitude.
        """
        free = np.setdiff1d(nodes, self.held())
        if free.size:
            raise InputError(f"node {free[0] + 1} of the mesh is free, expected it prescribed")
        result = np.zeros((len(times), len(nodes), 3))
        for _, members, axes, value, amplitude in self._moved:
            own = np.isin(nodes, members)
            if own.any():
                share = self.share(amplitude, times) if value else np.zeros(len(times))
                result[:, own, axes] = value * share[:, None, None]
        return result

    def _take(self, block: _Block) -> None:
        """Read a block; those of a part are read for each of its instances."""
        try:
            if self._part is not None and block.keyword != "END PART":
                self._part.append(block)
            else:
                self._read(block)
        except KeyError as fault:
            raise InputError(f"{block}: {one_line(fault, 60)} does not exist") from fault
        except MvestError as fault:
            raise InputError(f"{block}: {fault}") from fault

    def _read(self, block: _Block) -> None:
        key = block.keyword
        if key in _REFUSED or "INPUT" in block.options:
            raise InputError("is not read; expected a deck that writes out all it has")
        match key:
            case "PART":
                self._part = self._parts.setdefault(block.option("NAME"), [])
            case "END PART":
                self._part = None
            case "INSTANCE":
                self._place(block)
            case "END INSTANCE":
                self._instance = ""
            case "NODE":
                labels, points = block.table(4)
                self._label("NSET", block, labels, len(self.nodes))
                self.nodes.extend(points.tolist())
            case "ELEMENT":
                self._add_elements(block)
            case "NSET" | "ELSET":
                words = _generated(block) if "GENERATE" in block.options else block.words
                members = self._members(key, words, block.option("INSTANCE", self._instance))
                self._add_set(key, block.option(key), members)
            case "SHELL SECTION" | "SOLID SECTION":
                size = float(_numbers([*(row[0] for row in block.rows if row[0]), "0"])[0])
                if size < 0:
                    raise InputError(f"thickness or cross section {size:g}, expected > 0")
                members = self._members("ELSET", [block.option("ELSET")])
                self.sections.append((members, block.option("MATERIAL"), size or np.nan))
            case "SURFACE" if block.option("TYPE", "ELEMENT") == "ELEMENT":
                for word, *face in block.rows:
                    own = self._members("ELSET", [word]), "".join(face[:1]).upper()
                    self._surfaces[block.option("NAME")].append(own)
            case "MATERIAL":
                self._law = self.laws.setdefault(block.option("NAME"), {})
            case "ELASTIC" | "HYPERELASTIC":
                values = _numbers(block.words)
                self._law[key] = {"options": block.options, "values": values}
            case "AMPLITUDE":
                self._add_amplitude(block)
            case "STEP":
                if self._in_step:
                    raise InputError("a second step, expected one")
                self._in_step = True
            case "DYNAMIC" | "STATIC":
                words = [*next(iter(block.rows), []), "", ""]
                self.period = float(_numbers([words[1] or "0"])[0])
                if not self.period > 0:
                    raise InputError("no duration of the step, expected > 0 s")
            case "BOUNDARY":
                self._add_boundary(block)
            case "DLOAD" | "DSLOAD":
                self._add_pressure(block)

    def _place(self, block: _Block) -> None:
        """Read a part where its instance is: moved, then turned about an axis."""
        part, rows = self._parts[block.option("PART")], [_numbers(row) for row in block.rows]
        if [len(row) for row in rows] not in ([], [3], [3, 7]):
            raise InputError("expected a line of 3 numbers and one of 7, or none")
        self._instance, first = block.option("NAME"), len(self.nodes)
        for inner in part:
            self._take(inner)
        if rows and len(self.nodes) > first:
            points = np.array(self.nodes[first:]) + rows[0]
            for row in rows[1:]:
                start, axis, angle = row[:3], row[3:6] - row[:3], np.deg2rad(row[6])
                length = np.linalg.norm(axis)
                if not length > 0:
                    raise InputError("an axis without a length")
                points = start + Rotation.from_rotvec(angle * axis / length).apply(points - start)
            self.nodes[first:] = points.tolist()

    def _add_elements(self, block: _Block) -> None:
        kind = block.option("TYPE")
        if kind not in CORNERS:
            raise InputError(f"type {one_line(kind, 20)}, expected {', '.join(CORNERS)}")
        labels, nodes = block.table(1 + CORNERS[kind])
        self._label("ELSET", block, labels, len(self.cells))
        known = self._labels["NSET", self._instance]
        self.cells.extend([known[label] for label in row] for row in nodes.tolist())

    def _label(self, kind: str, block: _Block, labels: IntArray, first: int) -> None:
        """Labels of new nodes or elements, and the set that their block makes of them."""
        known = self._labels[kind, self._instance]
        for number, label in enumerate(labels.tolist(), first):
            if known.setdefault(label, number) != number:
                raise InputError(f"label {label} of {_WHAT[kind]}s occurs twice")
        if kind in block.options:
            self._add_set(kind, block.option(kind), first + np.arange(len(labels)))

    def _add_set(self, kind: str, name: str, members: IntArray) -> None:
        whole = f"{self._instance}.{name}".removeprefix(".")
        self.sets[kind][whole] = np.union1d(self.sets[kind].get(whole, members), members)

    def _members(self, kind: str, words: Iterable[str], instance: str | None = None) -> IntArray:
        """Numbers of labels and sets, each with or without its instance, increasing."""
        found, sets = set[int](), self.sets[kind]
        for word in words:
            within, _, last = word.upper().rpartition(".")
            place = within or (self._instance if instance is None else instance)
            if last.isdecimal():
                found.add(self._labels[kind, place][int(last)])
            else:
                whole = f"{place}.{last}".removeprefix(".")
                name = whole if whole in sets else word
                found.update(lookup(sets, name, f"{_WHAT[kind]} set").tolist())
        return np.array(sorted(found), dtype=np.int64)

    def _add_amplitude(self, block: _Block) -> None:
        kind, words = _name(block.option("DEFINITION", "TABULAR")), _numbers(block.words)
        times, values = words[::2], words[1::2]
        if kind not in ("TABULAR", "SMOOTH STEP"):
            raise InputError(f"{one_line(kind, 40)}, expected TABULAR or SMOOTH STEP")
        if len(times) != len(values) or len(times) < 2 or np.any(np.diff(times) <= 0):
            raise InputError("expected two or more times, increasing, each with a value")
        self._amplitudes[block.option("NAME")] = times, values, kind == "SMOOTH STEP"

    def _add_boundary(self, block: _Block) -> None:
        if block.option("TYPE", "DISPLACEMENT") != "DISPLACEMENT":
            raise InputError(f"TYPE={block.option('TYPE')}, expected DISPLACEMENT")
        if self._in_step and block.option("OP", "MOD") == "NEW":
            self._moved = [entry for entry in self._moved if entry[0]]
        for word, *rest in block.rows:
            held = rest and rest[0].upper() in ("PINNED", "ENCASTRE")
            values = _numbers(["1", "3"] if held else (part or "0" for part in rest)).tolist()
            first, last, value = [*values, 0.0, 0.0, 0.0][:3]
            if not (1 <= first <= (last or first) <= 6 and len(values) <= 3):
                shown = one_line(",".join([word, *rest]), 60)
                raise InputError(f"{shown}, expected degrees of freedom")
            nodes, axes = self._members("NSET", [word]), slice(int(first) - 1, int(last or first))
            amplitude = block.option("AMPLITUDE", "")
            self._moved.append((self._in_step, nodes, axes, value, amplitude))

    def _add_pressure(self, block: _Block) -> None:
        """Loads on surfaces push into their face, those on elements along their normals."""
        for row in block.rows:
            if len(row) != 3 or row[1].upper() != "P":
                raise InputError(f"{one_line(','.join(row), 40)}, expected pressure P")
            if block.keyword == "DSLOAD":
                faces = lookup(self._surfaces, row[0], "surface")
            else:
                faces = [(self._members("ELSET", row[:1]), "SNEG")]
            for members, face in faces:
                if face not in ("SPOS", "SNEG"):
                    raise InputError(f"face {one_line(face, 20)!r}, expected SPOS or SNEG")
                value = float(_numbers(row[2:])[0]) * (1.0 if face == "SPOS" else -1.0)
                self.pressures.append((members, value, block.option("AMPLITUDE", "")))


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


def _blocks(text: str) -> list[_Block]:
    """The blocks of a deck one after another."""
    blocks: list[_Block] = []
    head = ""
    for at, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        if not line or line.startswith("**"):
            continue
        if line.startswith("*") or head.endswith(","):
            goes_on = not line.startswith("*")
            start = blocks.pop().at if goes_on else at
            head = head + line if goes_on else line
            keyword, *rest = _WORD.findall(head[1:]) or [""]
            pairs = (word.partition("=") for word in rest)
            options = {_name(name): value.strip().strip('"') for name, _, value in pairs}
            blocks.append(_Block(_name(keyword), options, start))
        elif not blocks:
            raise InputError(f"line {at}: {one_line(line, 40)!r}, expected a keyword first")
        else:
            blocks[-1].rows.append([word.strip() for word in line.removesuffix(",").split(",")])
    return blocks


def _name(text: str) -> str:
    """A keyword or the name of an option: in capitals, words apart by one space."""
    return " ".join(text.split()).upper()


def _generated(block: _Block) -> Iterable[str]:
    """Labels from a first to a last one in steps, as words."""
    for row in block.rows:
        first, last, step = [*_whole(_numbers(row)).tolist(), 1, 1, 1][:3]
        if len(row) not in (2, 3) or step < 1 or last < first:
            raise InputError(f"{', '.join(row)}, expected first, last and a step")
        yield from map(str, range(first, last + 1, step))


def _numbers(words: Iterable[str]) -> FloatArray:
    """Words as finite numbers; exponents may be written with D."""
    try:
        values = np.array([word.upper().replace("D", "E") for word in words], dtype=np.float64)
    except ValueError as fault:
        raise InputError(one_line(fault, 80)) from fault
    if not np.all(np.abs(values) <= MAX_NUMBER):
        raise InputError(f"numbers that are not finite, or above {MAX_NUMBER:g}")
    return values


def _whole(values: FloatArray) -> IntArray:
    if np.any(values != np.rint(values)) or np.any(values < 0):
        raise InputError("labels that are no whole numbers")
    return values.astype(np.int64)
