"""Reading an Abaqus input deck (``.inp``), all instances in one mesh.

Read is what a recorded closure needs: parts, instances (moved and turned) and the assembly, or a
deck without them; nodes, shells and trusses; sets of both, also generated ones; sections, elastic
and hyperelastic materials, amplitudes, and one step with its duration, prescribed motion and
pressure. What makes nodes or elements otherwise (``*NGEN``, ``*ELCOPY``, ...) or lies in other
files is refused; what only concerns the other program (contact, orientations, mass scaling,
output) is passed over. Format: *Abaqus Keywords Reference Guide*.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.exchange.abaqus.deck import (
    SHELLS,
    TRUSSES,
    Amplitude,
    Block,
    Deck,
    Elements,
    ElementSection,
    FaceLoad,
    blocks_of,
    lookup,
)
from mvest.reading.bounded import refusing
from mvest.reading.text import one_line, read_text
from mvest.typing import FloatArray, IntArray

CORNERS = SHELLS | TRUSSES
"""Nodes of the elements that are read."""
MAX_BLOCKS = 20_000
"""Keywords of a deck; one that prescribes each node by itself has hundreds."""
MAX_MEMBERS = 10_000_000
"""Of all sets together, as often as they are named."""
_REFUSED = {
    *("INCLUDE", "NGEN", "NCOPY", "NFILL", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "TRANSFORM"),
    *("SUBMODEL", "IMPORT", "RESTART", "MAP SOLUTION"),
}
_MATERIAL = {"ELASTIC", "HYPERELASTIC"}
_HELD = {"PINNED", "ENCASTRE"}


def read_deck(path: Path) -> Deck:
    """Read an Abaqus input deck (``.inp``).

    Raises
    ------
    InputError
        If it is damaged, or states what is not read; the message names the line.
    """
    with refusing(path, "Abaqus input deck"):
        return _Reading().read(read_text(path))


class _Reading:
    """What has been read of a deck so far; the blocks of a part are read once for each instance."""

    def __init__(self) -> None:
        self.parts: dict[str, list[Block]] = {}
        self.open_part: list[Block] | None = None
        self.instance = ""
        self.nodes: list[FloatArray] = []
        self.elements: list[Elements] = []
        self.labels: dict[str, dict[str, list[tuple[IntArray, int]]]] = {"NSET": {}, "ELSET": {}}
        self.sorted: dict[tuple[str, str], tuple[IntArray, IntArray]] = {}
        self.sets: dict[str, dict[str, IntArray]] = {"NSET": {}, "ELSET": {}}
        self.sections: list[ElementSection] = []
        self.surfaces: dict[str, list[tuple[IntArray, str]]] = {}
        self.materials: dict[str, dict[str, Block]] = {}
        self.material: dict[str, Block] | None = None
        self.amplitudes: dict[str, Amplitude] = {}
        self.boundary: list[tuple[Block, bool]] = []
        self.loads: list[Block] = []
        self.in_step = False
        self.period: float | None = None
        self.members = 0

    def read(self, text: str) -> Deck:
        for count, block in enumerate(blocks_of(text)):
            if count == MAX_BLOCKS:
                raise InputError(f"{block}: expected at most {MAX_BLOCKS} keywords")
            if self.open_part is not None and block.keyword != "END PART":
                self.open_part.append(block)
            else:
                self._take(block)
        if not self.nodes or not self.elements:
            raise InputError("holds no nodes or no elements outside parts; expected an instance")
        if self.period is None:
            raise InputError("holds no step with a duration")
        nodes = np.concatenate(self.nodes)
        displacement, paced_by, names = self._prescribed(len(nodes))
        return Deck(
            nodes,
            tuple(self.elements),
            self.sets["NSET"],
            self.sets["ELSET"],
            tuple(self.sections),
            self.materials,
            self.amplitudes,
            displacement,
            paced_by,
            names,
            tuple(load for block in self.loads for load in self._pressures(block)),
            self.period,
        )

    def _take(self, block: Block) -> None:
        key = block.keyword
        if key in _REFUSED or "INPUT" in block.options:
            raise InputError(f"{block}: is not read; expected a deck that writes out all it has")
        if key in _MATERIAL and self.material is not None:
            self.material[key] = block
        elif key in _TAKEN:
            self.material = None
            _TAKEN[key](self, block)

    def _start_part(self, block: Block) -> None:
        self.open_part = self.parts.setdefault(block.option("NAME"), [])

    def _end_part(self, _block: Block) -> None:
        self.open_part = None

    def _start_instance(self, block: Block) -> None:
        part = block.option("PART")
        if part not in self.parts:
            raise InputError(f"{block}: no part {one_line(part, 40)!r}")
        self.instance = block.option("NAME")
        first = len(self.nodes)
        for inner in self.parts[part]:
            self._take(inner)
        self.nodes[first:] = [_placed(block, points) for points in self.nodes[first:]]

    def _end_instance(self, _block: Block) -> None:
        self.instance = ""

    def _add_nodes(self, block: Block) -> None:
        if block.options.get("SYSTEM", "R").upper() != "R":
            raise InputError(f"{block}: SYSTEM={block.options['SYSTEM']}, expected R")
        table = block.table(4)
        self._add("NSET", block, table[:, 0], sum(map(len, self.nodes)))
        self.nodes.append(table[:, 1:])

    def _add_elements(self, block: Block) -> None:
        kind = block.option("TYPE")
        if kind not in CORNERS:
            raise InputError(f"{block}: type {one_line(kind, 20)}, expected {', '.join(CORNERS)}")
        table = block.table(1 + CORNERS[kind])
        first = sum(len(known.nodes) for known in self.elements)
        self._add("ELSET", block, table[:, 0], first)
        nodes = self._numbers("NSET", block, table[:, 1:].ravel(), self.instance)
        self.elements.append(Elements(kind, first, nodes.reshape(-1, CORNERS[kind])))

    def _add(self, kind: str, block: Block, labels: FloatArray, first: int) -> None:
        """Labels of new nodes or elements, and the set that their block makes of them."""
        known = self.labels[kind].setdefault(self.instance, [])
        known.append((_whole(block, labels), first))
        self.sorted.pop((kind, self.instance), None)
        if kind in block.options:
            self._add_set(kind, block, first + np.arange(len(labels)))

    def _add_set(self, kind: str, block: Block, members: IntArray) -> None:
        name = ".".join(filter(None, [self.instance, block.option(kind)]))
        known = self.sets[kind].get(name, members)
        self.sets[kind][name] = self._counted(block, np.union1d(known, members))

    def _counted(self, block: Block, members: IntArray) -> IntArray:
        self.members += len(members)
        if self.members > MAX_MEMBERS:
            raise InputError(f"{block}: sets of more than {MAX_MEMBERS} members together")
        return members

    def _add_given_set(self, block: Block) -> None:
        kind = block.keyword
        instance = block.options.get("INSTANCE", self.instance).upper()
        if "GENERATE" in block.options:
            rows = [self._generated(kind, block, row, instance) for row in block.rows]
        else:
            labels = [word for word in block.words if word.isdigit()]
            rows = [self._numbers(kind, block, block.checked(labels), instance)]
            rows += [self._named(kind, block, w, instance) for w in block.words if not w.isdigit()]
        self._add_set(kind, block, np.unique(np.concatenate([np.zeros(0, np.int64), *rows])))

    def _generated(self, kind: str, block: Block, row: Sequence[str], instance: str) -> IntArray:
        """Members from one label to another in steps."""
        first, last, step = [*_whole(block, block.checked(row)).tolist(), 1, 1, 1][:3]
        labels, numbers = self._known(kind, instance)
        if len(row) not in (2, 3) or step < 1 or last < first:
            raise InputError(f"{block}: {', '.join(row)}, expected first, last and a step")
        inside = (labels >= first) & (labels <= last) & ((labels - first) % step == 0)
        if np.count_nonzero(inside) != (last - first) // step + 1:
            raise InputError(f"{block}: {', '.join(row)} names labels that do not exist")
        return self._counted(block, numbers[inside])

    def _known(self, kind: str, instance: str) -> tuple[IntArray, IntArray]:
        """Labels of an instance in increasing order, and their numbers."""
        if (kind, instance) not in self.sorted:
            parts = self.labels[kind].get(instance, [])
            empty = np.zeros(0, np.int64)
            labels = np.concatenate([empty, *(part for part, _ in parts)])
            numbers = np.concatenate([empty, *(at + np.arange(len(part)) for part, at in parts)])
            order = np.argsort(labels, kind="stable")
            twice = np.flatnonzero(np.diff(labels[order]) == 0)
            if twice.size:
                label = labels[order][twice[0]]
                raise InputError(f"label {label} of {_WHAT[kind]}s occurs twice")
            self.sorted[kind, instance] = labels[order], numbers[order]
        return self.sorted[kind, instance]

    def _numbers(self, kind: str, block: Block, labels: FloatArray, instance: str) -> IntArray:
        """Numbers of labels of an instance."""
        wanted = _whole(block, labels)
        known, numbers = self._known(kind, instance)
        if not wanted.size:
            return wanted
        at = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        if not known.size or np.any(known[at] != wanted):
            wrong = int(wanted[known[at] != wanted][0]) if known.size else int(wanted[0])
            raise InputError(f"{block}: no {_WHAT[kind]} {wrong}")
        return self._counted(block, numbers[at])

    def _named(self, kind: str, block: Block, word: str, instance: str) -> IntArray:
        """Numbers of a label or a set, both with or without its instance."""
        within, _, last = word.upper().rpartition(".")
        if last.isdigit():
            label = block.checked([last])
            return self._numbers(kind, block, label, within or instance)
        whole = f"{within or instance}.{last}".removeprefix(".")
        sets = self.sets[kind]
        name = whole if whole in sets else word
        return self._counted(block, lookup(sets, name, f"{block}: {_WHAT[kind]} set"))

    def _add_section(self, block: Block) -> None:
        shell = block.keyword == "SHELL SECTION"
        first = next((row[0] for row in block.rows if row[0]), None)
        size = None if first is None else float(block.checked([first])[0])
        if size is not None and not size > 0:
            what = "thickness" if shell else "cross section"
            raise InputError(f"{block}: {what} {size:g}, expected > 0")
        members = self._named("ELSET", block, block.option("ELSET"), self.instance)
        self.sections.append(ElementSection(members, block.option("MATERIAL"), size))

    def _add_surface(self, block: Block) -> None:
        if block.options.get("TYPE", "ELEMENT").upper() != "ELEMENT":
            return
        faces = self.surfaces.setdefault(block.option("NAME"), [])
        for word, *rest in block.rows:
            members = self._named("ELSET", block, word, self.instance)
            faces.append((members, rest[0].upper() if rest else ""))

    def _start_material(self, block: Block) -> None:
        self.material = self.materials.setdefault(block.option("NAME"), {})

    def _add_amplitude(self, block: Block) -> None:
        kind = " ".join(block.options.get("DEFINITION", "TABULAR").upper().split())
        values = block.checked(block.words)
        times = values[::2]
        if kind not in ("TABULAR", "SMOOTH STEP"):
            raise InputError(f"{block}: {one_line(kind, 40)}, expected TABULAR or SMOOTH STEP")
        if len(values) % 2 or len(times) < 2 or np.any(np.diff(times) <= 0):
            raise InputError(f"{block}: expected two or more times, increasing, each with a value")
        smooth = kind == "SMOOTH STEP"
        self.amplitudes[block.option("NAME")] = Amplitude(times, values[1::2], smooth)

    def _start_step(self, block: Block) -> None:
        if self.in_step:
            raise InputError(f"{block}: a second step, expected one")
        self.in_step = True

    def _set_period(self, block: Block) -> None:
        row = next(iter(block.rows), [])
        period = float(block.checked([row[1]])[0]) if len(row) > 1 and row[1] else 0.0
        if not period > 0:
            raise InputError(f"{block}: no duration of the step, expected > 0 s")
        self.period = period

    def _add_boundary(self, block: Block) -> None:
        if block.options.get("TYPE", "DISPLACEMENT").upper() != "DISPLACEMENT":
            raise InputError(f"{block}: TYPE={block.options['TYPE']}, expected DISPLACEMENT")
        if self.in_step and block.options.get("OP", "MOD").upper() == "NEW":
            self.boundary = [entry for entry in self.boundary if entry[1]]
        self.boundary.append((block, self.in_step))

    def _prescribed(self, count: int) -> tuple[FloatArray, IntArray, tuple[str, ...]]:
        """Displacement at a share of 1 and number of the amplitude, ``(n, 3)``; their names."""
        displacement = np.full((count, 3), np.nan)
        paced_by, names = np.zeros((count, 3), np.int64), list[str]()
        for block, _ in self.boundary:
            amplitude = block.options.get("AMPLITUDE", "").upper()
            names += [amplitude] if amplitude not in names else []
            for row in block.rows:
                nodes = self._named("NSET", block, row[0], "")
                first, last, value = _freedoms(block, row)
                displacement[nodes, first:last] = value
                paced_by[nodes, first:last] = names.index(amplitude)
        return displacement, paced_by, tuple(names)

    def _pressures(self, block: Block) -> list[FaceLoad]:
        """Loads on surfaces push into their face, those on elements along their normals."""
        found = []
        amplitude = block.options.get("AMPLITUDE", "").upper()
        for row in block.rows:
            if len(row) != 3 or row[1].upper() != "P":
                raise InputError(f"{block}: {one_line(','.join(row), 40)}, expected pressure P")
            value = float(block.checked([row[2]])[0])
            if block.keyword == "DLOAD":
                found.append(FaceLoad(self._named("ELSET", block, row[0], ""), -value, amplitude))
                continue
            for members, face in lookup(self.surfaces, row[0], f"{block}: surface"):
                if face not in ("SPOS", "SNEG"):
                    raise InputError(f"{block}: face {one_line(face, 20)!r}, expected SPOS or SNEG")
                sign = 1.0 if face == "SPOS" else -1.0
                found.append(FaceLoad(members, sign * value, amplitude))
        return found


_WHAT = {"NSET": "node", "ELSET": "element"}

_TAKEN: dict[str, Callable[[_Reading, Block], None]] = {
    "PART": _Reading._start_part,
    "END PART": _Reading._end_part,
    "INSTANCE": _Reading._start_instance,
    "END INSTANCE": _Reading._end_instance,
    "NODE": _Reading._add_nodes,
    "ELEMENT": _Reading._add_elements,
    "NSET": _Reading._add_given_set,
    "ELSET": _Reading._add_given_set,
    "SHELL SECTION": _Reading._add_section,
    "SOLID SECTION": _Reading._add_section,
    "SURFACE": _Reading._add_surface,
    "MATERIAL": _Reading._start_material,
    "AMPLITUDE": _Reading._add_amplitude,
    "STEP": _Reading._start_step,
    "DYNAMIC": _Reading._set_period,
    "STATIC": _Reading._set_period,
    "BOUNDARY": _Reading._add_boundary,
    "DLOAD": lambda reading, block: reading.loads.append(block),
    "DSLOAD": lambda reading, block: reading.loads.append(block),
}
"""What is read of a deck."""


def _whole(block: Block, values: FloatArray) -> IntArray:
    if np.any(values != np.rint(values)) or np.any(values < 0):
        raise InputError(f"{block}: labels that are no whole numbers")
    return values.astype(np.int64)


def _placed(block: Block, points: FloatArray) -> FloatArray:
    """Points of a part where its instance is: moved, then turned about an axis."""
    rows = [block.checked(row) for row in block.rows]
    if [len(row) for row in rows] not in ([], [3], [3, 7]):
        raise InputError(f"{block}: expected a line of 3 numbers and one of 7, or none")
    if rows:
        points = points + rows[0]
    if len(rows) == 2:
        start, end, angle = rows[1][:3], rows[1][3:6], np.deg2rad(rows[1][6])
        length = np.linalg.norm(end - start)
        if not length > 0:
            raise InputError(f"{block}: an axis without a length")
        points = start + Rotation.from_rotvec(angle * (end - start) / length).apply(points - start)
    return points


def _freedoms(block: Block, row: Sequence[str]) -> tuple[int, int, float]:
    """First and past-last coordinate that a line prescribes, of 0 to 2, and its value."""
    if len(row) > 1 and row[1].upper() in _HELD:
        return 0, 3, 0.0
    values = block.checked([word or "0" for word in row[1:]])
    first, last, value = (*values.tolist(), *([0.0] * 3))[:3]
    last = last or first
    if not (1 <= first <= last <= 6 and len(row) <= 4):
        raise InputError(f"{block}: {one_line(','.join(row), 60)}, expected degrees of freedom")
    return int(first) - 1, min(int(last), 3), value
