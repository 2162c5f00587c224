"""Reads other programs' mesh files as VTK objects, in the child (`mvest.exchange.child`).

VTK reads its own formats and OBJ; trimesh reads PLY and GLB. STL is read here, because VTK accepts
truncated STL files.
"""

import importlib
import io
import json
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import ConfigurationError, GeometryError, InputError
from mvest.typing import FloatArray, IntArray

Arrays = Mapping[str, NDArray[np.generic]]
POLYGONS = (5, 7, 9)
FLAT = (1, 2, 3, 4, *POLYGONS)
"""VTK's cell type numbers; 1 and 2 are single vertices, 3 and 4 are lines."""
STL_HEADER = 84
STL_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_cells(path: Path, suffix: str) -> dict[str, Any]:
    """The fields of `mvest.exchange.surfaces.Surface` from a file of this kind.

    InputError or GeometryError if the file is damaged or has no points or cells, or cells name
    points that do not exist.
    """
    data, groups = READERS[suffix](path)
    if not data.GetNumberOfPoints():
        raise InputError("damaged or empty: no points, expected a surface")
    if not data.GetNumberOfCells():
        raise GeometryError("no triangles or other cells; expected a triangulated surface")
    points = _numpy(data.GetPoints().GetData()).astype(np.float64)
    types, sizes, corners = _cells(data, len(points))
    triangles, rows = _triangles(points, types, sizes, corners)
    at_points, at_cells = _arrays(data.GetPointData()), _arrays(data.GetCellData())
    for what, count, arrays in (("points", points, at_points), ("cells", types, at_cells)):
        for name, values in arrays.items():
            if len(values) != len(count):
                raise InputError(
                    f"data {name!r} has {len(values)} rows, expected {len(count)} {what}"
                )
    numbers, counts = np.unique(types[~np.isin(types, FLAT)], return_counts=True)
    name_of = vtk_module("vtkCommonDataModel").vtkCellTypes.GetClassNameFromTypeId
    names = [name_of(number).removeprefix("vtk").lower() for number in numbers.tolist()]
    with path.open("rb") as stream:  # 3D Slicer names the axes in a title or comment
        words = re.search(rb"SPACE=(LPS|RAS)\b", stream.read(4096))
    space = words[1].decode() if words else _arrays(data.GetFieldData()).get("SPACE")
    owner = np.repeat(np.arange(len(types)), sizes)
    onward = np.isin(types[owner], (3, 4))[:-1] & (owner[:-1] == owner[1:])
    return {
        "vertices": points,
        "triangles": triangles,
        "lines": np.stack([corners[:-1], corners[1:]], axis=1)[onward],
        "others": dict(zip(names, counts.tolist(), strict=True)),
        "point_data": at_points,
        "cell_data": {name: values[rows] for name, values in at_cells.items()},
        "space": space if space in ("LPS", "RAS") else None,
        "groups": [groups[row] for row in rows.tolist()] if groups else [],
    }


def _cells(data: Any, count: int) -> tuple[IntArray, IntArray, IntArray]:
    """Types and sizes ``(c,)`` of all cells, and their concatenated corners."""
    if data.IsA("vtkPolyData"):
        parts = [data.GetVerts(), data.GetLines(), data.GetPolys(), data.GetStrips()]
        types = np.repeat([2, 4, 7, 6], [part.GetNumberOfCells() for part in parts])
    else:
        parts, types = [data.GetCells()], _numpy(data.GetCellTypesArray())
    corners = np.concatenate([_numpy(part.GetConnectivityArray()) for part in parts])
    valid = all(part.IsValid() for part in parts)
    if not valid or (len(corners) and not 0 <= corners.min() <= corners.max() < count):
        raise GeometryError("cells name points that do not exist")
    sizes = np.concatenate([np.diff(_numpy(part.GetOffsetsArray())) for part in parts])
    return types.astype(np.int64), sizes.astype(np.int64), corners.astype(np.int64)


def _triangles(
    points: FloatArray, types: IntArray, sizes: IntArray, corners: IntArray
) -> tuple[IntArray, IntArray]:
    """Triangles ``(m, 3)`` of polygons, and the number ``(m,)`` of the cell of each."""
    polygon = np.isin(types, POLYGONS) & (sizes > 2)
    flat, rows = corners[np.repeat(polygon, sizes)], np.flatnonzero(polygon)
    if (sizes[polygon] != 3).any():
        cutter = vtk_module("vtkFiltersCore").vtkTriangleFilter()
        cutter.SetInputData(polydata(points, flat, sizes[polygon], cell_data={"row": rows}))
        cutter.Update()
        flat = _numpy(cutter.GetOutput().GetPolys().GetConnectivityArray())
        rows = _numpy(cutter.GetOutput().GetCellData().GetArray("row"))
    return flat.reshape(-1, 3).astype(np.int64), rows


