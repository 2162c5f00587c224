"""Triangulations: edges, areas and normals, stretch between two shapes, and refinement.

A refined surface is a fixed linear function of the coarse vertices. Facets of a curved surface
(edge length h, radius r) are ``h² / 8 r`` inside it, and neighbouring normals differ by ``h / r``:
0.1 mm and 20 degrees where leaflets bend. Edges are halved with a Hermite cubic. Its gradients of
the position over the surface at rest are averages over the triangles at both ends::

    (a + b) / 2 + (b - a) . (grad_a - grad_b) / 8

The weights depend only on the surface at rest, so derivatives by the vertices are exact.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from mvest.typing import FloatArray, IntArray


def area_vectors(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Normals ``(m, 3)`` of triangles, with length equal to the area in mm²."""
    corner = vertices[triangles]
    return 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def areas(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Areas ``(m,)`` mm² of triangles."""
    return np.asarray(np.linalg.norm(area_vectors(vertices, triangles), axis=1))


def area_vectors_change(vertices: FloatArray, triangles: IntArray, moves: FloatArray) -> FloatArray:
    """Change ``(m, 3, q)`` mm² of `area_vectors` by displacements ``(n, 3, q)`` of vertices."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    da, db, dc = np.moveaxis(moves[triangles], 1, 0)
    change = np.cross(db - da, (c - a)[..., None], axis=1)
    change += np.cross((b - a)[..., None], dc - da, axis=1)
    return np.asarray(0.5 * change)


def arc_length(points: FloatArray) -> FloatArray:
    """Arc length ``(k, ...)`` mm of curves ``(k, ..., 3)`` from their first point to each point."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


def loop_length(curve: FloatArray) -> float:
    """Length (mm) of a closed curve ``(k, 3)``."""
    return float(np.linalg.norm(curve - np.roll(curve, -1, axis=0), axis=1).sum())


def directed_edges(triangles: IntArray) -> IntArray:
    """Directed edges ``(3 m, 2)``: first all from corner 0, then all from 1, then all from 2."""
    return np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def surface_edges(triangles: IntArray) -> IntArray:
    """Undirected edges ``(n_edges, 2)`` of a triangulation, each once, lower number first."""
    return np.unique(np.sort(directed_edges(triangles), axis=1), axis=0)


def edge_table(triangles: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Half-edges ``(3 m, 2)``, edges ``(e, 2)``, the edge of each half-edge, and their number.

    Half-edge ``3 t + i`` runs from corner i of triangle t to the next. Edges are sorted by their
    lower and then by their higher vertex.
    """
    half = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    edges, inverse, count = np.unique(
        np.sort(half, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return half, edges, inverse.ravel(), count


def connected_pieces(pairs: IntArray, n: int) -> tuple[int, IntArray]:
    """The number of pieces of n points that ``pairs (k, 2)`` connect, and that ``(n,)`` of each."""
    graph = sparse.coo_matrix((np.ones(len(pairs), dtype=np.int8), pairs.T), shape=(n, n))
    count, piece = connected_components(graph, directed=False)
    return int(count), piece.astype(np.int64)


def euler_number(triangles: IntArray) -> int:
    """Vertices minus edges plus triangles: 2 of a sphere, 0 of a band or a torus."""
    return len(np.unique(triangles)) - len(surface_edges(triangles)) + len(triangles)


def edges_between(triangles: IntArray, region: IntArray) -> IntArray:
    """Edges ``(k, 2)`` on which triangles of different regions ``(m,)`` meet."""
    _, edges, number, _ = edge_table(triangles)
    low, high = np.full(len(edges), np.max(region)), np.full(len(edges), -1)
    np.minimum.at(low, number, np.repeat(region, 3))
    np.maximum.at(high, number, np.repeat(region, 3))
    return edges[low != high]


def unit_normals(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Unit normals ``(m, 3)`` of triangles."""
    return unit_rows(area_vectors(vertices, triangles))


def unit_rows(vectors: FloatArray) -> FloatArray:
    """Vectors ``(n, 3)`` scaled to unit length; zero vectors are unchanged."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def mean_fibre(fibre: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted sum ``(..., 3)`` of the fibres ``(..., 3, 3)`` of a triangle's corners.

    Fibres have no sign: all are aligned with the one of largest weight ``(..., 3)``.
    """
    lead = np.take_along_axis(fibre, weights.argmax(axis=-1)[..., None, None], axis=-2)
    sign = np.where(np.sum(fibre * lead, axis=-1) < 0, -1.0, 1.0)
    return np.asarray(np.einsum("...c,...ci->...i", weights * sign, fibre))


def principal_stretches(
    rest: FloatArray, deformed: FloatArray, triangles: IntArray
) -> tuple[FloatArray, FloatArray]:
    r"""Largest and smallest stretch ``(n,)`` at each vertex, area-weighted over its triangles.

    For a triangle with the edges :math:`D = [d_1, d_2] = Q R` at rest (Q orthonormal) and :math:`d`
    when deformed, they are the singular values of :math:`d R^{-1}`.
    """

    def edges(points: FloatArray) -> FloatArray:
        corner = points[triangles]
        return np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)

    upper = np.linalg.qr(edges(rest))[1]
    values = np.linalg.svd(edges(deformed) @ np.linalg.inv(upper), compute_uv=False)
    weight = np.repeat(areas(rest, triangles), 3)
    total = np.bincount(triangles.ravel(), weight, minlength=len(rest))
    return (
        np.bincount(triangles.ravel(), weight * np.repeat(values[:, 0], 3), len(rest)) / total,
        np.bincount(triangles.ravel(), weight * np.repeat(values[:, 1], 3), len(rest)) / total,
    )


MAX_TRIANGLES = 100_000
"""Largest number of triangles of a refined surface."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A finer surface."""

    #: (r, n) sparse, maps coarse to fine vertices; the coarse ones come first, unmoved
    weights: sparse.csr_array
    triangles: IntArray  #: (m, 3)
    parent: IntArray  #: (m,), coarse triangle containing each fine one
    loops: tuple[IntArray, ...]  #: tuple of (e,), refined closed loops along edges


def refined(
    vertices: FloatArray, triangles: IntArray, edge_length: float, loops: tuple[IntArray, ...] = ()
) -> Refinement:
    """Halve the edges of a surface until their median length is small enough.

    Parameters
    ----------
    vertices : (n, 3) mm
        At rest.
    triangles : (m, 3)
    edge_length : float
        mm, largest median.
    loops : tuple of (e,)
        Vertices in the order of closed loops along edges.
    """
    fine = Refinement(
        sparse.eye_array(len(vertices), format="csr"), triangles, np.arange(len(triangles)), loops
    )
    ends = vertices[directed_edges(triangles)]
    length = float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))
    while length > edge_length and 4 * len(fine.triangles) <= MAX_TRIANGLES:
        fine, length = _halved(vertices, fine), 0.5 * length
    return fine


def _halved(vertices: FloatArray, coarse: Refinement) -> Refinement:
    x, triangles = coarse.weights @ vertices, coarse.triangles
    n = len(x)
    _, edges, number, _ = edge_table(triangles)
    a, b = edges.T
    own = sparse.eye_array(n, format="csr")
    middle = 0.5 * (own[a] + own[b])
    for along, slope in zip((x[b] - x[a]).T, _slopes(x, triangles), strict=True):
        middle = middle + sparse.diags_array(along / 8.0) @ (slope[a] - slope[b])
    # Midpoints of the edges from corners 0, 1 and 2.
    p, q, r = n + number.reshape(-1, 3).T
    i, j, k = triangles.T
    parts = np.array([[i, p, r], [p, j, q], [r, q, k], [p, q, r]])
    return Refinement(
        sparse.vstack([own, middle], format="csr") @ coarse.weights,
        np.moveaxis(parts, 2, 0).reshape(-1, 3),
        np.repeat(coarse.parent, 4),
        tuple(_halved_loop(loop, edges, n) for loop in coarse.loops),
    )


def _halved_loop(loop: IntArray, edges: IntArray, n: int) -> IntArray:
    ends = np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1)
    # Edges are sorted by their first, then by their second vertex.
    middle = n + np.searchsorted(edges @ [n, 1], ends @ [n, 1])
    return np.stack([loop, middle], axis=1).ravel()


def _slopes(x: FloatArray, triangles: IntArray) -> list[sparse.csr_array]:
    """Gradients along x, y and z at the vertices, each ``(n, n)``: area-weighted means."""
    n, m = len(x), len(triangles)
    area = np.maximum(areas(x, triangles), np.finfo(np.float64).tiny)
    corner, row = x[triangles], np.repeat(np.arange(m), 3)
    opposite = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
    across = np.cross(unit_normals(x, triangles)[:, None], opposite)
    around = sparse.csr_array((np.repeat(area, 3), (triangles.ravel(), row)), shape=(n, m))
    mean = sparse.diags_array(1.0 / np.maximum(around.sum(axis=1), np.finfo(np.float64).tiny))
    return [
        mean
        @ around
        @ sparse.csr_array(
            ((across[..., k] / (2.0 * area[:, None])).ravel(), (row, triangles.ravel())),
            shape=(m, n),
        )
        for k in range(3)
    ]
