"""Meshes from the files of others; these functions run in the child (`mvest.exchange.child`).

VTK reads its own formats and STL, trimesh reads GLB. OBJ and PLY are read here: VTK drops the
groups of the one and the properties of the other, and trimesh reads no binary PLY file that mixes
triangles and quadrilaterals.
"""

from __future__ import annotations

import importlib
import io
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray

Arrays = dict[str, NDArray[np.generic]]

POINTS, LINES, STRIPS, FACES, OTHERS = range(5)
"""Kinds of cells: vertices by themselves, lines, strips of triangles, polygons, all others."""
_KIND = {1: POINTS, 2: POINTS, 3: LINES, 4: LINES, 5: FACES, 6: STRIPS, 7: FACES, 9: FACES}
"""By VTK's number of a type of cell."""


@dataclass(slots=True, eq=False)
class _Cells:
    """What a file holds.

    Attributes
    ----------
    points
        ``(n, 3)``.
    corners, sizes
        Points of all cells one after another, and how many each of the c cells has ``(c,)``.
    types
        ``(c,)`` VTK's numbers of the types of the cells; None: all are polygons.
    group, names
        ``(c,)`` index of the name of each cell's group or object; None where there are no groups.
    """

    points: FloatArray
    corners: IntArray
    sizes: IntArray
    types: IntArray | None = None
    point_data: Arrays = field(default_factory=dict)
    cell_data: Arrays = field(default_factory=dict)
    field_data: dict[str, Any] = field(default_factory=dict)
    group: IntArray | None = None
    names: list[str] = field(default_factory=list)


def read_cells(path: Path, suffix: str) -> dict[str, Any]:
    """The fields of `mvest.exchange.surfaces.Mesh` for a file of a kind.

    Raises
    ------
    InputError, GeometryError
        A damaged file, no points, or cells that name points that do not exist.
    """
    found = _READERS[suffix](path)
    n = len(found.points)
    if not n:
        raise InputError("damaged or empty: no points")
    corners, sizes = found.corners, found.sizes
    if (sizes < 0).any() or sizes.sum() != len(corners):
        raise InputError("damaged: cells with other numbers of points than they say")
    if len(corners) and not 0 <= corners.min() <= corners.max() < n:
        raise GeometryError("cells name points that do not exist")
    types = np.full(len(sizes), 7) if found.types is None else found.types
    kinds = np.array([_KIND.get(number, OTHERS) for number in range(256)])[types]
    triangles, rows = _triangles(found, kinds)
    lines = kinds == LINES
    others, counts = np.unique(types[kinds == OTHERS], return_counts=True)
    return {
        "points": found.points,
        "triangles": triangles,
        "line_points": corners[np.repeat(lines, sizes)],
        "line_sizes": sizes[lines],
        "others": {_type_name(k): m for k, m in zip(others.tolist(), counts.tolist(), strict=True)},
        "point_data": _whole(found.point_data, n, "points"),
        "cell_data": {k: v[rows] for k, v in _whole(found.cell_data, len(sizes), "cells").items()},
        "field_data": found.field_data,
        "space": _space(path, found),
        "group": None if found.group is None else found.group[rows],
        "names": found.names,
    }


def _whole(data: Arrays, rows: int, what: str) -> Arrays:
    for name, values in data.items():
        if len(values) != rows:
            raise InputError(f"data {name!r} has {len(values)} rows, expected {rows} {what}")
    return data


def _space(path: Path, found: _Cells) -> str | None:
    """Name of the axes as 3D Slicer writes it: in a title or comment, or among the field data."""
    with path.open("rb") as stream:
        words = re.search(rb"SPACE=(LPS|RAS)\b", stream.read(4096))
    return words[1].decode() if words else found.field_data.get("SPACE")


def _type_name(number: int) -> str:
    names = vtk_module("vtkCommonDataModel").vtkCellTypes
    return str(names.GetClassNameFromTypeId(number)).removeprefix("vtk").lower()


