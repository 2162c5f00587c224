"""Coarsening a leaflet surface to a wanted number of vertices with well-shaped triangles.

The vertices are a centroidal Voronoi tessellation of the fine surface (Lloyd's iteration over dense
area-weighted samples; Valette and Chassery 2004, Computer Graphics Forum 23:381) in which the
annulus, the free edge and the lines between leaflets are sampled first, at equal arc length, and
stay. Their Delaunay triangulation is taken in the near-conformal plane of
:mod:`mvest.valve.geometry.surface_coordinates`, where both edge loops are recovered by
construction, and is made Delaunay on the surface itself by edge flips. Everything is deterministic.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.surface_coordinates import (
    boundary_loops,
    surface_coordinates,
    unwrapped,
    wrapped,
)
from mvest.valve.geometry.triangles import areas, edge_table, edges_between

LLOYD_ITERATIONS = 40
"""Cap of the iteration; on the valves tried it stops earlier or moves no vertex visibly."""


@dataclass(frozen=True, slots=True, eq=False)
class Remeshed:
    """A coarser surface whose vertices are material points of the fine one.

    Attributes
    ----------
    surface : LeafletSurface
    annulus, free_edge : ndarray
        Vertices of the two edges in loop order.
    triangle : ndarray
        ``(n,)`` triangle of the fine surface that holds each vertex.
    weights : ndarray
        ``(n, 3)`` barycentric weights there.
    """

    surface: LeafletSurface
    annulus: IntArray
    free_edge: IntArray
    triangle: IntArray
    weights: FloatArray


def remesh(
    surface: LeafletSurface, annulus: IntArray, free_edge: IntArray, vertices: int
) -> Remeshed:
    """Coarsen a band-shaped leaflet surface.

    Parameters
    ----------
    surface : LeafletSurface
        The fine surface, one band between two boundary loops.
    annulus, free_edge : ndarray
        Its loops, in order.
    vertices : int
        Wanted number of vertices; met within a few because edge vertices come in whole numbers.

    Returns
    -------
    Remeshed
        Triangles oriented like the fine ones; leaflets separated along their original lines.

    Raises
    ------
    InputError
        If ``vertices`` is too small for the two loops or not below the fine number.
    GeometryError
        If the surface is not a band.
    """
    if not 24 <= vertices <= len(surface.vertices):
        raise InputError(
            f"remesh to {vertices} vertices: expected 24 to {len(surface.vertices)}, the number of "
            "vertices of the surface given"
        )
    coordinates = surface_coordinates(surface.vertices, surface.triangles, annulus, free_edge)
    edge_length = _edge_length(surface, annulus, free_edge, vertices)
    fixed, rings, lines = _sample_feature_lines(surface, annulus, free_edge, edge_length)
    triangle, weights = _on_edges(surface.triangles, fixed)
    corner = surface.vertices[surface.triangles]
    inner = _spread_interior(
        corner,
        areas(surface.vertices, surface.triangles),
        np.einsum("ij,ijk->ik", weights, corner[triangle]),
        max(vertices - len(fixed), 0),
    )
    triangle = np.concatenate([triangle, inner[0]])
    weights = np.vstack([weights, inner[1]])

    def at(corners: FloatArray) -> FloatArray:
        return np.einsum("ij,ij...->i...", weights, corners[triangle])

    points, strip = at(corner), at(coordinates.strip_triangles())
    triangles = _triangulate(strip, coordinates.modulus, rings[0], rings[1])
    locked = {(min(pair), max(pair)) for line in lines for pair in itertools.pairwise(line)}
    triangles = _flip_to_delaunay(points, triangles, strip, locked, rings)
    if coordinates.clockwise:
        triangles = triangles[:, [0, 2, 1]]
    _check_band(triangles, rings)
    # A triangle is of the leaflet of the fine one at its centre.
    theta = unwrapped(strip[triangles][..., 0]).mean(axis=1)
    s = strip[triangles][..., 1].mean(axis=1) / coordinates.modulus
    hosts, _ = coordinates.locate(np.mod(theta, 2 * np.pi), np.clip(s, 0, 1))
    coarse = LeafletSurface(
        vertices=points,
        triangles=triangles,
        region=surface.region[hosts],
        region_names=surface.region_names,
        fibre=at(surface.fibre[surface.triangles]),
        thickness=at(surface.thickness[surface.triangles]),
    )
    return Remeshed(coarse, rings[0], rings[1], triangle, weights)


def _edge_length(
    surface: LeafletSurface, annulus: IntArray, free_edge: IntArray, vertices: int
) -> float:
    """Edge length h with ``n = A / (sqrt(3)/2 h^2) + L / (2 h)``: edge vertices own half cells."""
    area = float(surface.areas.sum())
    perimeter = sum(
        float(np.linalg.norm(np.roll(p, -1, axis=0) - p, axis=1).sum())
        for p in (surface.vertices[annulus], surface.vertices[free_edge])
    )
    a, b = 2 * area / np.sqrt(3), perimeter / 2
    return float((b + np.sqrt(b * b + 4 * a * vertices)) / (2 * vertices))


def _sample_feature_lines(
    surface: LeafletSurface, annulus: IntArray, free_edge: IntArray, edge_length: float
) -> tuple[list[tuple[int, int, float]], list[IntArray], list[list[int]]]:
    """Points at equal arc length on both loops and on the lines between leaflets.

    Each is (vertex a, vertex b, fraction from a) on an edge of the fine surface. Also the point
    numbers of both loops and of each line.
    """
    lines = _region_lines(surface)
    corners = {end for line in lines for end in (line[0], line[-1])}
    samples: list[tuple[int, int, float]] = []
    number: dict[int, int] = {}

    def corner(vertex: int, neighbour: int) -> int:
        if vertex not in number:
            number[vertex] = len(samples)
            samples.append((vertex, neighbour, 0.0))
        return number[vertex]

    def walk(path: IntArray, minimum: int) -> list[int]:
        """Numbers of the points from the first vertex of ``path`` to the last."""
        step = np.linalg.norm(np.diff(surface.vertices[path], axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(step)])
        pieces = max(minimum, round(float(arc[-1]) / edge_length))
        result = [corner(int(path[0]), int(path[1]))]
        for target in np.arange(1, pieces) * arc[-1] / pieces:
            i = int(np.searchsorted(arc, target, side="right")) - 1
            result.append(len(samples))
            samples.append((int(path[i]), int(path[i + 1]), (target - arc[i]) / step[i]))
        return [*result, corner(int(path[-1]), int(path[-2]))]

    rings = []
    for loop in (annulus, free_edge):
        stops = [i for i, v in enumerate(loop.tolist()) if v in corners] or [0]
        loop = np.roll(loop, -stops[0])
        stops = [i - stops[0] for i in stops] + [len(loop)]
        closed = np.append(loop, loop[0])
        minimum = max(1, -(-3 // (len(stops) - 1)))
        ring: list[int] = []
        for a, b in itertools.pairwise(stops):
            ring += walk(closed[a : b + 1], minimum)[:-1]
        rings.append(np.array(ring, dtype=np.int64))
    return samples, rings, [walk(np.array(line), 1) for line in lines]


def _region_lines(surface: LeafletSurface) -> list[list[int]]:
    """Chains of edges between two leaflets, each from end to end (closed chains are left out)."""
    neighbours: dict[int, list[int]] = {}
    for a, b in edges_between(surface.triangles, surface.region).tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    done: set[tuple[int, int]] = set()
    lines = []
    for start in sorted(v for v, near in neighbours.items() if len(near) != 2):
        for second in sorted(neighbours[start]):
            if (start, second) in done:
                continue
            line = [start, second]
            while len(neighbours[line[-1]]) == 2:
                a, b = neighbours[line[-1]]
                line.append(b if a == line[-2] else a)
            done.add((line[-1], line[-2]))
            lines.append(line)
    return lines


def _on_edges(
    triangles: IntArray, points: list[tuple[int, int, float]]
) -> tuple[IntArray, FloatArray]:
    """Triangle and weights of points ``(vertex a, vertex b, fraction from a)``."""
    owner = {edge: k for k, edge in enumerate(map(tuple, edge_table(triangles)[0].tolist()))}
    triangle = np.zeros(len(points), dtype=np.int64)
    weights = np.zeros((len(points), 3))
    for k, (a, b, t) in enumerate(points):
        if (a, b) not in owner:
            a, b, t = b, a, 1 - t
        triangle[k], i = divmod(owner[a, b], 3)
        weights[k, i], weights[k, (i + 1) % 3] = 1 - t, t
    return triangle, weights


def _spread_interior(
    corner: FloatArray, area: FloatArray, fixed: FloatArray, count: int
) -> tuple[IntArray, FloatArray]:
    """Triangles and weights of interior points: farthest points, then Lloyd's iteration."""
    # Centroids of the four sub-triangles of every triangle, with a quarter of its area each.
    local = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6
    samples = np.einsum("ql,mlk->mqk", local, corner).reshape(-1, 3)
    area = np.repeat(area, 4)
    nearest = cKDTree(fixed).query(samples)[0]
    chosen = np.zeros(count, dtype=np.int64)
    for k in range(count):
        chosen[k] = np.argmax(nearest)
        nearest = np.minimum(nearest, np.linalg.norm(samples - samples[chosen[k]], axis=1))
    tree = cKDTree(samples)
    for _ in range(LLOYD_ITERATIONS if count else 0):
        generators = cKDTree(np.vstack([fixed, samples[chosen]]))
        cell = np.asarray(generators.query(samples)[1], dtype=np.int64) - len(fixed)
        inside = cell >= 0
        mass = np.bincount(cell[inside], area[inside], minlength=count)
        centre = np.stack(
            [
                np.bincount(cell[inside], area[inside] * samples[inside, i], minlength=count)
                for i in range(3)
            ],
            axis=1,
        )
        filled = mass > 0
        moved = chosen.copy()
        moved[filled] = tree.query(centre[filled] / mass[filled, None])[1]
        if np.array_equal(moved, chosen):
            break
        chosen = moved
    return chosen // 4, local[chosen % 4]


