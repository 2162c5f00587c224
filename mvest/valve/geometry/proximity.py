"""Closest points and intersections of points and triangulated surfaces.

Everything here is exact geometry on plain arrays: vertices ``(n, 3)`` in mm and triangles
``(m, 3)`` of vertex numbers. The closest point of a triangle follows Ericson, *Real-Time
Collision Detection* (2005), section 5.1.5 (Voronoi regions of the triangle's features).
"""

from dataclasses import dataclass
from itertools import chain

import ipctk
import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import directed_edges, surface_edges

SAMPLED_EDGES = 100
"""Number of edges sampled to estimate the number of overlapping boxes."""
Vector = tuple[float, float, float]
"""A point or vector in compiled code, where small arrays would be slow."""


@njit(cache=True)
def row(points: FloatArray, i: int) -> Vector:
    """``points[i]`` of ``(n, 3)`` as three numbers."""
    return points[i, 0], points[i, 1], points[i, 2]


@njit(cache=True)
def minus(a: Vector, b: Vector) -> Vector:
    """The difference ``a - b``."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def dot(a: Vector, b: Vector) -> float:
    """The scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@njit(cache=True)
def closest_on_triangle(p: Vector, a: Vector, b: Vector, c: Vector) -> Vector:
    """Barycentric coordinates ``(u, v, w)`` of the point of triangle ``abc`` closest to `p`."""
    ab = minus(b, a)
    ac = minus(c, a)
    ap = minus(p, a)
    d1 = dot(ab, ap)
    d2 = dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    bp = minus(p, b)
    d3 = dot(ab, bp)
    d4 = dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return 1.0 - v, v, 0.0
    cp = minus(p, c)
    d5 = dot(ab, cp)
    d6 = dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return 1.0 - w, 0.0, w
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - w, w
    total = va + vb + vc
    v = vb / total
    w = vc / total
    return 1.0 - v - w, v, w


@njit(cache=True)
def _closest_of_candidates(
    points: FloatArray,
    vertices: FloatArray,
    triangles: IntArray,
    offsets: IntArray,
    candidates: IntArray,
    distance: FloatArray,
    triangle: IntArray,
    barycentric: FloatArray,
) -> None:
    for i in range(points.shape[0]):
        p = row(points, i)
        for k in range(offsets[i], offsets[i + 1]):
            t = triangles[candidates[k]]
            a, b, c = row(vertices, t[0]), row(vertices, t[1]), row(vertices, t[2])
            u, v, w = closest_on_triangle(p, a, b, c)
            squared = 0.0
            for axis in range(3):
                squared += (p[axis] - (u * a[axis] + v * b[axis] + w * c[axis])) ** 2
            d = np.sqrt(squared)
            if d < distance[i]:
                distance[i] = d
                triangle[i] = candidates[k]
                barycentric[i, 0] = u
                barycentric[i, 1] = v
                barycentric[i, 2] = w


@dataclass(frozen=True, slots=True)
class ClosestPoints:
    """Closest points of a triangulated surface to some points.

    ``distance (n,)`` mm, ``triangle (n,)`` containing each closest point, and its ``barycentric
    (n, 3)`` coordinates there.
    """

    distance: FloatArray
    triangle: IntArray
    barycentric: FloatArray

    def interpolate(self, values: FloatArray, triangles: IntArray) -> FloatArray:
        """Interpolate vertex `values` ``(n_vertices, ...)`` at the closest points."""
        corners = values[triangles[self.triangle]]
        return np.einsum("ij,ij...->i...", self.barycentric, corners)


