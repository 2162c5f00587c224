"""Surfaces with regions: reads VTK, STL, OBJ, PLY and GLB, writes VTP and time series.

A surface comes from one labelled file or from one or several files per region. STL, OBJ and PLY
have no labels: ``{anterior: a.stl, posterior: [p1.stl, p2.stl, p3.stl]}``. Coincident vertices are
merged in surfaces from several files, and in STL, OBJ and GLB files. Merged vertices are numbered
in triangle order, so that two files with the same triangles in the same order correspond.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvest.errors import GeometryError, InputError
from mvest.exchange.child import in_child
from mvest.exchange.mesh_files import READERS, polydata, read_cells, vtk_module
from mvest.files import write_atomically
from mvest.reading.text import MAX_NUMBER, one_line, refusing
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import connected_pieces

Data = Mapping[str, NDArray[np.generic]]
"""Named arrays with one row per point or cell."""
SURFACE_SUFFIXES = tuple(READERS)
MERGE_TOLERANCE = 1e-5
"""Merge distance relative to the bounding box diagonal (0.5 µm on 50 mm)."""
MAX_TRIANGLES = 500_000
"""Checking a case of two frames of this size takes 140 s and 1.2 GB; 55 000 triangles take 15 s."""
MAX_NEIGHBOURS = 100
"""Largest mean number of vertices merged into one; about six if triangles share no vertices."""
NAME_THEM = "name them anterior and posterior (also in place of AML, PML or Anterior)"


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A triangulated surface with the data of its file."""

    vertices: FloatArray  #: ``(n, 3)`` in the unit of the file; finite
    triangles: IntArray  #: ``(m, 3)``; polygons are split
    #: named arrays with n or m rows
    point_data: Data = field(default_factory=dict)
    cell_data: Data = field(default_factory=dict)
    groups: Sequence[str] = ()  #: object name of each triangle (GLB); empty if there are none
    region: IntArray | None = None  #: ``(m,)`` index into the case's regions; None without labels
    #: number of cells of each other type, by VTK name ("tetra", "wedge"); single vertices are not
    #: counted
    others: Mapping[str, int] = field(default_factory=dict)
    #: "LPS" or "RAS" if 3D Slicer named the axes in a title, comment or field data; else None
    space: str | None = None
    #: ``(k, 2)`` ends of the line segments of the file
    lines: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))


def read_mesh(path: Path | str) -> Surface:
    """Read the points, triangles and lines of a file.

    InputError if the file is missing or damaged, or its suffix is not one of `SURFACE_SUFFIXES`.
    GeometryError if points are not finite or beyond `MAX_NUMBER`, or cells name points that do not
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
    """Read a triangulated surface with its data; lines and single vertices are ignored.

    `mvest.valve.geometry.surface_checks` checks whether it is closed or manifold.

    InputError or GeometryError as `read_mesh`; or there are no triangles, or there are cells of
    other types.
    """
    found = read_mesh(path)
    if found.others:
        raise GeometryError(
            f"{path}: holds cells of type {', '.join(found.others)}; expected triangles only"
        )
    if not len(found.triangles):
        raise GeometryError(f"{path}: no triangles; expected a triangulated surface")
    return found


def read_regions(
    files: Path | Mapping[str, Sequence[Path]], regions: Mapping[int | str, str]
) -> Surface:
    """Read a surface and the region of each triangle.

    Labels come from the first of these that exists: the keys of ``files``, the cell data
    ``region``, the point data ``region`` (a triangle takes the label that two corners share), the
    object names (GLB). A single region needs no labels.

    InputError or GeometryError if a file is missing or damaged, labels are missing or unknown, or a
    region has no triangles.

    Parameters
    ----------
    files
        One file, or the files of each region name.
    regions
        Region of every number in the data, or of every object name; several may share a region.
        The regions are numbered in the order of their first label.
    """
    if isinstance(files, Path):
        with refusing(files, "surface"):
            return _labelled(_not_too_large(files), regions, files.suffix.lower())
    names = list(dict.fromkeys(regions.values()))
    if unknown := [name for name in files if name not in names]:
        raise InputError(
            f"a file for the region {unknown[0]!r}; known are {', '.join(names)}; {NAME_THEM}"
        )
    if missing := [name for name in names if name not in files]:
        raise InputError(f"no file for the region {', '.join(missing)}; expected one for each")
    parts = [_not_too_large(file) for name in names for file in files[name]]
    of_part = [name for name in names for _ in files[name]]
    shared = set.intersection(*(set(part.point_data) for part in parts))
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    whole = Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + s for part, s in zip(parts, start, strict=False)]),
        {name: np.concatenate([part.point_data[name] for part in parts]) for name in shared},
        groups=np.repeat(of_part, [len(part.triangles) for part in parts]).tolist(),
    )
    return _labelled(whole, regions, ".stl")


def _not_too_large(file: Path) -> Surface:
    surface = read_surface(file)
    if len(surface.triangles) > MAX_TRIANGLES:
        raise GeometryError(
            f"{file}: {len(surface.triangles)} triangles, expected at most {MAX_TRIANGLES}; make "
            "them larger, or take one of several parts"
        )
    return surface


def _labelled(whole: Surface, regions: Mapping[int | str, str], suffix: str) -> Surface:
    names = list(dict.fromkeys(regions.values()))
    region = _labels(whole, regions, names)
    if region is not None:
        empty = [name for k, name in enumerate(names) if k not in region]
        if empty:
            raise GeometryError(f"no triangle belongs to the region {', '.join(empty)}")
    surface = replace(whole, region=region)
    return merged(surface) if suffix in (".stl", ".obj", ".glb") else surface


def merged(surface: Surface) -> Surface:
    """The surface with coincident vertices merged, numbered in the order of the triangles."""
    n = len(surface.vertices)
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    tree, near = cKDTree(surface.vertices), MERGE_TOLERANCE * diagonal
    # A far outlier makes all other vertices coincident, and listing the pairs takes much memory.
    if tree.count_neighbors(tree, near) > MAX_NEIGHBOURS * n:
        raise GeometryError(
            f"vertices lie within {near:.2g} of each other, {MERGE_TOLERANCE:g} of the surface's "
            "diagonal; are some far away?"
        )
    pairs = tree.query_pairs(near, output_type="ndarray")
    _, group = connected_pieces(pairs, n)
    corners = group[surface.triangles.ravel()]
    _, first, inverse = np.unique(corners, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    keep = surface.triangles.ravel()[np.sort(first)]
    return replace(
        surface,
        vertices=surface.vertices[keep],
        triangles=rank[inverse].reshape(-1, 3),
        lines=surface.lines[:0],
        point_data={name: values[keep] for name, values in surface.point_data.items()},
    )


def _labels(
    surface: Surface, regions: Mapping[int | str, str], names: list[str]
) -> IntArray | None:
    """Index ``(m,)`` of each triangle into the names of the regions."""
    label_of = {label: (names.index(name), f"{label} ({name})") for label, name in regions.items()}
    known = {float(label): own for label, own in label_of.items() if isinstance(label, int)}
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
        # The middle one of three sorted labels occurs at least twice.
        return ordered[:, 1]
    objects = {name: (k, name) for k, name in enumerate(names)}
    objects |= {label: own for label, own in label_of.items() if isinstance(label, str)}
    groups = np.array(surface.groups)
    if len(set(groups)) > 1 or (len(groups) and groups[0] in objects):
        return _indices(groups, objects, "triangles", "groups")
    return np.zeros(len(surface.triangles), dtype=np.int64) if len(names) == 1 else None


def _indices(
    labels: NDArray[np.generic], known: Mapping[Any, tuple[int, str]], what: str, where: str
) -> IntArray:
    """Labels as the numbers of their regions; ``known`` also has a label's words in an error."""
    if labels.ndim != 1:
        raise InputError(f"{where} has {labels.shape[1]} components, expected one label")
    found, inverse = np.unique(labels, return_inverse=True)
    numbers = [known.get(label, (-1, ""))[0] for label in found.tolist()]
    result = np.array(numbers)[inverse]
    if len(bad := np.flatnonzero(result < 0)):
        odd = [k if isinstance(k, str) else f"{k:g}" for k in found[np.unique(inverse[bad])]]
        more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
        raise InputError(
            f"{where}: unknown label {one_line(', '.join(odd[:5]), 80)} at {what} "
            f"{bad[:5].tolist()}{more}; known are {', '.join(words for _, words in known.values())}"
            + (f"; {NAME_THEM}" if where == "groups" else "")
        )
    return result


