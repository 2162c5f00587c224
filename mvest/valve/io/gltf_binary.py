"""Triangles of a binary glTF file (GLB), by the names of its objects.

The container and the layout of its arrays are those of glTF 2.0 (Khronos Group, ISO/IEC
12113:2022). Materials, normals and colours are left aside. Lengths are metres by that standard; as
not every program keeps to it, they stay here what they are in the file.
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
from mvest.reading.bounded import refusing
from mvest.reading.json_file import parse_json
from mvest.reading.text import MAX_TEXT, read_bytes
from mvest.typing import FloatArray, IntArray
from mvest.valve.io.vtk_xml import MAX_SURFACE, SurfaceFile

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
