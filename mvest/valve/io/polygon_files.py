"""Triangles from STL, OBJ and PLY files, as text or binary.

meshio 5.3 reads these as well, but allocates what a header declares, and no properties of faces
from binary PLY files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.errors import GeometryError, InputError
from mvest.reading.bounded import array_of_words, refusing
from mvest.reading.text import read_bytes
from mvest.typing import FloatArray
from mvest.valve.io.vtk_xml import MAX_SURFACE, SurfaceFile

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER = 84


def read_stl(path: Path) -> SurfaceFile:
    """Read an STL file, its triangles sharing the corners that are equal to the last digit.

    Raises
    ------
    InputError
        Damaged, or facets that are no triangles.
    """
    with refusing(path, "STL file"):
        content = read_bytes(path, MAX_SURFACE)
        count = int.from_bytes(content[80:_STL_HEADER], "little")
        whole = _STL_HEADER + count * _FACET.itemsize
        if len(content) == whole or (len(content) > whole and b"\0" in content[:_STL_HEADER]):
            facets = np.frombuffer(content, _FACET, count, offset=_STL_HEADER)
            corners = facets["corners"].reshape(-1, 3).astype(np.float64)
        elif content.lstrip()[:5].lower() == b"solid":
            corners = _corners_of_text(content.decode("utf-8", errors="replace"))
        else:
            raise InputError(f"{len(content)} bytes, expected {whole} for {count} triangles")
        vertices, numbers = np.unique(corners, axis=0, return_inverse=True)
        return SurfaceFile(vertices, numbers.reshape(-1, 3).astype(np.int64))


def _corners_of_text(text: str) -> FloatArray:
    words = text.lower().split()
    at = np.flatnonzero([word == "vertex" for word in words])
    if words.count("endloop") * 3 != len(at) or "endsolid" not in words:
        raise InputError(
            f"{len(at)} corners of {words.count('endloop')} facets, expected three of each and "
            "endsolid"
        )
    taken = [word for k in at.tolist() for word in words[k + 1 : k + 4]]
    return array_of_words(taken, np.float64).reshape(-1, 3)


def read_obj(path: Path) -> SurfaceFile:
    """Read vertices and triangles of an OBJ file, with the names of groups or objects.

    Raises
    ------
    InputError, GeometryError
        Damaged, or faces that are no triangles.
    """
    with refusing(path, "OBJ file"):
        group, obj, by_group, by_object = "", "", [], []
        points: list[str] = []
        corners: list[int] = []
        text = read_bytes(path, MAX_SURFACE).decode("utf-8", errors="replace")
        for line in text.splitlines():
            word, _, rest = line.strip().partition(" ")
            if word == "v":
                numbers = rest.split()
                if len(numbers) < 3:
                    raise GeometryError(f"points of shape (n, {len(numbers)}), expected (n, 3)")
                points += numbers[:3]
            elif word == "f":
                face = [corner.split("/")[0] for corner in rest.split()]
                if len(face) != 3:
                    kind = "quad" if len(face) == 4 else f"polygon of {len(face)} corners"
                    raise GeometryError(f"holds cells of type {kind}; expected triangles only")
                numbered = array_of_words(face, np.int64).tolist()
                # A negative number counts from the last vertex so far.
                corners += [k - 1 if k > 0 else len(points) // 3 + k for k in numbered]
                if 0 in numbered:
                    raise GeometryError("triangles name points that do not exist")
                by_group.append(group)
                by_object.append(obj)
            elif word == "g":
                group = rest.strip()
            elif word == "o":
                obj = rest.strip()
        return SurfaceFile(
            array_of_words(points, np.float64).reshape(-1, 3),
            np.array(corners, dtype=np.int64).reshape(-1, 3),
            groups=tuple(by_group if any(by_group) else by_object),
        )


_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_PLY_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_HEADER = 2**16
"""Bytes within which a header ends."""


def read_ply(path: Path) -> SurfaceFile:
    """Read vertices and triangles of a PLY file with their properties.

    Raises
    ------
    InputError, GeometryError
        Damaged, lists other than the corners of faces, or faces that are no triangles.
    """
    with refusing(path, "PLY file"):
        content = read_bytes(path, MAX_SURFACE)
        order, elements, start = _ply_header(content)
        numbers = np.zeros(0)
        if not order:
            text = content[start:].decode("ascii", errors="replace")
            numbers, start = array_of_words(text.split(), np.float64), 0
        tables: dict[str, NDArray[np.void]] = {}
        for name, count, properties in elements:
            row = _ply_row(properties, order)
            width = (
                row.itemsize if order else len(properties) + 3 * ("corners" in (row.names or ()))
            )
            end = start + count * width
            if end > (len(content) if order else len(numbers)):
                raise InputError(f"ends within {count} times {name}")
            if order:
                tables[name] = np.frombuffer(content, row, count, offset=start)
            else:
                tables[name] = _ply_rows(numbers[start:end].reshape(count, width), row)
            start = end
        if content[start:].strip() if order else start < len(numbers):
            raise InputError("holds more than the header says, or faces that are no triangles")
        return _ply_surface(tables)


Property = tuple[str, str, str]
"""Its name, type, and for a list the type of the length."""


def _ply_header(content: bytes) -> tuple[str, list[tuple[str, int, list[Property]]], int]:
    """Order of bytes (empty for text), elements with their properties, and where these begin."""
    lines = content[:_PLY_HEADER].split(b"\n")
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    at = 0
    if lines[0].strip() != b"ply":
        raise InputError(f"damaged or no PLY file: begins with {lines[0][:20]!r}")
    if b"end_header" not in (line.strip() for line in lines):
        raise InputError("no end_header")
    for line in lines:
        at += len(line) + 1
        words = line.decode("ascii", errors="replace").split()
        match words:
            case ["end_header"]:
                if order is None:
                    raise InputError("no format in the header")
                names = [name for name, _, _ in elements]
                if len(set(names)) < len(names):
                    raise InputError("an element is declared twice")
                return order, elements, at
            case ["format", name, "1.0"] if name in _PLY_ORDER:
                order = _PLY_ORDER[name]
            case ["element", name, count] if count.isascii() and count.isdecimal():
                elements.append((name, int(count[:20]), []))
            case ["property", "list", length, kind, name] if elements and (
                length in _PLY_TYPES and kind in _PLY_TYPES
            ):
                elements[-1][2].append((name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1][2].append((name, _PLY_TYPES[kind], ""))
            case ["ply"] | ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise InputError(f"line {' '.join(words)[:60]!r} in the header")
    raise AssertionError("end_header is one of the lines")


def _ply_row(properties: list[Property], order: str) -> np.dtype[np.void]:
    """One row; a list is taken to have three numbers, as its length then has to say."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for name, kind, length in properties:
        if not length:
            fields.append((name, (order or "<") + kind))
        elif name in ("vertex_indices", "vertex_index"):
            fields.append(("length", (order or "<") + length))
            fields.append(("corners", (order or "<") + kind, (3,)))
        else:
            raise InputError(f"a list {name!r}; only the corners of faces may be one")
    if not fields or len({field[0] for field in fields}) < len(fields):
        raise InputError("an element without properties, or with one twice")
    return np.dtype(fields)


