"""Splits the closed surface of a thick leaflet band into two walls, at annulus and free edge.

A segmented surface does not state which of its triangles face the atrium. But opposite points
across the tissue belong to different walls, and neighbours on a smooth part of the surface to the
same wall. The sign of the lowest eigenvector of a signed graph Laplacian satisfies both conditions
best (Kunegis et al. 2010, SIAM Int. Conf. Data Mining, section 4). The largest inner ball touching
the surface at a vertex gives the opposite point (shrinking balls: Ma, Bae and Choi 2012, Vis.
Comput. 28:7).
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.spatial import cKDTree

from mvest.errors import GeometryError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import lumped_areas, vertex_normals
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.triangles import connected_pieces, euler_number, surface_edges

MAX_THICKNESS = 8.0
"""Diameter of the first ball, mm; diseased leaflets are up to 5 mm thick."""
BALL_ROUNDS = 40
MIN_SEPARATION = np.cos(np.radians(40.0))
"""Shrinking stops at this cosine of the angle between a ball's two contacts, seen from its centre.
A smaller angle means roughness of the same wall."""
OPPOSITE = -0.6
"""Largest scalar product of the normals of two opposite points."""
ACROSS_WEIGHT = 0.1
"""Weight of an opposite pair, relative to two neighbours on a plane."""
EDGE_SHARE = 0.1
"""Smallest distance of the dividing line from both ends of an edge, relative to its length."""


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """One wall of a thick band: itself a band, with triangles facing out of the tissue."""

    vertices: FloatArray  #: (n, 3) mm
    triangles: IntArray  #: (m, 3)
    #: two (k,) arrays, its boundary; each loop has the same points in the same order in both walls
    loops: tuple[IntArray, IntArray]


def closed_band(vertices: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """Check that a closed surface bounds one thick band, and turn its normals outwards.

    GeometryError if the surface is open, invalid or in several pieces, or has not exactly one hole
    (Euler number 0): there is no orifice, or leaflets that only touch are joined.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    triangles = np.asarray(triangles, dtype=np.int64)
    check_surface(vertices, triangles, self_intersections=False, name="thick leaflets")
    loops = boundary_loops(triangles)
    if loops:
        raise GeometryError(
            f"thick leaflets: open surface with {len(loops)} holes, the first near "
            f"{np.round(vertices[loops[0]].mean(axis=0), 1).tolist()}; expected a closed one"
        )
    used, inverse = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[used], inverse.reshape(-1, 3)
    if enclosed_volume(vertices, triangles) < 0:
        triangles = triangles[:, ::-1]
    edges = surface_edges(triangles)
    pieces, label = connected_pieces(edges, len(vertices))
    if pieces > 1:
        sizes = np.sort(np.bincount(label))[::-1]
        raise GeometryError(
            f"thick leaflets: {pieces} pieces ({', '.join(map(str, sizes[:5]))} vertices), "
            "expected one closed surface round the orifice; give parted leaflets one by one"
        )
    euler = euler_number(triangles)
    if euler != 0:
        what = (
            "no orifice, as if leaflets that touch were one; give a label or a surface for each"
            if euler == 2
            else f"{1 - euler // 2} holes, expected the orifice alone: close those of the leaflets"
        )
        raise GeometryError(f"thick leaflets: Euler number {euler}, expected 0: {what}")
    return vertices, triangles


def walls(vertices: FloatArray, triangles: IntArray) -> tuple[Wall, Wall]:
    """Split a closed surface from `closed_band` into its two walls.

    GeometryError if the parts are not two bands with common edges: the leaflets are not thin.
    """
    side = _sides(vertices, triangles)
    points, faces, upper = _parted(vertices, triangles, side)
    parts = []
    for chosen in (upper, ~upper):
        own = faces[chosen]
        loops = boundary_loops(own)
        used, inverse = np.unique(own, return_inverse=True)
        euler = euler_number(own)
        if len(loops) != 2 or euler != 0:
            raise GeometryError(
                f"thick leaflets: one wall has {len(loops)} edges and Euler number {euler}, "
                "expected an annulus and a free edge: the surface is no thin sheet everywhere"
            )
        parts.append((used, inverse.reshape(-1, 3), loops))
    # The other wall's loops run backwards, so both walls use those of the first.
    number = [np.full(len(points), -1) for _ in parts]
    for own, (used, _, _) in zip(number, parts, strict=True):
        own[used] = np.arange(len(used))
    first, second = (
        Wall(points[used], own, (n[parts[0][2][0]], n[parts[0][2][1]]))
        for n, (used, own, _) in zip(number, parts, strict=True)
    )
    return first, second


def _graph(edges: IntArray, weight: FloatArray, n: int) -> sp.csr_matrix:
    half = sp.coo_matrix((weight, edges.T), shape=(n, n))
    return (half + half.T).tocsr()


