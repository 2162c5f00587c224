"""Surfaces and meshes of others: VTK, STL, OBJ, PLY, GLB; time series for ParaView.

Coordinates are mm. A file appears under its name only once it is complete.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from mvest.errors import GeometryError, InputError
from mvest.exchange.child import in_child
from mvest.exchange.mesh_files import polydata, read_cells, vtk_module
from mvest.files import write_atomically
from mvest.typing import FloatArray, IntArray

Data = Mapping[str, NDArray[np.generic]]
"""Named arrays with one row per point or cell."""

WRITTEN_SUFFIXES = (".vtu", ".vtp", ".stl", ".obj", ".ply")
SURFACE_SUFFIXES = (*WRITTEN_SUFFIXES, ".vtk", ".glb")
"""That are read."""
_WRITERS = {".stl": meshio.stl.write, ".obj": meshio.obj.write, ".ply": meshio.ply.write}
"""Formats that are written without data."""
REGION_PREFIX = "region."


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFile:
    """A triangulated surface as it stands in a file.

    Attributes
    ----------
    vertices
        ``(n, 3)`` mm.
    triangles
        ``(m, 3)``.
    point_data, cell_data
        Named arrays with n or m rows; empty for STL and OBJ.
    groups
        Name of the group of each triangle, or of its object (OBJ, GLB); empty without any.
    """

    vertices: FloatArray
    triangles: IntArray
    point_data: Data = field(default_factory=dict)
    cell_data: Data = field(default_factory=dict)
    groups: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Everything that a file of a surface or a mesh holds.

    Attributes
    ----------
    points
        ``(n, 3)`` in the unit of the file, all of them in their order; finite.
    triangles
        ``(m, 3)``, also those of strips and of polygons, which VTK cuts into triangles.
    lines
        Points ``(k,)`` of each line.
    others
        How many cells there are of each other type, by its name in VTK ("tetra", "wedge");
        vertices by themselves are left out.
    point_data, cell_data
        Named arrays with a row for each point, or for each triangle.
    field_data
        Arrays, and texts of one word, that belong to the file as a whole.
    space
        "LPS" or "RAS", as 3D Slicer names the axes in a title, a comment or the field data; None
        where nothing names them.
    groups
        As in `SurfaceFile`.
    """

    points: FloatArray
    triangles: IntArray
    lines: tuple[IntArray, ...]
    others: Mapping[str, int]
    point_data: Data
    cell_data: Data
    field_data: Mapping[str, Any]
    space: str | None
    groups: tuple[str, ...]


def read_mesh(path: Path | str) -> Mesh:
    """Read the points, triangles and lines of a file, in the child.

    Raises
    ------
    InputError
        Missing or damaged file, or an extension other than ``.vtu``, ``.vtp``, ``.vtk`` (legacy),
        ``.stl``, ``.obj``, ``.ply``, ``.glb``.
    GeometryError
        Points that are not finite, or cells that name points that do not exist.
    """
    source = Path(path)
    _check_suffix(source, SURFACE_SUFFIXES)
    found = in_child(read_cells, source, source.suffix.lower())
    bad = np.flatnonzero(~np.isfinite(found["points"]).all(axis=1))
    if len(bad):
        raise GeometryError(f"{source}: points {bad[:5].tolist()} are not finite numbers")
    group, names = found.pop("group"), found.pop("names")
    groups = () if group is None else tuple(names[k] for k in group.tolist())
    line_points, sizes = found.pop("line_points"), found.pop("line_sizes")
    lines = tuple(np.split(line_points, np.cumsum(sizes)[:-1])) if len(sizes) else ()
    return Mesh(**found, lines=lines, groups=groups)


def read_surface(path: Path | str) -> SurfaceFile:
    """Read a triangulated surface with its data; lines and single vertices beside it are left out.

    Whether it is closed or manifold is not checked here; see `mvest.valve.geometry.surface_checks`.

    Raises
    ------
    InputError, GeometryError
        As `read_mesh`, no triangles, or cells of other types beside them.
    """
    mesh = read_mesh(path)
    if mesh.others:
        raise GeometryError(
            f"{path}: holds cells of type {', '.join(mesh.others)}; expected triangles only"
        )
    if not len(mesh.triangles):
        raise GeometryError(f"{path}: no triangles; expected a triangulated surface")
    return SurfaceFile(mesh.points, mesh.triangles, mesh.point_data, mesh.cell_data, mesh.groups)


def _check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: extension {path.suffix!r}, expected {', '.join(suffixes)}")


def _checked_data(data: Data | None, rows: int, what: str) -> dict[str, NDArray[np.generic]]:
    """Copy of `data` in types that the files can hold, after a check of the number of rows."""
    result = {}
    for name, values in (data or {}).items():
        array = np.asarray(values)
        if array.ndim not in (1, 2) or len(array) != rows:
            raise InputError(
                f"{what} data {name!r}: shape {array.shape}, expected ({rows},) or ({rows}, c)"
            )
        if array.dtype == bool:
            array = array.astype(np.int8)
        if array.dtype.kind not in "iuf":
            raise InputError(f"{what} data {name!r}: type {array.dtype}, expected numbers")
        result[name] = np.ascontiguousarray(array)
    return result


