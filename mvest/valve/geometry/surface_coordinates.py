"""Harmonic material coordinates of a band of leaflets between annulus and free edge.

The leaflets of an atrioventricular valve form a band: a triangulation with exactly two boundary
loops. It has two natural coordinates,

* ``s``: 0 on the annulus, 1 on the free edge, harmonic in between, and
* ``theta``: the angle around the valve, harmonic without flux through either edge, period 2 pi.

Both solve Laplace's equation with the cotangent weights of linear triangles (Pinkall and Polthier
1993, Exp. Math. 2:15). Together they map the band to a flat strip; with ``s`` scaled by
``modulus`` the map is almost conformal.

Between obtuse triangles a cotangent weight is negative, and the map may fold over. With positive
weights it cannot (Gortler, Gotsman and Thurston 2006, Comput. Aided Geom. Des. 23:83). So small and
negative weights around folded triangles are raised until no fold is left. The coordinates are
harmonic except at those few edges.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.spatial import cKDTree

from mvest.errors import GeometryError, InputError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import vertex_normals
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import edge_table, unit_rows

MIN_WEIGHT = 0.05
"""Smallest cotangent weight around folded triangles; an equilateral triangle has 0.58."""
MAX_ROUNDS = 10
"""Largest number of rounds of raising weights around folded triangles."""
OUTSIDE = 0.01
"""A point farther outside than this (in turns) is not on the surface; less is rounding of s."""


@dataclass(frozen=True, slots=True)
class SurfaceCoordinates:
    """Harmonic coordinates of a band and their circumferential direction."""

    triangles: IntArray  #: ``(m, 3)`` vertex indices
    #: (n,), angle around the valve in [0, 2 pi), and 0 (annulus) to 1 (free edge)
    theta: FloatArray
    s: FloatArray
    #: length of the strip for a width of 2 pi: ``(theta, modulus * s)`` is nearly conformal
    modulus: float
    #: ``(n, 3)`` unit tangents parallel to the annulus (perpendicular to the gradient of ``s``)
    circumferential: FloatArray

    def strip_triangles(self) -> FloatArray:
        """Corners ``(m, 3, 2)`` of all triangles in the strip, unwrapped about the first corner."""
        theta = self.theta[self.triangles]
        theta = theta[:, :1] + wrapped(theta - theta[:, :1])
        return np.stack([theta, self.modulus * self.s[self.triangles]], axis=-1)

    @property
    def clockwise(self) -> bool:
        """Whether most triangles run clockwise in the strip."""
        return bool(np.median(_signed_area(self.strip_triangles())) < 0)

    def folded(self) -> IntArray:
        """Triangles ``(k,)`` whose orientation in the strip differs from the majority."""
        area = _signed_area(self.strip_triangles())
        return np.flatnonzero(area * np.sign(np.median(area)) <= 0)

    def locate(self, theta: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Triangles ``(k,)`` and barycentric weights ``(k, 3)`` of points at theta (rad) and s.

        A point slightly outside the polygonal edge is moved to the nearest triangle.
        """
        points = np.column_stack([theta, self.modulus * np.asarray(s, dtype=float)])
        return _locate_in_plane(self.strip_triangles(), points, period=2 * np.pi)


def boundary_loops(triangles: IntArray) -> list[IntArray]:
    """Boundary loops of a triangulation, each in the direction of its triangles.

    GeometryError if an edge has more than two triangles, neighbours differ in orientation, or a
    boundary vertex has more than two boundary edges.
    """
    triangles = np.asarray(triangles)
    directed, edges, number, count = edge_table(triangles)
    if count.max() > 2:
        raise GeometryError(
            f"surface is not a manifold: edge {edges[np.argmax(count)].tolist()} belongs to "
            f"{count.max()} triangles (at most 2 expected)"
        )
    unique_directed = np.unique(directed, axis=0)
    if len(unique_directed) < len(directed):
        raise GeometryError(
            f"{len(directed) - len(unique_directed)} edges are run through in the same direction "
            "by both their triangles: orient all triangles alike"
        )
    boundary = directed[count[number] == 1]
    following = dict(boundary.tolist())
    if len(following) < len(boundary):
        raise GeometryError("a boundary vertex has more than two boundary edges (two loops touch)")
    loops = []
    while following:
        start = min(following)
        loop = [start]
        vertex = following.pop(start)
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        loops.append(np.array(loop, dtype=np.int64))
    return loops


def cotangent_laplacian(vertices: FloatArray, triangles: IntArray) -> sp.csr_matrix:
    """Stiffness ``(n, n)`` of Laplace's equation for linear triangles (positive semidefinite)."""
    corner = vertices[triangles]
    rows, columns, values = [], [], []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        a, b = corner[:, j] - corner[:, i], corner[:, k] - corner[:, i]
        cot = np.einsum("ij,ij->i", a, b) / np.linalg.norm(np.cross(a, b), axis=1)
        weight = 0.5 * cot
        tj, tk = triangles[:, j], triangles[:, k]
        rows += [tj, tk, tj, tk]
        columns += [tk, tj, tj, tk]
        values += [-weight, -weight, weight, weight]
    n = len(vertices)
    return sp.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n)
    ).tocsr()