def _triangles(found: _Cells, kinds: IntArray) -> tuple[IntArray, IntArray]:
    """Triangles ``(m, 3)`` of polygons and strips, and the row ``(m,)`` of each one's cell."""
    plain = (kinds == FACES) & (found.sizes >= 3)
    strips = (kinds == STRIPS) & (found.sizes >= 3)
    rows = np.flatnonzero(plain | strips)
    if not strips.any() and (found.sizes[plain] == 3).all():
        return found.corners[np.repeat(plain, found.sizes)].reshape(-1, 3), rows

    def cells(own: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
        return found.corners[np.repeat(own, found.sizes)], found.sizes[own]

    row = np.concatenate([np.flatnonzero(plain), np.flatnonzero(strips)])
    cutter = vtk_module("vtkFiltersCore").vtkTriangleFilter()
    cutter.SetInputData(polydata(found.points, cells(plain), cells(strips), cell_data={"row": row}))
    cutter.Update()
    result = cutter.GetOutput()
    rows = _numpy(result.GetCellData().GetArray("row")).astype(np.int64)
    corners = _numpy(result.GetPolys().GetConnectivityArray()).astype(np.int64)
    order = np.argsort(rows, kind="stable")
    return corners.reshape(-1, 3)[order], rows[order]


def polydata(
    points: FloatArray,
    faces: tuple[IntArray, IntArray],
    strips: tuple[IntArray, IntArray] | None = None,
    point_data: Mapping[str, NDArray[np.generic]] | None = None,
    cell_data: Mapping[str, NDArray[np.generic]] | None = None,
) -> Any:
    """VTK's object of polygons and strips, each given as (points of all, number of each)."""
    convert, model = vtk_module("util.numpy_support"), vtk_module("vtkCommonDataModel")
    result, places = model.vtkPolyData(), vtk_module("vtkCommonCore").vtkPoints()
    places.SetData(convert.numpy_to_vtk(points, deep=1))
    result.SetPoints(places)
    for cells, put in ((faces, result.SetPolys), (strips, result.SetStrips)):
        if cells is not None:
            corners, sizes = cells
            array, ends = model.vtkCellArray(), np.concatenate([[0], np.cumsum(sizes)])
            array.SetData(*(convert.numpy_to_vtkIdTypeArray(k, deep=1) for k in (ends, corners)))
            put(array)
    for data, into in ((point_data, result.GetPointData()), (cell_data, result.GetCellData())):
        for name, values in (data or {}).items():
            column = convert.numpy_to_vtk(values, deep=1)
            column.SetName(name)
            into.AddArray(column)
    return result


def vtk_module(name: str) -> Any:
    """One of VTK's modules; they are imported singly, as all of them take a second."""
    return importlib.import_module(f"vtkmodules.{name}")


def _numpy(array: Any) -> NDArray[Any]:
    result: NDArray[Any] = vtk_module("util.numpy_support").vtk_to_numpy(array)
    return result


def _vtk(path: Path, module: str, name: str) -> _Cells:
    """What one of VTK's readers reads."""
    reader = getattr(vtk_module(module), name)()
    if module == "vtkIOLegacy":
        _prepare_legacy(reader, path.read_bytes())
    reader.SetFileName(str(path))
    _update(reader)
    data = reader.GetOutput()
    if data is None or not (data.IsA("vtkPolyData") or data.IsA("vtkUnstructuredGrid")):
        kind = data.GetClassName().removeprefix("vtk") if data else "nothing"
        raise InputError(f"holds {kind}, expected PolyData or an UnstructuredGrid")
    if data.IsA("vtkPolyData"):
        parts = [data.GetVerts(), data.GetLines(), data.GetPolys(), data.GetStrips()]
        types = np.repeat([2, 4, 7, 6], [part.GetNumberOfCells() for part in parts])
    else:
        parts = [data.GetCells()]
        types = np.zeros(0, dtype=np.int64)
        if data.GetNumberOfCells():
            types = _numpy(data.GetCellTypesArray()).astype(np.int64)
    points = data.GetPoints()
    return _Cells(
        np.zeros((0, 3)) if points is None else _numpy(points.GetData()).astype(np.float64),
        np.concatenate([_numpy(c.GetConnectivityArray()) for c in parts]).astype(np.int64),
        np.concatenate([np.diff(_numpy(c.GetOffsetsArray())) for c in parts]).astype(np.int64),
        types,
        _arrays(data.GetPointData()),
        _arrays(data.GetCellData()),
        _arrays(data.GetFieldData()),
    )


def _prepare_legacy(reader: Any, content: bytes) -> None:
    """Have all arrays read, and numbers that are missing at the end of a text noticed.

    VTK 9.7 makes numbers up where a text ends too early, but not where it meets a word instead. So
    a field without arrays follows.
    """
    for what in ("Scalars", "Vectors", "Normals", "Tensors", "ColorScalars", "TCoords", "Fields"):
        getattr(reader, f"ReadAll{what}On")()
    if b"ASCII" in b"".join(content[:1024].upper().splitlines()[2:3]):
        reader.ReadFromInputStringOn()
        reader.SetInputString(content.decode("latin-1") + "\nFIELD end 0\n")


def _update(reader: Any) -> None:
    """Let a reader read; raise what VTK says of errors, some of which it calls warnings."""
    said: list[str] = []

    def heard(_window: object, event: str, text: str) -> None:
        if event == "ErrorEvent" or "Error reading" in text:
            said.append(text)

    heard.CallDataType = "string0"  # type: ignore[attr-defined]
    window = vtk_module("vtkCommonCore").vtkOutputWindow.GetInstance()
    tags = [window.AddObserver(event, heard) for event in ("ErrorEvent", "WarningEvent")]
    reader.Update()
    for tag in tags:
        window.RemoveObserver(tag)
    if said:
        words = re.sub(r"^.*?, line [0-9]+\s", "", said[0], flags=re.S)
        raise InputError(f"damaged: {re.sub(r'^vtk[^:]*0x[0-9a-f]+.: ', '', words)}")


def _arrays(data: Any) -> dict[str, Any]:
    """Arrays of numbers by their names, and text that is one word."""
    result: dict[str, Any] = {}
    for number in range(data.GetNumberOfArrays()):
        array, name = data.GetAbstractArray(number), data.GetArrayName(number) or ""
        if array.IsA("vtkStringArray"):
            if array.GetNumberOfValues() == 1:
                result[name] = array.GetValue(0)
        elif array.IsA("vtkDataArray") and not array.IsA("vtkBitArray"):
            result[name] = _numpy(array)
    return result


def _obj(path: Path) -> _Cells:
    """An OBJ file with the names of groups, or of objects where there are no groups."""
    points: list[list[str]] = []
    corners: list[int] = []
    sizes: list[int] = []
    of_faces: dict[str, list[str]] = {"g": [], "o": []}
    now = {"g": "", "o": ""}
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for line in text.splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            points.append(rest[:3])
        elif word == "f":
            face = [int(corner.split("/")[0]) for corner in rest]
            if 0 in face:
                raise GeometryError("cells name points that do not exist: they count from 1")
            # A negative number counts from the last vertex so far.
            corners += [k - 1 if k > 0 else len(points) + k for k in face]
            sizes.append(len(face))
            for kind, name in now.items():
                of_faces[kind].append(name)
        elif word in now:
            now[word] = " ".join(rest)
    groups = of_faces["g"] if any(of_faces["g"]) else of_faces["o"]
    names, group = np.unique(groups, return_inverse=True)
    return _Cells(
        np.array(points, dtype=np.float64).reshape(-1, 3),
        np.array(corners, dtype=np.int64),
        np.array(sizes, dtype=np.int64),
        group=group if any(groups) else None,
        names=names.tolist(),
    )


_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_PLY_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">"}