def _triangulate(
    strip: FloatArray, modulus: float, annulus: IntArray, free_edge: IntArray
) -> IntArray:
    """Delaunay triangulation of the band in the plane annulus ``exp(strip)``, the hole left out.

    The triangles run anticlockwise in the strip, which is clockwise in the plane annulus: there the
    angle follows the radius in right-hand order, in the strip the other way round.
    """
    radius = np.exp(strip[:, 1] - modulus)
    radius[annulus], radius[free_edge] = np.exp(-modulus), 1.0
    plane = radius[:, None] * np.column_stack([np.cos(strip[:, 0]), np.sin(strip[:, 0])])
    simplices = Delaunay(plane).simplices.astype(np.int64)
    in_hole = np.isin(simplices, annulus).all(axis=1)
    a, b, c = plane[simplices[:, 0]], plane[simplices[:, 1]], plane[simplices[:, 2]]
    twice_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    simplices[twice_area > 0] = simplices[twice_area > 0][:, [0, 2, 1]]
    return simplices[~in_hole]


def _flip_to_delaunay(
    points: FloatArray,
    triangles: IntArray,
    strip: FloatArray,
    locked: set[tuple[int, int]],
    rings: list[IntArray],
) -> IntArray:
    """Flip edges until the two angles opposite each one sum to at most pi on the surface.

    An edge stays if it is locked, if the flipped edge exists already, or if the flip would fold the
    triangulation over in the strip or put all corners of a triangle on one edge loop.
    """
    ring_of = np.zeros(len(points), dtype=np.int64)
    ring_of[rings[0]], ring_of[rings[1]] = 1, 2
    mesh = [list(t) for t in triangles.tolist()]
    owner: dict[tuple[int, int], int] = {}
    for number, (a, b, c) in enumerate(mesh):
        owner[a, b] = owner[b, c] = owner[c, a] = number

    def cotangent(apex: int, a: int, b: int) -> float:
        u, v = points[a] - points[apex], points[b] - points[apex]
        return float(u @ v / np.linalg.norm(np.cross(u, v)))

    def admissible(a: int, b: int, c: int) -> bool:
        u, v = strip[b] - strip[a], strip[c] - strip[a]
        x = wrapped(np.array([u[0], v[0]]))
        on_one_edge = ring_of[a] > 0 and ring_of[a] == ring_of[b] == ring_of[c]
        return bool(x[0] * v[1] - x[1] * u[1] > 1e-12) and not on_one_edge

    queue = sorted({(min(e), max(e)) for e in owner})
    flips = 0
    while queue:
        a, b = queue.pop()
        if (a, b) not in owner or (b, a) not in owner or (a, b) in locked:
            continue
        left, right = owner[a, b], owner[b, a]
        c = sum(mesh[left]) - a - b
        d = sum(mesh[right]) - a - b
        ear = any(ring_of[a] > 0 and ring_of[a] == ring_of[b] == ring_of[x] for x in (c, d))
        if not ear and cotangent(c, a, b) + cotangent(d, a, b) >= -1e-9:
            continue
        if (c, d) in owner or (d, c) in owner or not (admissible(a, d, c) and admissible(d, b, c)):
            continue
        del owner[a, b], owner[b, a]
        mesh[left], mesh[right] = [a, d, c], [d, b, c]
        owner[a, d] = owner[d, c] = owner[c, a] = left
        owner[d, b] = owner[b, c] = owner[c, d] = right
        flips += 1
        if flips > 100 * len(mesh):
            raise GeometryError("edge flips do not end: the surface given is degenerate")
        queue += [(min(e), max(e)) for e in ((a, d), (d, b), (b, c), (c, a))]
    return np.array(mesh, dtype=np.int64)


def _check_band(triangles: IntArray, rings: list[IntArray]) -> None:
    """Raise unless the boundary is exactly the two rings."""
    found = {frozenset(loop.tolist()) for loop in boundary_loops(triangles)}
    if found != {frozenset(ring.tolist()) for ring in rings}:
        raise GeometryError(
            "remeshing lost edges of the annulus or free edge; ask for more vertices"
        )
