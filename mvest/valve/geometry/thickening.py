"""Thickens a midsurface to the closed surface of its leaflets."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface, vertex_normals
from mvest.valve.geometry.surface_checks import check_surface, listed
from mvest.valve.geometry.triangles import (
    area_vectors,
    area_vectors_change,
    edge_table,
    surface_edges,
)

FACE_KINDS = ("ventricular", "atrial", "rim")
"""Kinds of triangles of a thickened leaflet."""


def smooth_vertex_normals(
    vertices: FloatArray, triangles: IntArray, iterations: int = 10
) -> FloatArray:
    """Unit normals ``(n, 3)`` after Laplacian smoothing over neighbouring vertices.

    Each iteration averages a normal with the mean of its neighbours' normals, and normalises it.
    Thickening along raw normals would make triangles cross at sharp bends, such as the commissures.

    GeometryError if a vertex has no triangle, or opposite normals cancel.
    """
    return smooth_normals_change(vertices, triangles, iterations, np.zeros((*vertices.shape, 0)))[0]


def smooth_normals_change(
    vertices: FloatArray, triangles: IntArray, iterations: int, moves: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`smooth_vertex_normals`, and their change ``(n, 3, q)`` by displacements ``(n, 3, q)`` mm."""
    n = len(vertices)
    unused = np.setdiff1d(np.arange(n), triangles)
    if len(unused):
        raise GeometryError(f"normals: vertices {listed(unused)} belong to no triangle")
    edges = surface_edges(np.asarray(triangles))
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    adjacency = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    at, faces = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    normals = vertex_normals(at, faces)
    change = _normals_change(at, faces, normals, moves)
    for _ in range(iterations):
        mean = 0.5 * (normals + (adjacency @ normals) / degree[:, None])
        length = np.linalg.norm(mean, axis=1)
        bad = np.flatnonzero(~(length > 1e-6))
        if len(bad):
            raise GeometryError(f"normals: those round vertices {listed(bad)} cancel each other")
        normals = mean / length[:, None]
        by_neighbours = (adjacency @ change.reshape(n, -1)).reshape(change.shape)
        change = 0.5 * (change + by_neighbours / degree[:, None, None])
        change = _across(normals, change) / length[:, None, None]
    return normals, change


def _normals_change(
    vertices: FloatArray, triangles: IntArray, normals: FloatArray, moves: FloatArray
) -> FloatArray:
    """Change ``(n, 3, q)`` of area-weighted unit normals."""
    along = area_vectors(vertices, triangles)
    change = area_vectors_change(vertices, triangles, moves)
    out, length = np.zeros(moves.shape), np.zeros(len(vertices))
    for own in triangles.T:
        np.add.at(out, own, change)
        np.add.at(length, own, np.sum(along * normals[own], axis=1))
    return _across(normals, out) / length[:, None, None]


def _across(normals: FloatArray, change: FloatArray) -> FloatArray:
    """The component of ``(n, 3, q)`` perpendicular to unit normals ``(n, 3)``."""
    along = np.einsum("ni,niq->nq", normals, change)
    return np.asarray(change - normals[:, :, None] * along[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class ClosedSurface:
    """Outer surface of thickened leaflets, with outward normals.

    GeometryError if the surface is not closed, manifold, outward and free of self-intersections.
    """

    vertices: FloatArray  #: (n, 3) mm
    triangles: IntArray  #: (m, 3)
    region: IntArray  #: (m,), leaflet of each triangle
    kind: IntArray  #: (m,), index into `FACE_KINDS`

    def __post_init__(self) -> None:
        check_surface(self.vertices, self.triangles, closed=True, name="closed surface")


def thicken(surface: LeafletSurface, normals: FloatArray | None = None) -> ClosedSurface:
    """Close a midsurface: offset both sides by half the thickness and stitch the rim.

    Vertex ``i`` of the midsurface becomes the vertices ``i`` (ventricular side, along the normal)
    and ``i + n`` (atrial side). Every boundary edge gives two rim triangles.

    GeometryError if the midsurface is invalid, or the thickened surface intersects itself (the
    thickness exceeds the radius of curvature).

    Parameters
    ----------
    surface
        Midsurface with thickness; normals towards the ventricle.
    normals
        ``(n, 3)`` unit offset directions; default `smooth_vertex_normals`.
    """
    check_surface(surface.vertices, surface.triangles, name="midsurface")
    if normals is None:
        normals = smooth_vertex_normals(surface.vertices, surface.triangles)
    n = len(surface.vertices)
    offset = 0.5 * surface.thickness[:, None] * normals
    half, _, inverse, count = edge_table(surface.triangles)
    boundary = np.flatnonzero(count[inverse] == 1)
    a, b = half[boundary].T
    rim = np.concatenate([np.column_stack([b, a, a + n]), np.column_stack([b, a + n, b + n])])
    m = len(surface.triangles)
    return ClosedSurface(
        vertices=np.concatenate([surface.vertices + offset, surface.vertices - offset]),
        triangles=np.concatenate([surface.triangles, surface.triangles[:, ::-1] + n, rim]),
        region=np.concatenate(
            [surface.region, surface.region, np.tile(surface.region[boundary // 3], 2)]
        ),
        kind=np.repeat(np.arange(3), [m, m, len(rim)]),
    )
