"""Surfaces of others with their regions: VTK, STL, OBJ, PLY, GLB; time series for ParaView.

A surface comes from one labelled file or from one file per region. Formats without labels (STL, PLY
without a ``region`` property, OBJ without groups) carry the regions through the files' names:
``{anterior: a.stl, posterior: p.stl}``. Coincident vertices of such files, of STL and GLB files as
a whole, and of OBJ files whose objects have vertices of their own, are merged and numbered in the
order in which the triangles name them, so that two files with the same triangles in the same order
correspond. A file appears under its name only once it is complete.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mvest.errors import GeometryError, InputError
from mvest.exchange.child import in_child
from mvest.exchange.mesh_files import polydata, read_cells, vtk_module
from mvest.files import write_atomically
from mvest.reading.text import MAX_NUMBER, one_line, refusing
from mvest.typing import FloatArray, IntArray

Data = Mapping[str, NDArray[np.generic]]
"""Named arrays with one row per point or cell."""

SURFACE_SUFFIXES = (".vtu", ".vtp", ".stl", ".obj", ".ply", ".vtk", ".glb")
"""That are read."""
REGION_PREFIX = "region."
MERGE_TOLERANCE = 1e-5
"""Vertices closer than this share of the bounding box's diagonal are one (0.5 µm on 50 mm)."""
MAX_TRIANGLES = 500_000
"""Of a surface; a case of two such frames is checked in 140 s with 1.2 GB, of 55 000 in 15 s."""
MAX_NEIGHBOURS = 100
"""Vertices that are one, on average; where triangles share none there are about six."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A triangulated surface, and what lies beside it in its file.

    Attributes
    ----------
    vertices
        ``(n, 3)`` in the unit of the file, all of them in their order; finite.
    triangles
        ``(m, 3)``, also those of strips and of polygons, which VTK cuts into triangles.
    point_data, cell_data
        Named arrays with n or m rows; empty for STL and OBJ.
    groups
        Name of the group of each triangle, or of its object (OBJ, GLB); empty without any.
    region
        ``(m,)`` index into the regions of a case; None where nothing labels them.
    segments
        ``(k, 2)`` points of the lines of a file, in the direction of each; None where vertices were
        merged or left out.
    others
        How many cells there are of each other type, by its name in VTK ("tetra", "wedge");
        vertices by themselves are left out.
    space
        "LPS" or "RAS", as 3D Slicer names the axes in a title, a comment or the field data; None
        where nothing names them.
    """

    vertices: FloatArray
    triangles: IntArray
    point_data: Data = field(default_factory=dict)
    cell_data: Data = field(default_factory=dict)
    groups: Sequence[str] = ()
    region: IntArray | None = None
    segments: IntArray | None = None
    others: Mapping[str, int] = field(default_factory=dict)
    space: str | None = None


def read_mesh(path: Path | str) -> Surface:
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
    found = Surface(**in_child(read_cells, source, source.suffix.lower()))
    bad = np.flatnonzero(~(np.abs(found.vertices) <= MAX_NUMBER).all(axis=1))
    if len(bad):
        raise GeometryError(
            f"{source}: points {bad[:5].tolist()} are not finite numbers of at most {MAX_NUMBER:g}"
        )
    return found


def read_surface(path: Path | str) -> Surface:
    """Read a triangulated surface with its data; lines and single vertices beside it do not matter.

    Whether it is closed or manifold is not checked here; see `mvest.valve.geometry.surface_checks`.

    Raises
    ------
    InputError, GeometryError
        As `read_mesh`, no triangles, or cells of other types beside them.
    """
    found = read_mesh(path)
    if found.others:
        raise GeometryError(
            f"{path}: holds cells of type {', '.join(found.others)}; expected triangles only"
        )
    if not len(found.triangles):
        raise GeometryError(f"{path}: no triangles; expected a triangulated surface")
    return found


def read_regions(files: Path | Mapping[str, Path], regions: Mapping[int, str]) -> Surface:
    """Read a surface and which region each of its triangles belongs to.

    Labels are looked for, in this order, in the file names (one file for each region), in the cell
    data ``region``, in the point data ``region`` (a triangle belongs to the region of at least two
    of its corners), and in the names of groups or objects (OBJ, GLB). With one region there is
    nothing to label.

    Parameters
    ----------
    files
        One file, or one for each name of a region.
    regions
        Name of every label, in order.

    Raises
    ------
    InputError, GeometryError
        A missing, damaged or empty file, unknown or missing labels, a region without triangles.
    """
    if isinstance(files, Path):
        with refusing(files, "surface"):
            return _labelled(_not_too_large(files), regions, files.suffix.lower())
    return _labelled(_joined(files, list(regions.values())), regions)


def _labelled(whole: Surface, regions: Mapping[int, str], suffix: str = "") -> Surface:
    """The surface with its labels; ``suffix`` is empty where it comes from several files."""
    surface = replace(whole, region=_labels(whole, regions))
    if suffix in ("", ".stl", ".glb") or (suffix == ".obj" and _apart(surface)):
        surface = merged(surface)
    if surface.region is not None:
        empty = [name for k, name in enumerate(regions.values()) if k not in surface.region]
        if empty:
            raise GeometryError(f"no triangle belongs to the region {', '.join(empty)}")
    return surface


def _not_too_large(file: Path) -> Surface:
    surface = read_surface(file)
    if len(surface.triangles) > MAX_TRIANGLES:
        raise GeometryError(
            f"{file}: {len(surface.triangles)} triangles, expected at most {MAX_TRIANGLES}; make "
            "them larger, or take one of several parts"
        )
    return surface


