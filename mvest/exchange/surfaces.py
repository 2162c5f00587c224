"""Surfaces and meshes of others: VTK, STL, OBJ, PLY, GLB; time series for ParaView.

Coordinates are mm. A file appears under its name only once it is complete.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import GeometryError, InputError
from mvest.exchange.child import in_child
from mvest.exchange.mesh_files import polydata, read_cells, vtk_module
from mvest.files import write_atomically
from mvest.reading.text import MAX_NUMBER
from mvest.typing import FloatArray, IntArray

Data = Mapping[str, NDArray[np.generic]]
"""Named arrays with one row per point or cell."""

WRITTEN_SUFFIXES = (".vtu", ".vtp", ".stl", ".obj", ".ply")
SURFACE_SUFFIXES = (*WRITTEN_SUFFIXES, ".vtk", ".glb")
"""That are read."""
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
    groups: Sequence[str] = ()


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
    lines: Sequence[IntArray]
    others: Mapping[str, int]
    point_data: Data
    cell_data: Data
    field_data: Mapping[str, Any]
    space: str | None
    groups: Sequence[str]


def read_mesh(path: Path | str) -> Mesh:
    """Read the points, triangles and lines of a file, in the child.

    Raises
    ------
    InputError
        Missing or damaged file, or an extension other than ``.vtu``, ``.vtp``, ``.vtk`` (legacy),
        ``.stl``, ``.obj``, ``.ply``, ``.glb``.
    GeometryError
        Points that are not finite or beyond `MAX_NUMBER`, or cells that name points that do not
        exist.
    """
    source = Path(path)
    _check_suffix(source, SURFACE_SUFFIXES)
    found = in_child(read_cells, source, source.suffix.lower())
    bad = np.flatnonzero(~(np.abs(found["points"]) <= MAX_NUMBER).all(axis=1))
    if len(bad):
        raise GeometryError(
            f"{source}: points {bad[:5].tolist()} are not finite numbers of at most {MAX_NUMBER:g}"
        )
    return Mesh(**found)


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


def write_surface(
    path: Path | str,
    vertices: FloatArray,
    triangles: IntArray,
    point_data: Data | None = None,
    cell_data: Data | None = None,
    space: str = "",
) -> Path:
    """Write a triangulated surface; the extension chooses the format.

    ``space`` ("LPS") names the axes of a ``.vtp`` file, where 3D Slicer finds it.

    Raises
    ------
    InputError, GeometryError
        Unknown extension, no triangles, points that are not finite, data of another number of rows
        or for a format that holds none here (STL, OBJ, PLY), or a file that cannot be written.
    """
    target = Path(path)
    _check_suffix(target, WRITTEN_SUFFIXES)
    points = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(triangles, dtype=np.int64)
    if not np.isfinite(points).all():
        raise GeometryError(f"{target}: points that are not finite numbers")
    if points.shape[1:] != (3,) or faces.shape[1:] != (3,) or not len(faces):
        raise InputError(f"{target}: {points.shape} and {faces.shape}, expected (n, 3) and (m, 3)")
    if faces.min() < 0 or faces.max() >= len(points):
        raise InputError(f"{target}: triangles name points outside 0 to {len(points) - 1}")
    data = [
        {name: np.ascontiguousarray(v, np.int8 if v.dtype == bool else None) for name, v in given}
        for given in ((point_data or {}).items(), (cell_data or {}).items())
    ]
    for arrays, rows in zip(data, (len(points), len(faces)), strict=True):
        for name, values in arrays.items():
            if len(values) != rows or values.dtype.kind not in "iuf":
                raise InputError(
                    f"{target}: data {name!r} of shape {values.shape} and type {values.dtype}, "
                    f"expected {rows} rows of numbers"
                )
    if target.suffix.lower() == ".vtp":
        surface = polydata(points, faces.ravel(), np.full(len(faces), 3), *data)
        return write_atomically(target, lambda file: _write_vtp(file, surface, space))
    if any(data) and target.suffix.lower() != ".vtu":
        raise InputError(f"{target}: {target.suffix[1:].upper()} holds no data; write .vtu or .vtp")
    import meshio

    # PLY knows no 64-bit integers.
    cells = [("triangle", faces.astype(np.int32))]
    mesh = meshio.Mesh(points, cells, data[0], {name: [v] for name, v in data[1].items()})
    return write_atomically(target, lambda file: mesh.write(file))


def _write_vtp(path: Path, surface: Any, space: str) -> None:
    if space:
        words = vtk_module("vtkCommonCore").vtkStringArray()
        words.SetName("SPACE")
        words.InsertNextValue(space)
        surface.GetFieldData().AddArray(words)
    writer = vtk_module("vtkIOXML").vtkXMLPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(surface)
    writer.SetDataModeToBinary()
    if not writer.Write():
        raise OSError(f"VTK's error {writer.GetErrorCode()}")


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
    root = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(root, "Collection")
    for number, (time, state) in enumerate(zip(moments.tolist(), states, strict=True)):
        file = index.with_name(f"{index.stem}_{number:04d}.vtp")
        data = (state.point_data, state.cell_data)
        write_surface(file, state.vertices, state.triangles, *data, space="LPS")
        ET.SubElement(collection, "DataSet", timestep=repr(time), file=file.name)
    return write_atomically(index, ET.tostring(root, encoding="utf-8", xml_declaration=True))
