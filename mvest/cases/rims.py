"""The two edges of a leaflet band, its commissures and ears, and matching one annulus to another.

All loops run in the direction of their triangles. With normals towards the ventricle in both
frames, two such loops run alike, so that commissures differ by which region begins there.

Ears are triangles that lie on an edge of the band with all three corners. Decimation and remeshing
leave them. The coordinate from annulus to free edge, from which fibres and chordae are laid out,
does not vary in them. Turning the edge that an ear shares with its neighbour cures it without
moving a vertex.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.triangles import directed_edges


class Rims(NamedTuple):
    """The two boundary loops of a band, as vertices in the order of the loop."""

    annulus: IntArray
    free_edge: IntArray


def loop_vector_area(points: FloatArray) -> FloatArray:
    """Vector area ``(3,)`` mm² of a closed curve ``(k, 3)``, independent of the surface in it."""
    centred = points - points.mean(axis=0)
    area: FloatArray = 0.5 * np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    return area


def find_rims(
    vertices: FloatArray,
    triangles: IntArray,
    tips: FloatArray,
    annulus: IntArray | None = None,
    free_edge: IntArray | None = None,
) -> Rims:
    """Name the two boundary loops of a band.

    The free edge is the loop nearer to the papillary tips (mean distance of its vertices from
    their nearest tips). A loop that is given keeps its order.

    Raises
    ------
    GeometryError
        Not exactly two boundary loops, or a given list is not one of them; the loop near the tips
        is the wider one, as if the tips lay on the atrial side.
    """
    loops = two_loops(vertices, triangles)
    if annulus is None and free_edge is None:
        distance = [
            np.linalg.norm(vertices[loop][:, None] - tips, axis=2).min(axis=1).mean()
            for loop in loops
        ]
        near = int(np.argmin(distance))
        area = [np.linalg.norm(loop_vector_area(vertices[loop])) for loop in loops]
        if area[near] > area[1 - near]:
            raise GeometryError(
                f"the papillary tips are nearest to the wider edge of the surface (which encloses "
                f"{area[near]:.0f} mm^2, the other {area[1 - near]:.0f} mm^2), so they seem to lie "
                f"above the annulus, on the atrial side; correct papillary_tips, or name the "
                f"annulus if this is right"
            )
        return Rims(loops[1 - near], loops[near])
    outer = None if annulus is None else _which("annulus", annulus, loops)
    inner = None if free_edge is None else _which("free_edge", free_edge, loops)
    if outer == inner:
        raise GeometryError("annulus and free_edge are the same boundary loop; expected both loops")
    return Rims(
        loops[1 - inner] if annulus is None and inner is not None else np.asarray(annulus),
        loops[1 - outer] if free_edge is None and outer is not None else np.asarray(free_edge),
    )


def two_loops(vertices: FloatArray, triangles: IntArray) -> list[IntArray]:
    """The boundary loops of a surface, or what is wrong if they are not two.

    Raises
    ------
    GeometryError
        With the size and place of the loops: those that are no annulus and no free edge are holes.
    """
    loops = boundary_loops(triangles)
    if len(loops) == 2:
        return loops
    perimeter = [
        float(np.linalg.norm(vertices[loop] - vertices[np.roll(loop, -1)], axis=1).sum())
        for loop in loops
    ]
    order = np.argsort(perimeter)[::-1]
    listed = "; ".join(
        f"{len(loops[i])} vertices, {perimeter[i]:.1f} mm round, near "
        f"{np.round(vertices[loops[i]].mean(axis=0), 1).tolist()} (vertex {int(loops[i][0])})"
        for i in order[:5]
    )
    if len(loops) > 2:
        advice = (
            f"close the {len(loops) - 2} holes (the shortest loops), or merge the vertices along "
            "the seams of its parts"
        )
    else:
        advice = "open it along the annulus and along the free edge"
    raise GeometryError(
        f"{len(loops)} boundary loops ({listed or 'none'}), expected two, the annulus and the free "
        f"edge: {advice}"
    )


def _which(name: str, wanted: IntArray, loops: list[IntArray]) -> int:
    """Number of the boundary loop that a list of vertices runs along, in either direction."""

    def edges(loop: IntArray) -> set[frozenset[int]]:
        pairs = np.stack([loop, np.roll(loop, -1)], axis=1)
        return set(map(frozenset, pairs.tolist()))

    for number, loop in enumerate(loops):
        if len(wanted) == len(loop) and set(wanted.tolist()) == set(loop.tolist()):
            if edges(wanted) == edges(loop):
                return number
            raise GeometryError(
                f"{name}: its vertices are those of a boundary loop, but not in the order of the "
                "loop; sort them so that neighbours share an edge"
            )
    best = max(loops, key=lambda loop: np.isin(loop, wanted).sum())
    missing, extra = np.setdiff1d(best, wanted), np.setdiff1d(wanted, best)
    raise GeometryError(
        f"{name} is not closed: its {len(wanted)} vertices are not one of the boundary loops "
        f"({', '.join(str(len(loop)) for loop in loops)} vertices); of the nearest it misses "
        f"{missing[:5].tolist()} ({len(missing)} in all) and has {extra[:5].tolist()} "
        f"({len(extra)} in all) besides"
    )


def directed(loop: IntArray, triangles: IntArray) -> IntArray:
    """A boundary loop in the direction of its triangles, with the same first vertex."""
    runs_along = (directed_edges(triangles) == loop[:2]).all(axis=1).any()
    return loop if runs_along else np.roll(loop[::-1], 1)


def commissures(
    loop: IntArray, triangles: IntArray, region: IntArray
) -> dict[int, tuple[int, int]]:
    """Where each region begins and ends along a loop that runs in the direction of its triangles.

    Returns
    -------
    dict
        Region to the positions (begin, end) in ``loop``; the end is where the next region begins.

    Raises
    ------
    GeometryError
        A region does not touch the loop in one piece, or there is only one region.
    """
    edges = map(tuple, directed_edges(triangles).tolist())
    region_at = dict(zip(edges, np.tile(region, 3).tolist(), strict=True))
    along = zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)
    labels = np.array([region_at[pair] for pair in along], dtype=np.int64)
    begins = np.flatnonzero(labels != np.roll(labels, 1))
    present = labels[begins]
    if len(begins) < 2:
        raise GeometryError(
            "a boundary loop belongs to one region only, so that it has no commissures"
        )
    if len(set(present.tolist())) != len(present):
        raise GeometryError(
            f"along a boundary loop the regions are {present.tolist()} one after the other; "
            "expected each once, in one piece"
        )
    ends = np.roll(begins, -1)
    return {int(r): (int(a), int(b)) for r, a, b in zip(present, begins, ends, strict=True)}


def arc_shares(loop: FloatArray, begin: int, end: int) -> tuple[IntArray, FloatArray]:
    """Positions in a closed curve from ``begin`` to ``end``, and their share of the arc length."""
    count = (end - begin) % len(loop)
    at = (begin + np.arange(count + 1)) % len(loop)
    step = np.linalg.norm(np.diff(loop[at], axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(step)])
    return at, length / length[-1]


def match_annulus(
    reference: tuple[FloatArray, IntArray, IntArray],
    reference_annulus: IntArray,
    seen: tuple[FloatArray, IntArray, IntArray],
    seen_annulus: IntArray,
) -> FloatArray:
    """Where the annulus vertices of the reference are on the annulus of another frame.

    Between two commissures a vertex keeps its share of the arc length.

    Parameters
    ----------
    reference, seen
        Vertices ``(n, 3)`` mm, triangles and regions of the two frames.
    reference_annulus, seen_annulus
        The annulus loops.

    Returns
    -------
    ndarray
        ``(k, 3)`` mm, in the order of ``reference_annulus``.

    Raises
    ------
    InputError
        The regions follow each other differently along the two loops.
    GeometryError
        No commissures.
    """
    vertices, triangles, region = reference
    loop = directed(reference_annulus, triangles)
    other = directed(seen_annulus, seen[1])
    pieces = commissures(loop, triangles, region)
    other_pieces = commissures(other, seen[1], seen[2])
    # Cyclic sequences, begun at their smallest entries.
    order, other_order = (
        np.roll(labels, -int(np.argmin(labels))) for labels in (list(pieces), list(other_pieces))
    )
    if not np.array_equal(order, other_order):
        raise InputError(
            f"along the annulus the regions follow each other as {list(other_pieces)}, in the "
            f"reference frame as {list(pieces)}"
        )
    curve, other_curve = vertices[loop], seen[0][other]
    placed = np.zeros((len(vertices), 3))
    for label, (begin, end) in pieces.items():
        at, share = arc_shares(curve, begin, end)
        other_at, other_share = arc_shares(other_curve, *other_pieces[label])
        for axis in range(3):
            placed[loop[at], axis] = np.interp(share, other_share, other_curve[other_at, axis])
    return placed[reference_annulus]


def without_ears(triangles: IntArray) -> tuple[IntArray, IntArray]:
    """The triangles with the inner edges of ears turned, where that can be done.

    What is turned depends on the numbers of the vertices alone, so that surfaces that correspond
    still do. A surface that is no band is left as it is: to refuse it is the checks' part.

    Parameters
    ----------
    triangles : ndarray
        ``(m, 3)``.

    Returns
    -------
    triangles : ndarray
        ``(m, 3)``.
    ears : ndarray
        ``(k,)`` those that were cured.
    """
    loops: list[IntArray] = []
    with suppress(GeometryError):
        loops = boundary_loops(triangles)
    if len(loops) != 2:
        return triangles, np.zeros(0, dtype=np.int64)
    loop_of = np.full(int(triangles.max()) + 1, -1)
    for number, loop in enumerate(loops):
        loop_of[loop] = number
    corners = [tuple(triangle) for triangle in triangles.tolist()]
    owner = {edge: t for t, triangle in enumerate(corners) for edge in _edges(triangle)}
    cured = []
    turned = [-1]
    while turned:
        on = loop_of[np.array(corners)]
        ears = np.flatnonzero((on[:, 0] >= 0) & (on == on[:, :1]).all(axis=1)).tolist()
        turned = [ear for ear in ears if _turn(corners, owner, ear, loop_of)]
        cured += turned
    return np.array(corners, dtype=np.int64), np.unique(np.array(cured, dtype=np.int64))


def _edges(triangle: tuple[int, ...]) -> list[tuple[int, int]]:
    a, b, c = triangle
    return [(a, b), (b, c), (c, a)]


def _turn(
    triangles: list[tuple[int, ...]],
    owner: dict[tuple[int, int], int],
    ear: int,
    loop_of: IntArray,
) -> bool:
    """Turn an inner edge of an ear, if there is a neighbour with a corner elsewhere."""
    for b, c in _edges(triangles[ear]):
        neighbour = owner.get((c, b))
        if neighbour is None:
            continue
        (a,) = set(triangles[ear]) - {b, c}
        (d,) = set(triangles[neighbour]) - {b, c}
        # The turned edge must be new: two sheets would be joined otherwise.
        if loop_of[d] == loop_of[a] or (a, d) in owner or (d, a) in owner:
            continue
        del owner[b, c], owner[c, b]
        for t, triangle in ((ear, (a, b, d)), (neighbour, (a, d, c))):
            triangles[t] = triangle
            owner.update(dict.fromkeys(_edges(triangle), t))
        return True
    return False