def surface_coordinates(
    vertices: FloatArray, triangles: IntArray, annulus: IntArray, free_edge: IntArray
) -> SurfaceCoordinates:
    """Solve for ``theta`` and ``s`` on a band.

    GeometryError if annulus and free edge are not the two boundary loops, a triangle has all
    corners on one loop, or the coordinates fold over.

    Parameters
    ----------
    vertices : (n, 3) mm
    triangles : (m, 3)
    annulus, free_edge : ndarray
        Vertex indices of the two boundary loops, the annulus in loop order.
    """
    vertices = np.asarray(vertices, dtype=float)
    loops = boundary_loops(triangles)
    sets = sorted(tuple(sorted(loop.tolist())) for loop in loops)
    if sets != sorted([tuple(sorted(annulus.tolist())), tuple(sorted(free_edge.tolist()))]):
        raise GeometryError(
            f"annulus ({len(annulus)} vertices) and free edge ({len(free_edge)} vertices) must be "
            f"the two boundary loops of the surface; it has loops of {[len(x) for x in loops]}"
        )
    flat = np.isin(triangles, annulus).all(axis=1) | np.isin(triangles, free_edge).all(axis=1)
    if flat.any():
        raise GeometryError(
            f"triangle {int(np.argmax(flat))} has all three corners on one edge loop, so that no "
            "coordinate varies in it: flip its inner edge"
        )
    laplacian = cotangent_laplacian(vertices, triangles)
    coordinates = _solve(vertices, triangles, annulus, free_edge, laplacian)
    near = np.zeros(len(vertices), dtype=np.bool_)
    for _ in range(MAX_ROUNDS):
        folded = coordinates.folded()
        if not folded.size:
            return coordinates
        near[triangles[folded]] = True
        laplacian = _raised(laplacian, near)
        coordinates = _solve(vertices, triangles, annulus, free_edge, laplacian)
    folded = coordinates.folded()
    if folded.size:
        raise GeometryError(
            f"material coordinates fold over at {folded.size} triangles (first: "
            f"{folded[:5].tolist()}): the surface is too distorted or its triangles too obtuse"
        )
    return coordinates


def _solve(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: IntArray,
    free_edge: IntArray,
    laplacian: sp.csr_matrix,
) -> SurfaceCoordinates:
    s = _dirichlet(laplacian, annulus, free_edge)
    return SurfaceCoordinates(
        triangles=np.asarray(triangles, dtype=np.int64),
        theta=_conjugate_angle(vertices, triangles, laplacian, annulus, free_edge),
        s=s,
        # s^T L s is the flux of s through the band, so 2 pi over it is the strip's length.
        modulus=2 * np.pi / float(s @ (laplacian @ s)),
        circumferential=_perpendicular_to_gradient(vertices, triangles, s),
    )


def _raised(laplacian: sp.csr_matrix, near: BoolArray) -> sp.csr_matrix:
    """The Laplacian with weights raised to `MIN_WEIGHT` at the vertices ``near (n,)``."""
    edges = sp.triu(laplacian, k=1).tocoo()
    here = near[edges.row] | near[edges.col]
    weight = np.where(here, np.maximum(-edges.data, MIN_WEIGHT), -edges.data)
    off = sp.coo_matrix((-weight, (edges.row, edges.col)), shape=laplacian.shape)
    off = off + off.T
    return (off - sp.diags(np.asarray(off.sum(axis=1)).ravel())).tocsr()


def _dirichlet(laplacian: sp.csr_matrix, zero: IntArray, one: IntArray) -> FloatArray:
    n = laplacian.shape[0]
    value = np.zeros(n)
    value[one] = 1.0
    free = np.setdiff1d(np.arange(n), np.concatenate([zero, one]))
    if free.size:
        rhs = -(laplacian @ value)[free]
        value[free] = spla.spsolve(laplacian[free][:, free].tocsc(), rhs)
    return value


def _conjugate_angle(
    vertices: FloatArray,
    triangles: IntArray,
    laplacian: sp.csr_matrix,
    annulus: IntArray,
    free_edge: IntArray,
) -> FloatArray:
    """Harmonic angle with natural boundaries; vertex 0 has its angle about the annulus axis.

    A jump of 2 pi across a cut from edge to edge is a closed form with that period. Subtracting the
    gradient that makes it divergence-free leaves the harmonic form. The cut runs along the surface,
    because closed leaflets may cross the axis.
    """
    row, column = _cut(triangles, annulus, free_edge).T
    jump = 2 * np.pi * -np.asarray(laplacian[row, column]).ravel()
    divergence = np.zeros(len(vertices))
    np.add.at(divergence, row, jump)
    np.add.at(divergence, column, -jump)
    correction = np.zeros(len(vertices))
    correction[1:] = spla.spsolve(laplacian[1:][:, 1:].tocsc(), divergence[1:])
    return np.mod(_angle_of_first(vertices, annulus) + correction, 2 * np.pi)


