"""Polygons from legacy ``.vtk`` files, as text or binary.

meshio 5.3 reads no PolyData from such files, and VTK itself is too large to require. Format: *VTK
File Formats*, "Simple Legacy Formats", versions up to 4.2, and 5.1, whose cells are offsets and
connectivity.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from mvest.errors import GeometryError, InputError
from mvest.exchange.vtk_xml import MAX_SURFACE, SurfaceFile
from mvest.reading.bounded import array_of_words, refusing
from mvest.reading.text import one_line, read_bytes
from mvest.typing import FloatArray, IntArray

_TYPES = {
    **{"char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2"},
    **{"int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8"},
    **{"vtktypeint64": "i8", "vtkidtype": "i8", "vtktypeuint64": "u8"},
    **{"float": "f4", "double": "f8"},
}
_COMPONENTS = {"normals": 3, "vectors": 3, "tensors": 9, "tensors6": 6, "global_ids": 1}
_CELLS = ("vertices", "lines", "polygons", "triangle_strips")
"""In the order in which cell data count them."""
FLAT = 0.02
"""Of the size of a polygon: how far its corners may lie from one plane."""
_MAX_LINE = 4096
"""Bytes of a line that is no list of numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class PolyDataFile:
    """Polygons and lines as they stand in a file.

    Attributes
    ----------
    title : str
        The second line, in which 3D Slicer names the axes (``SPACE=LPS``).
    points : (n, 3)
        In the unit of the file.
    lines : tuple of (k,) arrays
        Points of each.
    triangles : (m, 3)
        Also those of strips, and of polygons that are flat and convex, as a clipped triangle is.
    point_data, cell_data
        Named arrays with a row for each point or triangle.
    """

    title: str
    points: FloatArray
    lines: tuple[IntArray, ...]
    triangles: IntArray
    point_data: dict[str, NDArray[np.generic]]
    cell_data: dict[str, NDArray[np.generic]]


def read_vtk(path: Path) -> SurfaceFile:
    """Read the triangles of a legacy ``.vtk`` file.

    Raises
    ------
    InputError, GeometryError
        As `read_polydata`, or lines.
    """
    with refusing(path, "VTK file"):
        file = read_polydata(path)
        if file.lines:
            raise InputError("holds lines; expected triangles only")
        return SurfaceFile(file.points, file.triangles, file.point_data, file.cell_data)


def read_polydata(path: Path) -> PolyDataFile:
    """Read the points, lines and polygons of a legacy ``.vtk`` file with their data.

    Raises
    ------
    InputError, GeometryError
        Damaged, another data set than POLYDATA, vertices by themselves, arrays of bits, polygons
        that are not flat and convex.
    """
    with refusing(path, "VTK file"):
        return _Parser(read_bytes(path, MAX_SURFACE)).file()