def _ply(path: Path) -> _Cells:
    """A PLY file with the properties of its vertices and faces."""
    head, mark, body = path.read_bytes().partition(b"end_header")
    lines = [line.split() for line in head.decode("latin-1").splitlines()]
    if not mark or lines[:1] != [["ply"]]:
        raise InputError("damaged or no PLY file: no header from 'ply' to 'end_header'")
    body = body[body.index(b"\n") + 1 :]
    form = next(words[1] for words in lines if words[:1] == ["format"])
    if form == "ascii":  # every number becomes one of eight bytes
        body = np.array(body.split(), dtype="<f8").tobytes()
    elements: dict[str, tuple[int, list[tuple[str, list[str]]]]] = {}
    for words in lines:
        if words[:1] == ["element"]:
            elements[words[1]] = (int(words[2]), [])
        elif words[:1] == ["property"]:
            kinds = [
                "<f8" if form == "ascii" else _PLY_ORDER[form] + _PLY_TYPES[kind]
                for kind in words[1:-1]
                if kind != "list"
            ]
            list(elements.values())[-1][1].append((words[-1], kinds))
    tables: dict[str, Arrays] = {}
    at = 0
    for name, (count, properties) in elements.items():
        tables[name], at = _ply_element(body, at, count, properties)
    return _ply_cells(tables.get("vertex", {}), tables.get("face", {}))