def _check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: extension {path.suffix!r}, expected {', '.join(suffixes)}")


def write_surface(path: Path | str, surface: Surface) -> Path:
    """Write points, triangles, their data, and the name of the axes as a ``.vtp`` file.

    InputError or GeometryError if the suffix differs, a point is not finite, or the file cannot be
    written.
    """
    target = Path(path)
    _check_suffix(target, (".vtp",))
    points = np.ascontiguousarray(surface.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(surface.triangles, dtype=np.int64)
    if not np.isfinite(points).all():
        raise GeometryError(f"{target}: points that are not finite numbers")
    data = [
        {name: np.ascontiguousarray(v, np.int8 if v.dtype == bool else None) for name, v in given}
        for given in (surface.point_data.items(), surface.cell_data.items())
    ]
    written = polydata(points, faces.ravel(), np.full(len(faces), 3), *data)
    if surface.space:
        words = vtk_module("vtkCommonCore").vtkStringArray()
        words.SetName("SPACE")
        words.InsertNextValue(surface.space)
        written.GetFieldData().AddArray(words)

    def write(file: Path) -> None:
        writer = vtk_module("vtkIOXML").vtkXMLPolyDataWriter()
        writer.SetFileName(str(file))
        writer.SetInputData(written)
        writer.SetDataModeToBinary()
        if not writer.Write():
            raise OSError(f"VTK's error {writer.GetErrorCode()}")

    return write_atomically(target, write)


def region_arrays(region: IntArray, names: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Cell data: the labels, and one indicator array per region, named after it."""
    result: dict[str, NDArray[np.generic]] = {"region": region}
    for number, name in enumerate(names):
        result[f"region.{name}"] = (region == number).astype(np.int8)
    return result


def write_surface_series(
    path: Path | str, times: Sequence[float], states: Sequence[Surface]
) -> Path:
    """Write surfaces over time (LPS) for ParaView and 3D Slicer.

    The states ``NAME_0000.vtp``, ``NAME_0001.vtp``, ... are written next to the index ``NAME.pvd``.

    Raises as `write_surface`.
    """
    index = Path(path)
    _check_suffix(index, (".pvd",))
    root = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(root, "Collection")
    for number, (time, state) in enumerate(zip(map(float, times), states, strict=True)):
        file = index.with_name(f"{index.stem}_{number:04d}.vtp")
        write_surface(file, replace(state, space="LPS"))
        ET.SubElement(collection, "DataSet", timestep=repr(time), file=file.name)
    return write_atomically(index, ET.tostring(root, encoding="utf-8", xml_declaration=True))