def vtk_module(name: str) -> Any:
    """Import one VTK module, because importing all of them takes a second.

    Raises a `ConfigurationError` if VTK is not installed.
    """
    try:
        return importlib.import_module(f"vtkmodules.{name}")
    except ImportError as error:
        raise ConfigurationError(f"{error}; pip install 'mvest[files]' has it") from error


def _numpy(array: Any) -> NDArray[Any]:
    result: NDArray[Any] = vtk_module("util.numpy_support").vtk_to_numpy(array)
    return result


def polydata(
    points: FloatArray,
    corners: IntArray,
    sizes: IntArray,
    point_data: Arrays | None = None,
    cell_data: Arrays | None = None,
) -> Any:
    """A vtkPolyData of polygons, from their concatenated corners and their sizes."""
    convert, model = vtk_module("util.numpy_support"), vtk_module("vtkCommonDataModel")
    result, cells = model.vtkPolyData(), model.vtkCellArray()
    positions = vtk_module("vtkCommonCore").vtkPoints()
    positions.SetData(convert.numpy_to_vtk(points, deep=1))
    ends = np.concatenate([[0], np.cumsum(sizes)])
    cells.SetData(*(convert.numpy_to_vtkIdTypeArray(k, deep=1) for k in (ends, corners)))
    result.SetPoints(positions)
    result.SetPolys(cells)
    for data, arrays in ((result.GetPointData(), point_data), (result.GetCellData(), cell_data)):
        for name, values in (arrays or {}).items():
            column = convert.numpy_to_vtk(values, deep=1)
            column.SetName(name)
            data.AddArray(column)
    return result


