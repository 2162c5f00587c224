"""Signed distances to a surface, and offsets from a curve, that move; and their derivatives.

Exact geometry on plain arrays. A surface or curve moves with p parameters: its vertices are given
with their derivatives ``(n, 3, p)``. The derivative is that of the distance as the parameters
change, the closest point's own sliding included.

Facets have creases, across which the derivatives jump, and a border, beyond which a distance has
another sign. `smooth_distances` and `smooth_offsets` have neither: a filter that goes on from
derivatives comes to an end with them, and its posterior is what it takes it for.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import area_vectors, unit_vectors

TOUCHING = 1e-9
"""Distance in mm below which the offset from a closest point has no direction of its own."""

TANGENT_REACH = 6.0
"""Standard deviations of a curve's points over which its direction is taken, to each side: the
direction is then known to 1 / (6 sqrt(2)) rad, and 1.4 % of the information across it is lost."""

REACH = 5.5
"""Widths beyond the nearest triangle from which on triangles do not count: less than 3e-7."""


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
    ahead = unit_vectors(np.roll(corner, -1, axis=1) - corner)
    behind = unit_vectors(np.roll(corner, 1, axis=1) - corner)
    face = unit_vectors(area_vectors(vertices, triangles))
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
    return unit_vectors(normal), zeros == 0


def smooth_distances(
    points: FloatArray, vertices: FloatArray, triangles: IntArray, width: float
) -> tuple[FloatArray, list[csr_array]]:
    """Signed distances of points to a surface that is smoothed over a width, and their derivatives.

    Triangles with the area vectors a and the middles p count by ``g = exp(-|x - p|² / 2 w²)``::

        d = sum g a . (x - p) / |V|,   V = sum g a,   u = V / |V|
        dd = sum (g da . y - g a . dp + dg a . y) / |V|,   y = x - p - d u

    (implicit moving least squares: Kolluri, ACM Trans. Algorithms 4 (2008) 18). It bends with the
    surface and has neither creases where facets meet nor, beyond a border, another sign: the
    surface goes on there as it ends. On a bend of radius r in both directions it is off by w²/r.

    Parameters
    ----------
    points : (q, 3) mm
    vertices : (n, 3) mm
    triangles : (m, 3)
        All turning one way, not larger than the width.
    width : float
        w, mm.

    Returns
    -------
    distance : (q,) mm
        Positive on the side of the normals.
    derivative : list of three (q, n) sparse
        By the x, y and z of the vertices.
    """
    corner = vertices[triangles]
    middle, area = corner.mean(axis=1), area_vectors(vertices, triangles)
    tree = cKDTree(middle)
    nearest = np.asarray(tree.query(points)[0])
    near = tree.query_ball_point(points, np.hypot(nearest, REACH * width))
    row = np.repeat(np.arange(len(points)), [len(each) for each in near])
    of = np.concatenate([np.asarray(each, dtype=np.int64) for each in near])

    def total(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(row, column, len(points)) for column in values.T], axis=1)

    away, a = points[row] - middle[of], area[of]
    g = np.exp(0.5 * (nearest[row] ** 2 - np.einsum("ki,ki->k", away, away)) / width**2)
    V = total(g[:, None] * a)
    size = np.linalg.norm(V, axis=1)
    distance = total((g * np.einsum("ki,ki->k", a, away))[:, None])[:, 0] / size
    y = away - (distance / size)[row, None] * V[row]
    opposite = np.roll(corner, -1, axis=1) - np.roll(corner, -2, axis=1)
    turned = 0.5 * np.cross(opposite[of], y[:, None])
    slid = (np.einsum("ki,ki->k", a, y) / width**2)[:, None] * away - a
    by_corner = (g / size[row])[:, None, None] * (turned + slid[:, None] / 3.0)
    place = np.repeat(row, 3), triangles[of].ravel()
    shape = (len(points), len(vertices))
    return distance, [csr_array((by_corner[..., k].ravel(), place), shape=shape) for k in range(3)]


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


def smooth_offsets(
    curve: FloatArray,
    across: FloatArray,
    loop: FloatArray,
    motion: FloatArray,
    width: float,
    own: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Offsets ``(2 j,)`` mm of seen points from a closed curve that is smoothed over a width.

    Points p of the curve, r = x - p away, count by how near they are to the plane across the curve
    as it was seen, of normal n, and only if the curve is not nearer elsewhere::

        h = sum g A' r / sum g,   g = exp(-(n . r)² / 2 w² - |r|² / 2 (3 w)²)
        dh = sum g (A' r - h) ((n . r) n + r / 9) . dp / w² / sum g - sum g A' dp / sum g

    It bends with the curve, of which the closest point stays at a vertex or slides by turns.

    Parameters
    ----------
    curve, across
        See `curve_offsets`.
    loop : (e, 3) mm
        Points along the curve, nearer to each other than the width.
    motion : (e, 3, p)
    width : float
        w, mm.
    own : (j, e), optional
        Which points of the curve each may be compared with.

    Returns
    -------
    offset : (2 j,) mm
    derivative : (2 j, p)
    """
    normal = np.cross(across[:, :, 0], across[:, :, 1])
    r = curve[:, None] - loop
    along = np.einsum("jek,jk->je", r, normal)
    exponent = (along**2 + np.einsum("jek,jek->je", r, r) / 9.0) / (2.0 * width**2)
    exponent = exponent if own is None else np.where(own, exponent, np.inf)
    g = np.exp(exponent.min(axis=1, keepdims=True) - exponent)
    g /= g.sum(axis=1, keepdims=True)
    aside = np.einsum("jki,jek->jei", across, r)
    h = np.einsum("je,jei->ji", g, aside)
    turned = (along[..., None] * normal[:, None] + r / 9.0) / width**2
    by_point = g[..., None, None] * (
        (aside - h[:, None])[..., None] * turned[:, :, None] - across.swapaxes(1, 2)[:, None]
    )
    return h.ravel(), np.einsum("jeik,ekp->jip", by_point, motion).reshape(h.size, -1)


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