def _ply_rows(numbers: FloatArray, row: np.dtype[np.void]) -> NDArray[np.void]:
    """Numbers of a text as rows; whole numbers have to be some, within the range of their type."""
    rows = np.zeros(len(numbers), row)
    at = 0
    for name in row.names or ():
        width = 3 if name == "corners" else 1
        part = numbers[:, at : at + width].reshape(rows[name].shape)
        at += width
        with np.errstate(all="ignore"):
            rows[name] = part
        if rows[name].dtype.kind != "f" and (rows[name] != part).any():
            raise InputError(f"{name}: a number that is none of its type, {rows[name].dtype}")
    return rows


def _ply_surface(tables: dict[str, NDArray[np.void]]) -> SurfaceFile:
    vertex, face = tables.get("vertex"), tables.get("face")
    if vertex is None or not {"x", "y", "z"} <= set(vertex.dtype.names or ()):
        raise InputError("no element vertex with x, y and z")
    if face is None or "corners" not in (face.dtype.names or ()):
        raise GeometryError("no triangles; expected a triangulated surface")
    other = face["length"][face["length"] != 3]
    if other.size:
        raise GeometryError(f"holds a polygon of {other[0]} corners; expected triangles only")
    points = np.column_stack([vertex[axis].astype(np.float64) for axis in "xyz"])
    return SurfaceFile(
        points,
        face["corners"].astype(np.int64),
        _ply_data(vertex, ("x", "y", "z")),
        _ply_data(face, ("length", "corners")),
    )


def _ply_data(table: NDArray[np.void], without: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    names = [name for name in table.dtype.names or () if name not in without]
    return {name: table[name].astype(table[name].dtype.newbyteorder("=")) for name in names}