def write_surface(
    path: Path | str,
    vertices: FloatArray,
    triangles: IntArray,
    point_data: Data | None = None,
    cell_data: Data | None = None,
) -> Path:
    """Write a triangulated surface; the extension chooses the format.

    Raises
    ------
    InputError
        Unknown extension, wrong shapes, data for a format that holds none here (STL, OBJ, PLY), or
        a file that cannot be written.
    """
    target = Path(path)
    _check_suffix(target, WRITTEN_SUFFIXES)
    points = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(triangles, dtype=np.int64)
    _check_triangles(points, faces, str(target))
    at_points = _checked_data(point_data, len(points), "point")
    at_cells = _checked_data(cell_data, len(faces), "cell")
    suffix = target.suffix.lower()
    if suffix in _WRITERS:
        if at_points or at_cells:
            raise InputError(f"{target}: {suffix[1:].upper()} holds no data; write .vtu or .vtp")
        # PLY knows no 64-bit integers.
        mesh = meshio.Mesh(points, [("triangle", faces.astype(np.int32))])
        write_atomically(target, lambda file: _WRITERS[suffix](str(file), mesh))
    elif suffix == ".vtp":
        content = SurfaceFile(points, faces, at_points, at_cells)
        write_atomically(target, lambda file: _write_vtp(file, content))
    else:
        arrays: dict[str, list[Any]] = {name: [values] for name, values in at_cells.items()}
        mesh = meshio.Mesh(points, [("triangle", faces)], point_data=at_points, cell_data=arrays)
        write_atomically(
            target, lambda file: meshio.vtu.write(str(file), mesh, binary=True, compression="zlib")
        )
    return target


def _write_vtp(path: Path, data: SurfaceFile, space: str = "") -> None:
    """Write a ``.vtp`` file; 3D Slicer finds the name ``space`` of the axes in its field data."""
    faces = (data.triangles.ravel(), np.full(len(data.triangles), 3))
    surface = polydata(data.vertices, faces, None, data.point_data, data.cell_data)
    if space:
        words = vtk_module("vtkCommonCore").vtkStringArray()
        words.SetName("SPACE")
        words.InsertNextValue(space)
        surface.GetFieldData().AddArray(words)
    writer = vtk_module("vtkIOXML").vtkXMLPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(surface)
    if not writer.Write():
        raise OSError(f"VTK's error {writer.GetErrorCode()}")


def _check_triangles(points: FloatArray, cells: IntArray, name: str) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name}: points of shape {points.shape}, expected (n, 3)")
    if not np.isfinite(points).all():
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        raise GeometryError(f"{name}: points {bad[:5].tolist()} are not finite numbers")
    if cells.ndim != 2 or cells.shape[1] != 3 or len(cells) == 0:
        raise InputError(f"{name}: cells of shape {cells.shape}, expected (m, 3) with m > 0")
    if cells.min() < 0 or cells.max() >= len(points):
        raise InputError(f"{name}: cells name points outside 0 to {len(points) - 1}")


def region_arrays(region: IntArray, names: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Cell data that carry the labels and, as one indicator per region, their names in order."""
    result: dict[str, NDArray[np.generic]] = {"region": region}
    for number, name in enumerate(names):
        result[REGION_PREFIX + name] = (region == number).astype(np.int8)
    return result


def write_surface_series(
    path: Path | str, times: Sequence[float], states: Sequence[SurfaceFile]
) -> Path:
    """Write surfaces over time for ParaView and 3D Slicer, each with triangles and data of its own.

    The states ``NAME_0000.vtp``, ``NAME_0001.vtp``, ... lie beside the index ``NAME.pvd``, which is
    written last. They name their axes (LPS) as Slicer does.

    Raises
    ------
    InputError
        As many times as states, at least one, increasing; data of another number of rows.
    """
    index = Path(path)
    _check_suffix(index, (".pvd",))
    moments = np.asarray(times, dtype=np.float64)
    if len(states) != len(moments) or not len(states) or (np.diff(moments) <= 0).any():
        raise InputError(
            f"{index}: {len(states)} states and times {moments.tolist()}, expected as many, "
            "increasing, at least one"
        )
    names = [f"{index.stem}_{number:04d}.vtp" for number in range(len(states))]
    for name, state in zip(names, states, strict=True):
        target = index.with_name(name)
        _check_triangles(state.vertices, state.triangles, str(target))
        content = SurfaceFile(
            state.vertices,
            state.triangles,
            _checked_data(state.point_data, len(state.vertices), "point"),
            _checked_data(state.cell_data, len(state.triangles), "cell"),
        )
        write_atomically(target, partial(_write_vtp, data=content, space="LPS"))
    return _write_index(index, moments, names)


def _write_index(index: Path, times: FloatArray, names: Sequence[str]) -> Path:
    root = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(root, "Collection")
    for time, name in zip(times, names, strict=True):
        ET.SubElement(collection, "DataSet", timestep=repr(float(time)), file=name)
    tree = ET.ElementTree(root)
    write_atomically(index, lambda file: tree.write(file, xml_declaration=True, encoding="utf-8"))
    return index
