"""Signed distances to a surface, and offsets from a curve, that move; and their derivatives.

Exact geometry on plain arrays. A surface or curve moves with p parameters: its vertices are given
with their derivatives ``(n, 3, p)``. The derivative is that of the distance as the parameters
change, the closest point's own sliding included.
"""

from __future__ import annotations

import numpy as np

from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import area_vectors

__all__ = ["across_curve", "closest_on_loop", "curve_offsets", "signed_distances"]

TOUCHING = 1e-9
"""Distance in mm below which the offset from a closest point has no direction of its own."""

TANGENT_REACH = 6.0
"""Standard deviations of a curve's points over which its direction is taken, to each side: the
direction is then known to 1 / (6 sqrt(2)) rad, and 1.4 % of the information across it is lost."""


def signed_distances(
    points: FloatArray, vertices: FloatArray, triangles: IntArray, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Signed distances of points to a surface, positive on the side of its normals.

    ``d = u . (x - c)`` and ``dd/dm = -u . dc/dm``, with the closest point c fixed in its triangle.
    Inside a triangle u is its normal, so that nothing happens at d = 0; on an edge or at a vertex u
    is along x - c, on the side of the angle-weighted normal, and that normal itself at d = 0.

    Parameters
    ----------
    points : (q, 3) mm
    vertices : (n, 3) mm
    triangles : (m, 3)
        All turning one way.
    motion : (n, 3, p)
        Derivative of the vertices.

    Returns
    -------
    distance : (q,) mm
    derivative : (q, p)
    """
    closest = closest_points(points, vertices, triangles)
    offset = points - closest.interpolate(vertices, triangles)
    normal, inside = _normals(vertices, triangles, closest.triangle, closest.barycentric)
    length = closest.distance[:, None]
    side = np.where(np.einsum("qk,qk->q", offset, normal) < 0.0, -1.0, 1.0)[:, None]
    apart = ~inside[:, None] & (length > TOUCHING)
    direction = np.divide(side * offset, length, out=normal.copy(), where=apart)
    moved = closest.interpolate(motion, triangles)
    distance = np.einsum("qk,qk->q", direction, offset)
    return distance, -np.einsum("qk,qkp->qp", direction, moved)


def _normals(
    vertices: FloatArray, triangles: IntArray, triangle: IntArray, barycentric: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Angle-weighted unit normals ``(q, 3)`` at closest points, and which are inside a triangle."""
    corner = vertices[triangles]
    ahead = _unit(np.roll(corner, -1, axis=1) - corner)
    behind = _unit(np.roll(corner, 1, axis=1) - corner)
    face = _unit(area_vectors(vertices, triangles))
    angle = np.arccos(np.clip(np.einsum("mck,mck->mc", ahead, behind), -1.0, 1.0))
    of_vertex = np.zeros_like(vertices)
    np.add.at(of_vertex, triangles, angle[..., None] * face[:, None])
    # Edge c of a triangle lies opposite its corner c.
    ends = np.sort(np.stack([np.roll(triangles, -1, 1), np.roll(triangles, -2, 1)], 2), axis=2)
    keys, edge = np.unique(ends @ [len(vertices), 1], return_inverse=True)
    edge = edge.reshape(triangles.shape)
    of_edge = np.zeros((len(keys), 3))
    np.add.at(of_edge, edge, face[:, None])

    zeros = np.count_nonzero(barycentric == 0.0, axis=1)
    at_edge = of_edge[edge[triangle, np.argmin(barycentric, axis=1)]]
    at_vertex = of_vertex[triangles[triangle, np.argmax(barycentric, axis=1)]]
    normal = np.choose(zeros[:, None], [face[triangle], at_edge, at_vertex])
    return _unit(normal), zeros == 0


def across_curve(curve: FloatArray, std: float) -> FloatArray:
    """Two unit vectors ``(j, 3, 2)`` across a closed curve as it was seen, at each of its points.

    The direction is that from a point before to a point after, ``TANGENT_REACH`` standard
    deviations away but no more than an eighth of the points. Where it is wrong by an angle, one of
    the components is too small by its cosine: information is lost, and none made up.
    """
    for reach in range(1, max(1, len(curve) // 8) + 1):
        span = np.roll(curve, -reach, axis=0) - np.roll(curve, reach, axis=0)
        if np.median(np.linalg.norm(span, axis=1)) >= 2.0 * TANGENT_REACH * std:
            break
    # The right singular vectors after the first are an orthonormal basis across it.
    return np.linalg.svd(span[:, None, :])[2][:, 1:].swapaxes(1, 2)


def curve_offsets(
    curve: FloatArray, across: FloatArray, loop: FloatArray, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Offsets ``(2 j,)`` mm of seen points from a closed polyline, and ``(2 j, p)``.

    With r = x - c, c = a + s (b - a) and the unit tangent t of length L, inside an edge::

        dr = -(I - t tT) dc - t (r . (db - da)) / L,   dc = (1 - s) da + s db

    and dr = -da at a vertex.

    Parameters
    ----------
    curve : (j, 3) mm
    across : (j, 3, 2)
        Two directions at each point, from `across_curve`.
    loop : (e, 3) mm
        Vertices of the polyline, the last joined to the first.
    motion : (e, 3, p)
    """
    edge, raw, offset = closest_on_loop(curve, loop)
    step = (np.roll(loop, -1, axis=0) - loop)[edge]
    length = np.maximum(np.linalg.norm(step, axis=1), np.finfo(np.float64).tiny)
    s = np.clip(raw, 0.0, 1.0)[:, None, None]
    moved_step = (np.roll(motion, -1, axis=0) - motion)[edge]
    moved = motion[edge] + s * moved_step
    t = step / length[:, None]
    slide = np.einsum("jk,jkp->jp", offset, moved_step) / length[:, None]
    along = np.einsum("jk,jkp->jp", t, moved) - slide
    within: BoolArray = (raw >= 0.0) & (raw <= 1.0)
    change = -moved + np.where(within[:, None, None], t[:, :, None] * along[:, None, :], 0.0)
    h = np.einsum("jki,jk->ji", across, offset)
    return h.ravel(), np.einsum("jki,jkp->jip", across, change).reshape(h.size, -1)


def closest_on_loop(
    points: FloatArray, loop: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Closest points of a closed polyline ``(e, 3)`` mm to points ``(j, 3)`` mm.

    Returns
    -------
    edge : (j,)
        Edge k runs from vertex k to the next.
    along : (j,)
        Where the point is along the line of the edge, which ends at 0 and 1.
    offset : (j, 3) mm
        From the closest point to the point.
    """
    step = np.roll(loop, -1, axis=0) - loop
    squared = np.maximum(np.einsum("ek,ek->e", step, step), np.finfo(np.float64).tiny)
    along = np.einsum("jek,ek->je", points[:, None] - loop, step) / squared
    offset = points[:, None] - loop - np.clip(along, 0.0, 1.0)[..., None] * step
    edge = np.argmin(np.linalg.norm(offset, axis=2), axis=1)
    rows = np.arange(len(points))
    return edge, along[rows, edge], offset[rows, edge]


def _unit(vectors: FloatArray) -> FloatArray:
    """Vectors ``(..., 3)`` of length one; zero where they were zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)