def _of_triangles(points: NDArray[Any], corners: NDArray[Any]) -> Any:
    """A vtkPolyData of points ``(n, 3)`` and triangles (or their concatenated corners)."""
    flat = corners.ravel().astype(np.int64)
    return polydata(points.astype(np.float64), flat, np.full(len(flat) // 3, 3))


def _arrays(data: Any) -> dict[str, Any]:
    """Numeric arrays by name, and one-word strings."""
    result: dict[str, Any] = {}
    for number in range(data.GetNumberOfArrays()):
        array, name = data.GetAbstractArray(number), data.GetArrayName(number) or ""
        if array.IsA("vtkStringArray"):
            if array.GetNumberOfValues() == 1:
                result[name] = array.GetValue(0)
        elif array.IsA("vtkDataArray") and not array.IsA("vtkBitArray"):
            result[name] = _numpy(array)
    return result


def _vtk(path: Path, module: str, name: str) -> tuple[Any, list[str]]:
    """Read with a VTK reader; raise its error messages, including those it calls warnings."""
    errors: list[str] = []

    def listen(_window: object, event: str, text: str) -> None:
        # "InformationKey" warns of array ranges, which may be infinite.
        if ("Error reading" in text or event == "ErrorEvent") and "InformationKey" not in text:
            errors.append(text)

    listen.CallDataType = "string0"  # type: ignore[attr-defined]
    window = vtk_module("vtkCommonCore").vtkOutputWindow.GetInstance()
    tags = [window.AddObserver(event, listen) for event in ("ErrorEvent", "WarningEvent")]
    reader = getattr(vtk_module(module), name)()
    reader.SetFileName(str(path))
    if module == "vtkIOLegacy":
        kinds = ("Scalars", "Vectors", "Normals", "Tensors", "ColorScalars", "TCoords", "Fields")
        for what in kinds:
            getattr(reader, f"ReadAll{what}On")()
        content = path.read_bytes()
        if b"ASCII" in b"".join(content[:1024].upper().splitlines()[2:3]):
            # VTK 9.7 makes up numbers at the end of truncated text, but not before a keyword.
            reader.ReadFromInputStringOn()
            reader.SetInputString(content.decode("latin-1") + "\nFIELD end 0\n")
    reader.Update()
    for tag in tags:
        window.RemoveObserver(tag)
    if errors:
        words = re.sub(r"^.*?, line [0-9]+\s", "", errors[0], flags=re.S)
        raise InputError(f"damaged: {re.sub(r'^vtk[^:]*0x[0-9a-f]+.: ', '', words)}")
    data = reader.GetOutput()
    if data is None or not (data.IsA("vtkPolyData") or data.IsA("vtkUnstructuredGrid")):
        kind = data.GetClassName().removeprefix("vtk") if data else "nothing"
        raise InputError(f"holds {kind}, expected PolyData or an UnstructuredGrid")
    return data, []


def _stl(path: Path) -> tuple[Any, list[str]]:
    """Read an STL file. VTK accepts truncated files and rejects capitals."""
    content = path.read_bytes()
    count = int.from_bytes(content[80:STL_HEADER], "little")
    whole = STL_HEADER + count * STL_FACET.itemsize
    if len(content) == whole or (len(content) > whole and b"\0" in content[:STL_HEADER]):
        corners = np.frombuffer(content, STL_FACET, count, STL_HEADER)["corners"].astype(np.float64)
    elif content.lstrip()[:5].lower() == b"solid":
        words = content.lower().split()
        at = [k for k, word in enumerate(words) if word == b"vertex"]
        if words.count(b"endloop") * 3 != len(at) or b"endsolid" not in words:
            raise InputError(f"{len(at)} corners, expected three of each facet and endsolid")
        corners = np.array([float(word) for k in at for word in words[k + 1 : k + 4]])
    else:
        raise InputError(f"{len(content)} bytes, expected {whole} for {count} triangles")
    points = corners.reshape(-1, 3)
    return _of_triangles(points, np.arange(len(points))), []


def _ply(path: Path) -> tuple[Any, list[str]]:
    """Read points and faces of a PLY file with trimesh, which accepts truncated text."""
    from trimesh.exchange.ply import load_ply

    content = path.read_bytes()
    found = load_ply(io.BytesIO(content), fix_texture=False, skip_materials=True)
    points, faces = (np.asarray(found[name]) for name in ("vertices", "faces"))
    head = content.partition(b"end_header")[0]
    counts = dict(re.findall(rb"(?m)^element (vertex|face) (\d+)\s*$", head))
    wanted = [int(counts.get(name, 0)) for name in (b"vertex", b"face")]
    if len(points) != wanted[0] or len(faces) < wanted[1]:  # a polygon is several triangles
        raise InputError(
            f"{len(points)} vertices and {len(faces)} triangles, expected {wanted[0]} vertices and "
            f"{wanted[1]} faces"
        )
    return _of_triangles(points, faces), []


def _glb(path: Path) -> tuple[Any, list[str]]:
    """All objects of a scene, placed by its nodes and named after nodes, or else meshes."""
    import trimesh

    content = path.read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    needed = list(map(str, document.get("extensionsRequired", [])))
    if any("sparse" in array or "bufferView" not in array for array in document["accessors"]):
        needed.append("sparse or compressed arrays")  # which trimesh reads as zeros
    if needed:
        words = ", ".join(needed)
        raise InputError(f"needs {words} of glTF; save it without compression or extensions")
    # A stream has no file name, so references to other files are not followed.
    scene = trimesh.load_scene(
        io.BytesIO(content), file_type="glb", skip_materials=True, process=False
    )
    points: list[FloatArray] = [np.zeros((0, 3))]
    faces: list[IntArray] = [np.zeros((0, 3), dtype=np.int64)]
    names: list[str] = []
    for node in map(str, reversed(list(scene.graph.nodes_geometry))):
        transform, geometry = scene.graph[node]
        part = scene.geometry[geometry].copy()
        if isinstance(part, trimesh.Trimesh):
            part.apply_transform(transform)
            faces.append(sum(map(len, points)) + np.asarray(part.faces))
            points.append(np.asarray(part.vertices, dtype=np.float64))
            if part.metadata["from_gltf_primitive"]:  # one of several parts of a node
                node = str(scene.graph.transforms.parents[node])
            names += [str(geometry) if node.isdecimal() else node] * len(part.faces)
    return _of_triangles(np.concatenate(points), np.concatenate(faces)), names


READERS: dict[str, Callable[[Path], tuple[Any, list[str]]]] = {
    ".vtk": partial(_vtk, module="vtkIOLegacy", name="vtkGenericDataObjectReader"),
    ".vtp": partial(_vtk, module="vtkIOXML", name="vtkXMLPolyDataReader"),
    ".vtu": partial(_vtk, module="vtkIOXML", name="vtkXMLUnstructuredGridReader"),
    ".obj": partial(_vtk, module="vtkIOGeometry", name="vtkOBJReader"),
    ".stl": _stl,
    ".ply": _ply,
    ".glb": _glb,
}
"""Readers by suffix; each returns VTK's object and the names of groups of its triangles."""
