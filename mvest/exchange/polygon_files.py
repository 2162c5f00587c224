"""Triangles from STL, OBJ and PLY files, as text or binary, and from binary glTF files (GLB).

meshio 5.3 reads the first three as well, but allocates what a header declares, and no properties of
faces from binary PLY files.

Of a glTF file the triangles are read by the names of its objects. The container and the layout of
its arrays are those of glTF 2.0 (Khronos Group, ISO/IEC 12113:2022). Materials, normals and colours
are left aside. Lengths are metres by that standard; as not every program keeps to it, they stay
here what they are in the file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mvest.errors import GeometryError, InputError
from mvest.exchange.vtk_xml import MAX_SURFACE, SurfaceFile
from mvest.reading.bounded import array_of_words, refusing
from mvest.reading.documents import parse_json
from mvest.reading.text import MAX_TEXT, read_bytes
from mvest.typing import FloatArray, IntArray

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


_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_COMPONENTS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC3": 3}
_TRIANGLES = 4
"""Mode of a primitive."""
MAX_NODES = 10_000
MAX_CORNERS = 10**7
"""Of all triangles and points: nodes may share a mesh, so a small file may hold many."""


def read_glb(path: Path) -> SurfaceFile:
    """Read the triangles of all objects of a scene where its nodes place them.

    Returns
    -------
    SurfaceFile
        In the unit and axes of the file; ``groups`` are the names of the nodes, or of their meshes.

    Raises
    ------
    InputError, GeometryError
        Damaged, another version, compressed or otherwise extended, arrays outside of the file, or
        primitives that are no triangles.
    """
    with refusing(path, "GLB file"):
        document, binary = _chunks(read_bytes(path, MAX_SURFACE))
        needed = document.get("extensionsRequired", [])
        if needed:
            listed = ", ".join(map(str, needed))
            raise InputError(f"needs {listed} of glTF; save it without compression or extensions")
        points: list[FloatArray] = []
        triangles: list[IntArray] = []
        groups: list[str] = []
        for name, mesh, transform in _placed(document):
            for primitive in mesh["primitives"]:
                own, corners = _primitive(document, binary, primitive)
                if (start := sum(map(len, points))) + len(own) + 3 * len(groups) > MAX_CORNERS:
                    raise InputError(f"more than {MAX_CORNERS} points and corners")
                moved = own @ transform[:3, :3].T + transform[:3, 3]
                # A mirrored node turns its triangles round.
                turned = np.linalg.det(transform[:3, :3]) < 0
                points.append(moved)
                triangles.append(start + (corners[:, ::-1] if turned else corners))
                groups += [name] * len(corners)
        if not points:
            raise GeometryError("no triangles; expected a triangulated surface")
        return SurfaceFile(np.concatenate(points), np.concatenate(triangles), groups=tuple(groups))


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """What the file says in JSON, and its binary part."""
    if len(content) < _HEADER.size:
        raise InputError(f"{len(content)} bytes, expected a header of {_HEADER.size}")
    magic, version, length = _HEADER.unpack_from(content)
    if magic != b"glTF" or version != 2:
        raise InputError(f"begins with {magic!r}, version {version}, expected b'glTF', version 2")
    if length > len(content):
        raise InputError(f"{len(content)} bytes, expected {length}: it is cut off")
    parts: dict[bytes, bytes] = {}
    at = _HEADER.size
    while at + _CHUNK.size <= length:
        size, kind = _CHUNK.unpack_from(content, at)
        at += _CHUNK.size
        if size > length - at:
            raise InputError(f"a part of {size} bytes, of which {length - at} are left")
        # Of parts of one kind the first counts.
        parts.setdefault(kind, content[at : at + size])
        at += size
    text = parts.get(b"JSON", b"")
    if len(text) > MAX_TEXT:
        raise InputError(f"{len(text)} bytes of JSON, expected at most {MAX_TEXT}")
    document = parse_json(text, "its description")
    if not isinstance(document, dict):
        raise InputError("its description is no mapping")
    return document, parts.get(b"BIN\0", b"")


def _placed(
    document: Mapping[str, Any],
) -> Iterator[tuple[str, Mapping[str, Any], FloatArray]]:
    """Name, mesh and placement ``(4, 4)`` of each node of the scene that has a mesh."""
    nodes, meshes = document.get("nodes", []), document.get("meshes", [])
    if len(nodes) > MAX_NODES:
        raise InputError(f"{len(nodes)} nodes, expected at most {MAX_NODES}")
    scene = document["scenes"][_index(document.get("scene", 0))]
    left = [(_index(number), np.eye(4)) for number in scene.get("nodes", [])]
    seen: set[int] = set()
    while left:
        number, above = left.pop(0)
        if number in seen:
            raise InputError(f"node {number} is below two nodes, or below itself")
        seen.add(number)
        node = nodes[number]
        transform = above @ _transform(node)
        left += [(_index(child), transform) for child in node.get("children", [])]
        if "mesh" in node:
            mesh = meshes[_index(node["mesh"])]
            yield str(node.get("name") or mesh.get("name") or f"node {number}"), mesh, transform


def _transform(node: Mapping[str, Any]) -> FloatArray:
    """Placement ``(4, 4)`` of a node: a matrix by columns, or scaled, turned and moved."""
    if "matrix" in node:
        return _numbers(node["matrix"], 16).reshape(4, 4).T
    result = np.eye(4)
    turn = Rotation.from_quat(_numbers(node.get("rotation", [0, 0, 0, 1]), 4)).as_matrix()
    result[:3, :3] = turn * _numbers(node.get("scale", [1, 1, 1]), 3)
    result[:3, 3] = _numbers(node.get("translation", [0, 0, 0]), 3)
    return result


def _primitive(
    document: Mapping[str, Any], binary: bytes, primitive: Mapping[str, Any]
) -> tuple[FloatArray, IntArray]:
    """Points ``(n, 3)`` and triangles ``(m, 3)``."""
    if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
        raise GeometryError(
            f"holds primitives of mode {primitive['mode']}; expected triangles only"
        )
    points = _array(document, binary, primitive["attributes"]["POSITION"], "VEC3")
    if points.dtype.kind != "f":
        raise InputError("positions are whole numbers; save it without compression or extensions")
    corners = np.arange(len(points))
    if "indices" in primitive:
        corners = _array(document, binary, primitive["indices"], "SCALAR").astype(np.int64)
    if corners.size % 3:
        raise InputError(f"{corners.size} corners, expected three for each triangle")
    if corners.size and corners.max() >= len(points):
        raise GeometryError("triangles name points that do not exist")
    return points.astype(np.float64), corners.reshape(-1, 3)


def _array(
    document: Mapping[str, Any], binary: bytes, number: Any, kind: str
) -> NDArray[np.generic]:
    """An array ``(n,)`` or ``(n, 3)`` of the binary part."""
    accessor = document["accessors"][_index(number)]
    if accessor["type"] != kind or "sparse" in accessor or "bufferView" not in accessor:
        raise InputError(f"array {number} is no plain {kind}")
    view = document["bufferViews"][_index(accessor["bufferView"])]
    if _index(view["buffer"]) != 0 or "uri" in document["buffers"][0]:
        raise InputError("arrays lie in another file; save it as one file (.glb)")
    item = np.dtype((_COMPONENTS[accessor["componentType"]], (_WIDTH[kind],)))
    count, stride = _index(accessor["count"]), _index(view.get("byteStride", item.itemsize))
    start, inside = _index(view.get("byteOffset", 0)), _index(accessor.get("byteOffset", 0))
    size = _index(view["byteLength"])
    if start + size > len(binary):
        raise InputError(f"array {number} ends beyond the {len(binary)} bytes of the file")
    if stride < item.itemsize or inside + (count - 1) * stride + item.itemsize > size:
        raise InputError(f"array {number} has {count} rows, more than its {size} bytes hold")
    data = np.ndarray((count,), item, binary, start + inside, (stride,))
    return np.array(data[:, 0] if kind == "SCALAR" else data)


def _index(value: Any) -> int:
    """A number from 0 on; negative ones would count from the end."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise InputError(f"{value!r} where a number from 0 on is expected")
    return value


def _numbers(values: Any, count: int) -> FloatArray:
    result = np.array(values, dtype=np.float64)
    if result.shape != (count,) or not np.isfinite(result).all():
        raise InputError(f"a placement of shape {result.shape}, expected {count} numbers")
    return result
