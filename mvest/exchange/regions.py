"""One frame's surface with its regions, from one labelled file or from one file per region.

Formats without labels (STL, PLY without a ``region`` property, OBJ without groups) carry the
regions through the files' names: ``{anterior: a.stl, posterior: p.stl}``. Coincident vertices of
such files, of STL and GLB files as a whole, and of OBJ files whose objects have vertices of their
own, are merged and numbered in the order in which the triangles name them, so that two files with
the same triangles in the same order correspond.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mvest.errors import GeometryError, InputError
from mvest.exchange.surfaces import SurfaceFile, read_surface
from mvest.reading.text import one_line, refusing
from mvest.typing import FloatArray, IntArray

MERGE_TOLERANCE = 1e-5
"""Vertices closer than this share of the bounding box's diagonal are one (0.5 µm on 50 mm)."""
MAX_TRIANGLES = 500_000
"""Of a surface; a case of two such frames is checked in 140 s with 1.2 GB, of 55 000 in 15 s."""
MAX_NEIGHBOURS = 100
"""Vertices that are one, on average; where triangles share none there are about six."""


@dataclass(frozen=True, slots=True, eq=False)
class RegionSurface:
    """A surface as read, its triangles labelled.

    Attributes
    ----------
    vertices
        ``(n, 3)`` in the unit of the file.
    triangles
        ``(m, 3)``.
    region
        ``(m,)`` index into the regions of the case, or None where the file has no labels.
    point_data
        Named arrays with n rows.
    """

    vertices: FloatArray
    triangles: IntArray
    region: IntArray | None
    point_data: Mapping[str, NDArray[np.generic]]


def read_regions(
    files: Path | Mapping[str, Path],
    regions: Mapping[int, str],
    part: str | None = None,
) -> RegionSurface:
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
    part
        Of each file no more than the group or object of this name.

    Raises
    ------
    InputError, GeometryError
        A missing, damaged or empty file, unknown or missing labels, a region without triangles.
    """
    if isinstance(files, Path):
        with refusing(files, "surface"):
            return _labelled(_read(files, part), regions, files.suffix.lower())
    return _labelled(_joined(files, list(regions.values()), part), regions)


def _labelled(whole: SurfaceFile, regions: Mapping[int, str], suffix: str = "") -> RegionSurface:
    """The surface with its labels; ``suffix`` is empty where it comes from several files."""
    label = _labels(whole, regions)
    surface = RegionSurface(whole.vertices, whole.triangles, label, whole.point_data)
    if suffix in ("", ".stl", ".glb") or (suffix == ".obj" and _apart(surface)):
        surface = merged(surface)
    if label is not None:
        empty = [name for k, name in enumerate(regions.values()) if not (label == k).any()]
        if empty:
            raise GeometryError(f"no triangle belongs to the region {', '.join(empty)}")
    return surface


def _read(file: Path, part: str | None) -> SurfaceFile:
    surface = read_surface(file)
    if part is not None:
        surface = part_of(surface, part)
    if len(surface.triangles) > MAX_TRIANGLES:
        raise GeometryError(
            f"{file}: {len(surface.triangles)} triangles, expected at most {MAX_TRIANGLES}; make "
            "them larger, or take one of several parts"
        )
    return surface


def part_of(surface: SurfaceFile, name: str) -> SurfaceFile:
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
    return SurfaceFile(
        surface.vertices[used],
        triangles.reshape(-1, 3).astype(np.int64),
        {key: values[used] for key, values in surface.point_data.items()},
        {key: values[own] for key, values in surface.cell_data.items()},
        (name,) * int(own.sum()),
    )


def _apart(surface: RegionSurface) -> bool:
    """Whether there are several regions of which no two share a vertex."""
    if surface.region is None or len(np.unique(surface.region)) < 2:
        return False
    corners = np.column_stack([surface.triangles.ravel(), np.repeat(surface.region, 3)])
    return len(np.unique(corners, axis=0)) == len(np.unique(surface.triangles))


def _joined(files: Mapping[str, Path], names: list[str], part: str | None) -> SurfaceFile:
    """The surfaces of several files as one; their regions are its groups."""
    unknown = [name for name in files if name not in names]
    if unknown:
        raise InputError(f"a file for the region {unknown[0]!r}; known are {', '.join(names)}")
    missing = [name for name in names if name not in files]
    if missing:
        raise InputError(f"no file for the region {', '.join(missing)}; expected one for each")
    parts = [_read(files[name], part) for name in names]
    shared = set.intersection(*(set(part.point_data) for part in parts))
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return SurfaceFile(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + s for part, s in zip(parts, start, strict=False)]),
        {name: np.concatenate([part.point_data[name] for part in parts]) for name in shared},
        groups=np.repeat(names, [len(part.triangles) for part in parts]).tolist(),
    )


def merged(surface: RegionSurface) -> RegionSurface:
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
    return RegionSurface(
        surface.vertices[keep],
        rank[inverse].reshape(-1, 3),
        surface.region,
        {name: values[keep] for name, values in surface.point_data.items()},
    )


def _labels(surface: SurfaceFile, regions: Mapping[int, str]) -> IntArray | None:
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