def _across(vertices: FloatArray, normals: FloatArray) -> IntArray:
    """Index ``(n,)`` of the vertex across the tissue from each vertex; -1 if none was found."""
    tree = cKDTree(vertices)
    n = len(vertices)
    radius = np.full(n, 0.5 * MAX_THICKNESS)
    contact = np.full(n, -1)
    active = np.arange(n)
    for _ in range(BALL_ROUNDS):
        centre = vertices[active] - radius[active, None] * normals[active]
        # The two nearest: one of them may be the vertex itself.
        distance, near = (np.asarray(found) for found in tree.query(centre, k=2))
        own = near[:, 0] == active
        other = np.where(own, near[:, 1], near[:, 0])
        reach = np.where(own, distance[:, 1], distance[:, 0])
        apart = vertices[active] - vertices[other]
        across = np.einsum("ij,ij->i", apart, normals[active])
        shrinks = (reach < radius[active] * (1 - 1e-3)) & (across > 1e-9)
        smaller = np.einsum("ij,ij->i", apart, apart) / np.maximum(2 * across, 1e-9)
        at = vertices[active] - smaller[:, None] * normals[active]
        separation = np.einsum("ij,ij->i", vertices[active] - at, vertices[other] - at)
        rough = separation > MIN_SEPARATION * smaller**2
        go = shrinks & ~rough
        active, other = active[go], other[go]
        radius[active], contact[active] = smaller[go], other
        if not active.size:
            break
    return contact


def _sides(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """A value ``(n,)`` per vertex, positive on one wall and negative on the other."""
    normals = vertex_normals(vertices, triangles)
    edges = surface_edges(triangles)
    n = len(vertices)
    alike = np.einsum("ij,ij->i", normals[edges[:, 0]], normals[edges[:, 1]])
    near = _graph(edges, np.maximum(alike, 0.05) ** 4, n)
    contact = _across(vertices, normals)
    known = np.flatnonzero(contact >= 0)
    other = contact[known]
    facing = np.einsum("ij,ij->i", normals[known], normals[other])
    good = facing < OPPOSITE
    known, other, facing = known[good], other[good], facing[good]
    if len(known) < 0.2 * n:
        raise GeometryError(
            f"thick leaflets: {len(known)} of {n} vertices have tissue of at most "
            f"{MAX_THICKNESS:g} mm and a wall across it; expected thin leaflets, lengths in mm"
        )
    far = _graph(np.column_stack([known, other]), ACROSS_WEIGHT * -facing, n)
    degree = np.asarray((near + far).sum(axis=1)).ravel()
    signed = sp.diags(degree) - near + far
    mass = lumped_areas(vertices, triangles)
    scale = sp.diags(1 / np.sqrt(mass / mass.mean()))
    start = np.random.default_rng(0).normal(size=n)
    _, vector = spla.eigsh((scale @ signed @ scale).tocsc(), k=1, sigma=-1e-6, v0=start)
    side = np.asarray(scale @ vector[:, 0])
    return _in_two_pieces(side / np.abs(side).max(), edges)


def _in_two_pieces(side: FloatArray, edges: IntArray) -> FloatArray:
    """Flip isolated islands of either sign, so that each sign forms one piece."""
    side = side.copy()
    for sign in (1, -1):
        within = side * sign > 0
        inner = edges[within[edges].all(axis=1)]
        _, label = connected_pieces(inner, len(side))
        largest = np.bincount(label[within]).argmax()
        island = within & (label != largest)
        side[island] *= -1
    return side


def _parted(
    vertices: FloatArray, triangles: IntArray, side: FloatArray
) -> tuple[FloatArray, IntArray, BoolArray]:
    """Cut the triangles along the line where `side` is zero.

    Returns
    -------
    vertices, triangles
        ``(n + k, 3)`` and ``(m', 3)``.
    upper
        ``(m',)`` whether `side` is positive on a triangle.
    """
    above = side > 0
    edges = surface_edges(triangles)
    cut = edges[above[edges[:, 0]] != above[edges[:, 1]]]
    share = side[cut[:, 0]] / (side[cut[:, 0]] - side[cut[:, 1]])
    share = np.clip(share, EDGE_SHARE, 1 - EDGE_SHARE)[:, None]
    points = (1 - share) * vertices[cut[:, 0]] + share * vertices[cut[:, 1]]
    n = len(vertices)
    number = {(a, b): n + i for i, (a, b) in enumerate(cut.tolist())}
    corner_above = above[triangles]
    count = corner_above.sum(axis=1)
    whole = (count == 0) | (count == 3)
    faces, upper = triangles[whole].tolist(), corner_above[whole, 0].tolist()
    for triangle, states, c in zip(
        triangles[~whole].tolist(),
        corner_above[~whole].tolist(),
        count[~whole].tolist(),
        strict=True,
    ):
        alone = states.index(c == 1)
        a, b, d = (triangle[(alone + k) % 3] for k in range(3))
        ab, ad = number[min(a, b), max(a, b)], number[min(a, d), max(a, d)]
        faces += [[a, ab, ad], [ab, b, d], [ab, d, ad]]
        upper += [c == 1, c != 1, c != 1]
    return (
        np.concatenate([vertices, points]),
        np.array(faces, dtype=np.int64),
        np.array(upper, dtype=np.bool_),
    )