def part_of(surface: Surface, name: str) -> Surface:
    """The triangles of one group or object, and the vertices that these have.

    Raises
    ------
    InputError
        There is no such one; the message lists some that there are.
    """
    own = np.array([group == name for group in surface.groups], dtype=np.bool_)
    if not own.any():
        known = one_line(", ".join(sorted(set(surface.groups))[:20]) or "none", 500)
        raise InputError(f"no part is called {one_line(name, 80)}; there are {known}")
    used, triangles = np.unique(surface.triangles[own], return_inverse=True)
    return Surface(
        surface.vertices[used],
        triangles.reshape(-1, 3).astype(np.int64),
        {key: values[used] for key, values in surface.point_data.items()},
        {key: values[own] for key, values in surface.cell_data.items()},
        (name,) * int(own.sum()),
    )


def _apart(surface: Surface) -> bool:
    """Whether there are several regions of which no two share a vertex."""
    if surface.region is None or len(np.unique(surface.region)) < 2:
        return False
    corners = np.column_stack([surface.triangles.ravel(), np.repeat(surface.region, 3)])
    return len(np.unique(corners, axis=0)) == len(np.unique(surface.triangles))


def _joined(files: Mapping[str, Path], names: list[str]) -> Surface:
    """The surfaces of several files as one; their regions are its groups."""
    unknown = [name for name in files if name not in names]
    if unknown:
        raise InputError(f"a file for the region {unknown[0]!r}; known are {', '.join(names)}")
    missing = [name for name in names if name not in files]
    if missing:
        raise InputError(f"no file for the region {', '.join(missing)}; expected one for each")
    parts = [_not_too_large(files[name]) for name in names]
    shared = set.intersection(*(set(part.point_data) for part in parts))
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + s for part, s in zip(parts, start, strict=False)]),
        {name: np.concatenate([part.point_data[name] for part in parts]) for name in shared},
        groups=np.repeat(names, [len(part.triangles) for part in parts]).tolist(),
    )


def merged(surface: Surface) -> Surface:
    """The surface with coincident vertices made one, numbered as the triangles name them."""
    n = len(surface.vertices)
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    tree, near = cKDTree(surface.vertices), MERGE_TOLERANCE * diagonal
    # Counted before they are listed, as a few points far away make all others near each other.
    if tree.count_neighbors(tree, near) > MAX_NEIGHBOURS * n:
        raise GeometryError(
            f"vertices lie within {near:.2g} of each other, {MERGE_TOLERANCE:g} of the surface's "
            "diagonal; are some far away?"
        )
    pairs = tree.query_pairs(near, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), pairs.T), shape=(n, n))
    _, group = connected_components(graph, directed=False)
    corners = group[surface.triangles.ravel()]
    _, first, inverse = np.unique(corners, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    keep = surface.triangles.ravel()[np.sort(first)]
    return replace(
        surface,
        vertices=surface.vertices[keep],
        triangles=rank[inverse].reshape(-1, 3),
        point_data={name: values[keep] for name, values in surface.point_data.items()},
        segments=None,
    )


def _labels(surface: Surface, regions: Mapping[int, str]) -> IntArray | None:
    """Index ``(m,)`` into the regions of each triangle."""
    known = {float(label): f"{label} ({name})" for label, name in regions.items()}
    if "region" in surface.cell_data:
        return _indices(surface.cell_data["region"], known, "triangles", "cell data region")
    if "region" in surface.point_data:
        at_point = _indices(surface.point_data["region"], known, "vertices", "point data region")
        ordered = np.sort(at_point[surface.triangles], axis=1)
        torn = np.flatnonzero((np.diff(ordered, axis=1) > 0).all(axis=1))
        if len(torn):
            raise InputError(
                f"triangles {torn[:5].tolist()} have corners in three regions; give the region as "
                "cell data"
            )
        # The middle one of three sorted labels is the one that occurs at least twice.
        return ordered[:, 1]
    groups, names = np.array(surface.groups), {name: name for name in regions.values()}
    if len(set(groups)) > 1 or (len(groups) and groups[0] in names):
        return _indices(groups, names, "triangles", "groups")
    return np.zeros(len(surface.triangles), dtype=np.int64) if len(regions) == 1 else None


def _indices(
    labels: NDArray[np.generic], known: Mapping[Any, str], what: str, where: str
) -> IntArray:
    """Labels as indices into those that are known, by which words an error lists them."""
    if labels.ndim != 1:
        raise InputError(f"{where} has {labels.shape[1]} components, expected one label")
    found, inverse = np.unique(labels, return_inverse=True)
    place = {label: k for k, label in enumerate(known)}
    result = np.array([place.get(label, -1) for label in found.tolist()])[inverse]
    bad = np.flatnonzero(result < 0)
    if len(bad):
        odd = [k if isinstance(k, str) else f"{k:g}" for k in found[np.unique(inverse[bad])]]
        raise InputError(
            f"{where}: unknown label {one_line(', '.join(odd[:5]), 80)} at {what} "
            f"{bad[:5].tolist()}{f' and {len(bad) - 5} more' if len(bad) > 5 else ''}; known are "
            f"{', '.join(known.values())}"
        )
    return result


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
    """Write a triangulated surface as a ``.vtp`` file.

    ``space`` ("LPS") names the axes where 3D Slicer finds it.

    Raises
    ------
    InputError, GeometryError
        Another extension, no triangles, points that are not finite, data of another number of rows,
        or a file that cannot be written.
    """
    target = Path(path)
    _check_suffix(target, (".vtp",))
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
    surface = polydata(points, faces.ravel(), np.full(len(faces), 3), *data)
    return write_atomically(target, lambda file: _write_vtp(file, surface, space))


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
    path: Path | str, times: Sequence[float], states: Sequence[Surface]
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