def closest_points(points: FloatArray, vertices: FloatArray, triangles: IntArray) -> ClosestPoints:
    """Find the exact closest point of a surface to each of `points`.

    A tree of triangle centroids bounds the search: given a candidate at the distance ``d`` and the
    largest distance ``R`` from a centroid to its corners, the centroid of the closest triangle lies
    within ``d + R``.

    GeometryError if the surface has no triangles.

    Parameters
    ----------
    points : (n, 3) mm
    vertices, triangles
        The surface, ``(n_vertices, 3)`` mm and ``(m, 3)``.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    triangles = np.ascontiguousarray(triangles, dtype=np.int64)
    if len(triangles) == 0:
        raise GeometryError("closest points: the surface has no triangles; give at least one")
    corners = vertices[triangles]
    centroids = corners.mean(axis=1)
    reach = float(np.linalg.norm(corners - centroids[:, None], axis=2).max())
    tree = cKDTree(centroids)
    n = len(points)
    distance = np.full(n, np.inf)
    triangle = np.zeros(n, dtype=np.int64)
    barycentric = np.zeros((n, 3))
    k = min(4, len(triangles))
    first = tree.query(points, k=k)[1].reshape(n, k)
    _closest_of_candidates(
        points, vertices, triangles, np.arange(n + 1) * k, first.ravel(),
        distance, triangle, barycentric,
    )  # fmt: skip
    block = 20_000
    for start in range(0, n, block):
        part = slice(start, start + block)
        lists = tree.query_ball_point(points[part], distance[part] + reach * (1 + 1e-12))
        counts = np.array([len(entry) for entry in lists], dtype=np.int64)
        offsets = np.concatenate(([0], np.cumsum(counts)))
        candidates = np.fromiter(chain.from_iterable(lists), np.int64, offsets[-1])
        _closest_of_candidates(
            points[part], vertices, triangles, offsets, candidates,
            distance[part], triangle[part], barycentric[part],
        )  # fmt: skip
    return ClosestPoints(distance, triangle, barycentric)


def has_intersections(vertices: FloatArray, triangles: IntArray) -> bool:
    """Whether an edge of the surface passes through one of its triangles (IPC toolkit).

    An edge is not tested against triangles that share one of its vertices. Overlapping triangles in
    one plane are not found; `mvest.valve.geometry.surface_checks.check_surface` finds duplicates.
    """
    if len(triangles) == 0:
        return False
    vertices = np.asfortranarray(vertices, dtype=np.float64)
    faces = np.asfortranarray(triangles, dtype=np.int32)
    edges = np.asfortranarray(surface_edges(triangles), dtype=np.int32)
    mesh = ipctk.CollisionMesh(vertices, edges, faces)
    return bool(ipctk.has_intersections(mesh, vertices))


def overlapping_boxes(vertices: FloatArray, triangles: IntArray) -> float:
    """Estimated number of pairs of an edge and a triangle whose bounding boxes overlap.

    The intersection check needs time and memory in proportion. A valid surface has about ten pairs
    per edge, a tangle of triangles up to one per edge and triangle.
    """
    edges = surface_edges(triangles)
    corners = vertices[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    some = edges[:: max(1, len(edges) // SAMPLED_EDGES)]
    count = 0
    for ends in vertices[some]:
        count += int(((low <= ends.max(axis=0)) & (high >= ends.min(axis=0))).all(axis=1).sum())
    return count / len(some) * len(edges)


def intersecting_triangles(
    vertices: FloatArray, triangles: IntArray, most: int | None = None
) -> IntArray:
    """Pairs of intersecting triangles ``(k, 2)``, lower number first, each pair once.

    Some kinds are not found, see `has_intersections`. At most ``most`` candidate pairs (overlapping
    boxes of an edge and a triangle) are tested; all by default.
    """
    if not has_intersections(vertices, triangles):
        return np.zeros((0, 2), dtype=np.int64)
    edges = surface_edges(triangles)
    phase = ipctk.LBVH()
    phase.build(
        np.asfortranarray(vertices, dtype=np.float64),
        np.asfortranarray(edges, dtype=np.int32),
        np.asfortranarray(triangles, dtype=np.int32),
        1e-9,
    )
    sides = np.sort(directed_edges(triangles), axis=1) @ [len(vertices), 1]
    pairs: set[tuple[int, int]] = set()
    for candidate in phase.detect_edge_face_candidates()[:most]:
        edge, face = edges[candidate.edge_id], int(candidate.face_id)
        if not np.isin(edge, triangles[face]).any() and ipctk.is_edge_intersecting_triangle(
            *vertices[edge], *vertices[triangles[face]]
        ):
            for owner in np.flatnonzero(sides == edge @ [len(vertices), 1]) % len(triangles):
                pairs.add((min(int(owner), face), max(int(owner), face)))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def plane_section(
    vertices: FloatArray, triangles: IntArray, origin: FloatArray, normal: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Cut a triangulated surface with a plane.

    Returns
    -------
    segments
        ``(k, 2, 3)`` mm, one for each cut triangle.
    triangle
        ``(k,)`` indices of the cut triangles.
    """
    height = (np.asarray(vertices, dtype=np.float64) - origin) @ normal
    # A vertex on the plane counts as above it, so that no segment appears twice.
    above = height >= 0
    corner_above = above[triangles]
    cut = np.flatnonzero(corner_above.any(axis=1) & ~corner_above.all(axis=1))
    segments = np.empty((len(cut), 2, 3))
    filled = np.zeros(len(cut), dtype=np.int64)
    for i in range(3):
        a, b = triangles[cut, i], triangles[cut, (i + 1) % 3]
        crosses = above[a] != above[b]
        fraction = height[a[crosses]] / (height[a[crosses]] - height[b[crosses]])
        points = vertices[a[crosses]] + fraction[:, None] * (
            vertices[b[crosses]] - vertices[a[crosses]]
        )
        rows = np.flatnonzero(crosses)
        segments[rows, filled[rows]] = points
        filled[rows] += 1
    return segments, cut