def _ply_element(
    body: bytes, at: int, count: int, properties: list[tuple[str, list[str]]]
) -> tuple[Arrays, int]:
    """Columns of an element, and where the next one begins.

    Of a list there are two: its lengths, and under its name all its numbers one after another.
    """
    first: list[tuple[str, str, tuple[int, ...]]] = []
    width = 0
    for name, kinds in properties:
        if len(kinds) == 1:
            first.append((name, kinds[0], ()))
        else:
            size = int(np.frombuffer(body, kinds[0], 1, at + width)[0]) if count else 0
            first += [(f"{name} size", kinds[0], ()), (name, kinds[1], (size,))]
        width = np.dtype(first).itemsize
    row = np.dtype(first)
    sizes = [name for name, _, _ in first if name.endswith(" size")]
    if at + count * width <= len(body):
        table = np.frombuffer(body, row, count, at)
        if all((table[name] == table[name][:1]).all() for name in sizes):
            return {name: table[name].ravel() for name in row.names or ()}, at + count * width
    # Lists of several lengths: one by one.
    columns: dict[str, list[NDArray[Any]]] = {name: [] for name in row.names or ()}
    for _ in range(count):
        for name, kinds in properties:
            length = 1
            for kind, column in zip(
                kinds, ([f"{name} size"] if kinds[1:] else []) + [name], strict=True
            ):
                values = np.frombuffer(body, kind, length, at)
                columns[column].append(values)
                at += values.nbytes
                length = int(values[0]) if len(values) else 0
    return {name: np.concatenate(parts) for name, parts in columns.items()}, at


def _ply_cells(vertex: Arrays, face: Arrays) -> _Cells:
    if not {"x", "y", "z"} <= set(vertex):
        raise InputError("no element vertex with x, y and z")
    name = next((name for name in ("vertex_indices", "vertex_index") if name in face), "")
    no_cells = np.zeros(0, dtype=np.int64)

    def others(table: Arrays, *without: str) -> Arrays:
        return {
            key: values.astype(values.dtype.newbyteorder("="))
            for key, values in table.items()
            if key not in without and f"{key} size" not in table and not key.endswith(" size")
        }

    return _Cells(
        np.column_stack([vertex[axis].astype(np.float64) for axis in "xyz"]),
        face.get(name, no_cells).astype(np.int64),
        face.get(f"{name} size", no_cells).astype(np.int64),
        point_data=others(vertex, "x", "y", "z"),
        cell_data=others(face),
    )


def _glb(path: Path) -> _Cells:
    """All objects of a scene where its nodes place them, by the names of the nodes or meshes."""
    import trimesh

    # A stream without a name: arrays in other files are not followed.
    scene = trimesh.load_scene(
        io.BytesIO(path.read_bytes()), file_type="glb", skip_materials=True, process=False
    )
    points: list[FloatArray] = [np.zeros((0, 3))]
    faces: list[IntArray] = [np.zeros((0, 3), dtype=np.int64)]
    names: list[str] = []
    for node in map(str, scene.graph.nodes_geometry):
        transform, geometry = scene.graph[node]
        part = scene.geometry[geometry].copy()
        if isinstance(part, trimesh.Trimesh):
            part.apply_transform(transform)
            faces.append(sum(map(len, points)) + np.asarray(part.faces))
            points.append(np.asarray(part.vertices))
            if part.metadata["from_gltf_primitive"]:  # one of several of its node
                node = str(scene.graph.transforms.parents[node])
            names.append(str(geometry) if node.isdecimal() else node)
    corners = np.concatenate(faces)
    return _Cells(
        np.concatenate(points).astype(np.float64),
        corners.ravel().astype(np.int64),
        np.full(len(corners), 3),
        group=np.repeat(np.arange(len(names)), [len(part) for part in faces[1:]]),
        names=names,
    )


_READERS: dict[str, Callable[[Path], _Cells]] = {
    ".vtk": partial(_vtk, module="vtkIOLegacy", name="vtkGenericDataObjectReader"),
    ".vtp": partial(_vtk, module="vtkIOXML", name="vtkXMLPolyDataReader"),
    ".vtu": partial(_vtk, module="vtkIOXML", name="vtkXMLUnstructuredGridReader"),
    ".stl": partial(_vtk, module="vtkIOGeometry", name="vtkSTLReader"),
    ".obj": _obj,
    ".ply": _ply,
    ".glb": _glb,
}