class _Parser:
    """Goes through one file from its first byte to its last."""

    def __init__(self, content: bytes) -> None:
        self.content, self.at = content, 0
        head = self._raw_line()
        if not head.startswith(b"# vtk DataFile Version"):
            raise InputError(f"damaged or no VTK file: begins with {head[:30]!r}")
        self.title = one_line(self._raw_line().decode("utf-8", errors="replace"))
        form = self._words()
        if form not in (["ascii"], ["binary"]):
            raise InputError(f"{' '.join(form)[:30]!r} for ASCII or BINARY")
        self.binary = form == ["binary"]
        self.points: FloatArray = np.zeros((0, 3))
        self.cells: dict[str, list[IntArray]] = {}
        self.data: dict[str, dict[str, NDArray[np.generic]]] = {"point_data": {}, "cell_data": {}}

    def file(self) -> PolyDataFile:
        """Everything."""
        kind = self._words()
        if kind[:1] == ["field"]:
            self._field(kind, None, 0)
            kind = self._words()
        if [word.lower() for word in kind] != ["dataset", "polydata"]:
            raise InputError(f"{' '.join(kind)[:40]!r}, expected DATASET POLYDATA")
        self._sections()
        if self.cells.get("vertices"):
            raise InputError("holds vertices by themselves; expected polygons or lines")
        lines = self.cells.get("lines", [])
        polygons = self.cells.get("polygons", [])
        strips = self.cells.get("triangle_strips", [])
        cells = [*lines, *polygons, *strips]
        for cell in cells:
            if len(cell) and not 0 <= cell.min() <= cell.max() < len(self.points):
                raise GeometryError("cells name points that do not exist")
        parts = [_of_polygon(polygon, self.points) for polygon in polygons]
        parts += [_of_strip(strip) for strip in strips]
        bad = next((k for k, part in enumerate(parts) if part is None), None)
        if bad is not None:
            raise InputError(
                f"polygon {bad} has {len(polygons[bad])} corners and is not flat and convex; "
                "triangulate the surface first"
            )
        rows = np.repeat(
            np.arange(len(lines), len(cells)), [0 if part is None else len(part) for part in parts]
        )
        return PolyDataFile(
            self.title,
            self.points,
            tuple(lines),
            np.array([corner for part in parts if part for corner in part]).reshape(-1, 3),
            self.data["point_data"],
            {name: values[rows] for name, values in self.data["cell_data"].items()},
        )

    def _sections(self) -> None:
        attributes: dict[str, NDArray[np.generic]] | None = None
        rows = 0
        while words := self._words():
            match words:
                case ["points", count, kind]:
                    self.points = (
                        self._numbers(3 * self._count(count), kind)
                        .astype(np.float64)
                        .reshape(-1, 3)
                    )
                case [kind, first, second] if kind in _CELLS:
                    if kind in self.cells:
                        raise InputError(f"{kind} twice")
                    self.cells[kind] = self._cells(self._count(first), self._count(second))
                case [("point_data" | "cell_data") as name, count]:
                    attributes, rows = self.data[name], self._count(count)
                    wanted = (
                        len(self.points)
                        if name == "point_data"
                        else sum(map(len, self.cells.values()))
                    )
                    if rows != wanted:
                        raise InputError(f"{name} of {rows}, expected {wanted}")
                case ["field", _, _]:
                    self._field(words, attributes, rows)
                case ["metadata"]:
                    self._skip_metadata()
                case _ if attributes is not None:
                    self._attribute(words, attributes, rows)
                case _:
                    raise InputError(f"line {' '.join(words)[:60]!r}")

    def _cells(self, first: int, second: int) -> list[IntArray]:
        """Points of each cell; before version 5 each of them is led by its number of points."""
        at = self.at
        following = self._words()
        if following[:1] == ["offsets"]:
            ends = self._whole(first, following)
            flat = self._whole(second, self._words(), "connectivity")
            if first and (ends[0] != 0 or ends[-1] != second or (np.diff(ends) < 0).any()):
                raise InputError("offsets do not fit the corners of the cells")
            return np.split(flat, ends[1:-1]) if first > 1 else []
        self.at = at
        flat = self._numbers(second, "int").astype(np.int64)
        cells: list[IntArray] = []
        start = 0
        for _ in range(first):
            size = int(flat[start]) if start < len(flat) else -1
            if size < 0 or start + 1 + size > len(flat):
                raise InputError("cells with other numbers of points than they say")
            cells.append(flat[start + 1 : start + 1 + size])
            start += 1 + size
        if start != len(flat):
            raise InputError("cells with other numbers of points than they say")
        return cells

    def _whole(self, count: int, words: list[str], name: str = "offsets") -> IntArray:
        if len(words) != 2 or words[0] != name:
            raise InputError(f"line {' '.join(words)[:40]!r}, expected {name.upper()} TYPE")
        values = self._numbers(count, words[1])
        if values.dtype.kind not in "iu":
            raise InputError(f"{name} of {words[1]}, expected whole numbers")
        return values.astype(np.int64)

    def _attribute(self, words: list[str], into: dict[str, NDArray[np.generic]], rows: int) -> None:
        match words:
            case ["scalars", name, kind, *parts] if len(parts) < 2:
                wide = self._count(parts[0]) if parts else 1
                at = self.at
                if self._words()[:1] != ["lookup_table"]:
                    self.at = at
            case ["lookup_table", _, size]:
                self._numbers(4 * self._count(size), "unsigned_char" if self.binary else "float")
                return
            case ["color_scalars", name, parts]:
                wide, kind = self._count(parts), "unsigned_char" if self.binary else "float"
            case ["texture_coordinates", name, parts, kind]:
                wide = self._count(parts)
            case [attribute, name, kind] if attribute in _COMPONENTS:
                wide = _COMPONENTS[attribute]
            case _:
                raise InputError(f"line {' '.join(words)[:60]!r}")
        self._keep(into, name, self._numbers(rows * wide, kind), rows, wide)

    def _field(
        self, words: list[str], into: dict[str, NDArray[np.generic]] | None, rows: int
    ) -> None:
        """Named arrays; text and those of the whole file (``into`` is None) are passed over."""
        for _ in range(self._count(words[-1])):
            line = self._line_of_array()
            if len(line) != 4:
                raise InputError(f"line {' '.join(line)[:60]!r}, expected that of an array")
            wide, count = self._count(line[1]), self._count(line[2])
            if line[3] == "string":
                self._skip_text(wide * count)
                continue
            values = self._numbers(wide * count, line[3])
            if into is not None:
                if count != rows:
                    raise InputError(f"array {line[0]!r} has {count} rows, expected {rows}")
                self._keep(into, line[0], values, rows, wide)

    def _skip_text(self, count: int) -> None:
        """Pass over an array of text; in binary files the length leads, its size in two bits."""
        for _ in range(count):
            if self.at >= len(self.content):
                raise InputError("ends within an array of text")
            if not self.binary:
                self._raw_line()
                continue
            width = 8 >> (self.content[self.at] >> 6)
            length = int.from_bytes(self.content[self.at : self.at + width], "big")
            self.at += width + (length & ((1 << (8 * width - 2)) - 1))

    def _line_of_array(self) -> list[str]:
        """Name, components, rows and type of the next array in a field."""
        while (line := self._raw_line().decode("utf-8", errors="replace").split()) in (
            [],
            ["METADATA"],
        ):
            if line:
                self._skip_metadata()
            if self.at >= len(self.content):
                raise InputError("ends within a field")
        return line

    @staticmethod
    def _keep(
        into: dict[str, NDArray[np.generic]],
        name: str,
        values: NDArray[np.generic],
        rows: int,
        wide: int,
    ) -> None:
        into[unquote(name)] = values.reshape(rows, wide) if wide != 1 else values

    def _numbers(self, count: int, kind: str) -> NDArray[np.generic]:
        code = _TYPES.get(kind.lower())
        if code is None:
            raise InputError(f"numbers of type {kind[:20]!r}, expected {', '.join(_TYPES)}")
        if self.binary:
            dtype = np.dtype(">" + code)
            end = self.at + count * dtype.itemsize
            if end > len(self.content):
                raise InputError(f"ends within {count} numbers")
            values = np.frombuffer(self.content, dtype, count, offset=self.at)
            self.at = end
            return values.astype(dtype.newbyteorder("="))
        # Every number takes two bytes or more, the last of a file one.
        if 2 * count > len(self.content) - self.at + 1:
            raise InputError(f"ends within {count} numbers")
        words: list[str] = []
        while len(words) < count:
            if self.at >= len(self.content):
                raise InputError(f"ends within {count} numbers")
            words += self._raw_line().decode("ascii", errors="replace").split()
        if len(words) > count:
            raise InputError(f"{len(words)} numbers, expected {count}")
        return array_of_words(words, code)

    @staticmethod
    def _count(word: str) -> int:
        if not (word.isascii() and word.isdecimal() and len(word) < 12):
            raise InputError(f"{word[:20]!r}, expected a number of rows")
        return int(word)

    def _words(self) -> list[str]:
        """Of the next line that has any, the first in lower case; none at the end."""
        while self.at < len(self.content):
            line = self._raw_line()
            if len(line) > _MAX_LINE:
                raise InputError(f"a line of {len(line)} bytes where a word is expected")
            words = line.decode("utf-8", errors="replace").split()
            if words:
                return [words[0].lower(), *words[1:]]
        return []

    def _raw_line(self) -> bytes:
        end = self.content.find(b"\n", self.at)
        end = len(self.content) if end < 0 else end
        line = self.content[self.at : end]
        self.at = end + 1
        return line

    def _skip_metadata(self) -> None:
        while self.at < len(self.content) and self._raw_line().strip():
            pass


def _of_polygon(polygon: IntArray, points: FloatArray) -> list[IntArray] | None:
    """Triangles of a polygon from its first corner; None of one that is not flat and convex."""
    if len(polygon) == 3:
        return [polygon]
    if len(polygon) < 3:
        return None
    corner = points[polygon]
    along = np.roll(corner, -1, axis=0) - corner
    turns = np.cross(np.roll(along, 1, axis=0), along)
    normal = np.cross(corner - corner[0], np.roll(corner, -1, axis=0) - corner[0]).sum(axis=0)
    size = float(np.linalg.norm(normal))
    if size > 0:
        height = np.abs((corner - corner[0]) @ normal) / size
        if not (height.max() <= FLAT * np.sqrt(size) and (turns @ normal).min() >= -FLAT * size**2):
            return None
    return [polygon[[0, k, k + 1]] for k in range(1, len(polygon) - 1)]


def _of_strip(strip: IntArray) -> list[IntArray]:
    """Triangles of a strip, every second one turned so that all face one way."""
    corners = [strip[k : k + 3] for k in range(len(strip) - 2)]
    return [corner if k % 2 == 0 else corner[[1, 0, 2]] for k, corner in enumerate(corners)]