def _angle_of_first(vertices: FloatArray, annulus: IntArray) -> float:
    """Angle of vertex 0 about the annulus axis, measured from the first annulus vertex."""
    loop = vertices[annulus]
    centre = loop.mean(axis=0)
    axis = np.cross(loop - centre, np.roll(loop, -1, axis=0) - centre).sum(axis=0)
    axis /= np.linalg.norm(axis)
    first = loop[0] - centre
    first = first - axis * (first @ axis)
    first /= np.linalg.norm(first)
    relative = vertices[0] - centre
    return float(np.arctan2(relative @ np.cross(axis, first), relative @ first))


def _cut(triangles: IntArray, annulus: IntArray, free_edge: IntArray) -> IntArray:
    """Edges ``(k, 2)`` crossed by a chain of triangles from the annulus to the free edge.

    Each edge runs in the direction of the annulus.
    """
    corners = triangles.tolist()
    owner = {(t[i - 1], t[i]): n for n, t in enumerate(corners) for i in range(3)}
    rim = set(free_edge.tolist())
    start = (int(annulus[0]), int(annulus[1]))
    along = start in owner
    start = start if along else start[::-1]
    # Triangle -> the edge through which the chain entered it, in the triangle's direction.
    entered = {owner[start]: start}
    queue = deque(entered)
    crossed: list[tuple[int, int]] = []
    while queue and not crossed:
        triangle = queue.popleft()
        for i in range(3):
            a, b = corners[triangle][i - 1], corners[triangle][i]
            neighbour = owner.get((b, a))
            if neighbour is None and a in rim and b in rim:
                crossed = [(b, a), entered[triangle]]
                break
            if neighbour is not None and neighbour not in entered:
                entered[neighbour] = (b, a)
                queue.append(neighbour)
    while crossed[-1] != start:
        crossed.append(entered[owner[crossed[-1][::-1]]])
    return np.array(crossed if along else [edge[::-1] for edge in crossed])


def _perpendicular_to_gradient(
    vertices: FloatArray, triangles: IntArray, s: FloatArray
) -> FloatArray:
    corner = vertices[triangles]
    # Sum of s_i times the opposite edge is 2 A n x grad(s): already parallel to the level lines.
    value = s[triangles]
    along = sum(
        value[:, i, None] * (corner[:, (i + 2) % 3] - corner[:, (i + 1) % 3]) for i in range(3)
    )
    direction = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(direction, triangles[:, i], along)
    n = vertex_normals(vertices, triangles)
    direction -= n * np.einsum("ij,ij->i", direction, n)[:, None]
    return unit_rows(direction)


def _locate_in_plane(
    corners: FloatArray, points: FloatArray, period: float
) -> tuple[IntArray, FloatArray]:
    """Triangle ``(n,)`` and weights ``(n, 3)`` of points in a periodic strip.

    One of the dozen nearest triangles nearly always contains the point; otherwise all are searched.
    """
    m, shift = len(corners), np.array([period, 0.0])
    repeated = np.concatenate([corners - shift, corners, corners + shift])
    triangle = np.zeros(len(points), dtype=np.int64)
    weights = np.zeros((len(points), 3))
    best = np.full(len(points), -np.inf)
    _, candidates = cKDTree(repeated.mean(axis=1)).query(points, k=min(12, 3 * m))
    for column in np.atleast_2d(candidates).T:
        w = _barycentric(repeated[column], points)
        worst = w.min(axis=1)
        better = worst > best
        best[better], triangle[better], weights[better] = worst[better], column[better], w[better]
    todo = np.flatnonzero(best < -1e-9)
    if todo.size:
        flat = np.pad(repeated.reshape(-1, 2), ((0, 0), (0, 1)))
        found = closest_points(
            np.pad(points[todo], ((0, 0), (0, 1))), flat, np.arange(9 * m).reshape(-1, 3)
        )
        if np.any(found.distance > OUTSIDE * period):
            raise InputError(
                f"{np.sum(found.distance > OUTSIDE * period)} points lie outside the surface "
                "(coordinate s must be in [0, 1])"
            )
        triangle[todo], weights[todo] = found.triangle, found.barycentric
    weights = np.maximum(weights, 0.0)
    return triangle % m, weights / weights.sum(axis=1, keepdims=True)


def _barycentric(corner: FloatArray, point: FloatArray) -> FloatArray:
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    r = point - corner[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    u = (r[:, 0] * b[:, 1] - r[:, 1] * b[:, 0]) / area
    v = (a[:, 0] * r[:, 1] - a[:, 1] * r[:, 0]) / area
    return np.column_stack([1 - u - v, u, v])


def _signed_area(corner: FloatArray) -> FloatArray:
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def wrapped(angle: FloatArray) -> FloatArray:
    """Angles (rad) in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
