"""A band of leaflets: its boundary loops, commissures and ears, and its checks.

All loops run in the direction of their triangles. With normals towards the ventricle in both
frames, two such loops have the same direction, so that commissures differ by the region that begins
there.

Ears are triangles with all three corners on one edge of the band. Decimation and remeshing leave
them. The coordinate from annulus to free edge, from which fibres and chordae are laid out, is
constant in them. Flipping the edge that an ear shares with its neighbour removes it without moving
a vertex.

Each check raises one error for the first fault: what is wrong and what would be right. The reader
of a case adds file and field.
"""

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import pdist

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_checks import check_surface
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.triangles import (
    arc_length,
    connected_pieces,
    directed_edges,
    loop_length,
    surface_edges,
)

ANNULUS_DIAMETER = (15.0, 80.0)
"""mm, largest extent of an annulus, from a small child's to the most dilated adult's."""
CLOSING_PRESSURE = (20.0, 250.0)
"""mmHg, transmitral pressure on a closed valve."""
LARGEST_THICKNESS = 5.0
"""mm."""
FARTHEST_TIP = 100.0
"""mm from the centre of the annulus."""


class Loops(NamedTuple):
    """The two boundary loops of a band, as vertices in the order of the loop."""

    annulus: IntArray
    free_edge: IntArray


def loop_vector_area(points: FloatArray) -> FloatArray:
    """Vector area ``(3,)`` mm² of a closed curve ``(k, 3)``, independent of the surface in it."""
    centred = points - points.mean(axis=0)
    area: FloatArray = 0.5 * np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    return area


def find_loops(
    vertices: FloatArray,
    triangles: IntArray,
    tips: FloatArray,
    annulus: IntArray | None = None,
    free_edge: IntArray | None = None,
) -> Loops:
    """Identify annulus and free edge among the two boundary loops of a band.

    The free edge is the loop nearer to the papillary tips (mean distance of its vertices from
    their nearest tips). A given loop keeps its order.

    GeometryError if there are not exactly two boundary loops, or a given list is not one of them;
    the loop near the tips is the wider one, as if the tips were on the atrial side.
    """
    loops = two_loops(vertices, triangles)
    outer = None if annulus is None else _which("annulus", annulus, loops)
    inner = None if free_edge is None else _which("free_edge", free_edge, loops)
    if outer is None and inner is None:
        curves = [vertices[loop] for loop in loops]
        away = [np.linalg.norm(x[:, None] - tips, axis=2).min(axis=1).mean() for x in curves]
        inner, area = int(np.argmin(away)), [np.linalg.norm(loop_vector_area(x)) for x in curves]
        if area[inner] > area[1 - inner]:
            raise GeometryError(
                f"the papillary tips are nearest to the wider edge of the surface (which encloses "
                f"{area[inner]:.0f} mm^2, the other {area[1 - inner]:.0f} mm^2), so they seem to "
                "lie above the annulus, on the atrial side; correct papillary_tips, or name the "
                "annulus if this is right"
            )
    if outer is None:
        outer = 1 - (inner or 0)
    inner = 1 - outer if inner is None else inner
    if outer == inner:
        raise GeometryError("annulus and free_edge are the same boundary loop; expected both loops")
    return Loops(
        loops[outer] if annulus is None else np.asarray(annulus),
        loops[inner] if free_edge is None else np.asarray(free_edge),
    )


def two_loops(vertices: FloatArray, triangles: IntArray) -> list[IntArray]:
    """The two boundary loops of a surface.

    GeometryError with size and position of the loops if there are not two: further ones are holes.
    """
    loops = boundary_loops(triangles)
    if len(loops) == 2:
        return loops
    perimeter = [loop_length(vertices[loop]) for loop in loops]
    order = np.argsort(perimeter)[::-1]
    listed = "; ".join(
        f"{len(loops[i])} vertices, {perimeter[i]:.1f} mm round, near "
        f"{np.round(vertices[loops[i]].mean(axis=0), 1).tolist()} (vertex {int(loops[i][0])})"
        for i in order[:5]
    )
    advice = "open it along the annulus and along the free edge"
    if len(loops) > 2:
        advice = (
            f"close the {len(loops) - 2} holes (the shortest loops), or merge the vertices along "
            "the seams of its parts"
        )
    raise GeometryError(
        f"{len(loops)} boundary loops ({listed or 'none'}), expected two, the annulus and the free "
        f"edge: {advice}"
    )


def _which(name: str, wanted: IntArray, loops: list[IntArray]) -> int:
    """Number of the boundary loop with a list of vertices, in either direction."""

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
        f"{missing[:5].tolist()} ({len(missing)} in all) and adds {extra[:5].tolist()} "
        f"({len(extra)} in all)"
    )


def directed(loop: IntArray, triangles: IntArray) -> IntArray:
    """A boundary loop in the direction of its triangles, with the same first vertex."""
    runs_along = (directed_edges(triangles) == loop[:2]).all(axis=1).any()
    return loop if runs_along else np.roll(loop[::-1], 1)


def commissures(
    loop: IntArray, triangles: IntArray, region: IntArray
) -> dict[int, tuple[int, int]]:
    """Positions (begin, end) of each region in a loop that runs in the direction of its triangles.

    The end is where the next region begins. GeometryError if a region does not touch the loop in
    one piece, or there is only one region.
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
    length = arc_length(loop[at])
    return at, length / length[-1]


def match_annulus(
    reference: tuple[FloatArray, IntArray, IntArray],
    reference_annulus: IntArray,
    seen: tuple[FloatArray, IntArray, IntArray],
    seen_annulus: IntArray,
) -> FloatArray:
    """Positions ``(k, 3)`` mm of the reference's annulus vertices on the annulus of another frame.

    Between two commissures a vertex keeps its share of the arc length. Frames are vertices
    ``(n, 3)`` mm, triangles and regions. The result has the order of ``reference_annulus``.
    InputError if the regions follow each other differently along the two loops, GeometryError if
    there are no commissures.
    """
    vertices, triangles, region = reference
    loop = directed(reference_annulus, triangles)
    other = directed(seen_annulus, seen[1])
    pieces = commissures(loop, triangles, region)
    other_pieces = commissures(other, seen[1], seen[2])
    # Cyclic sequences, rotated to begin with their smallest entries.
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
    """Flip the inner edges of ears, if possible; returns the triangles and the numbers of the ears.

    The result depends on the numbers of the vertices alone, so that surfaces that correspond still
    do. A surface that is not a band is returned unchanged, for the checks to refuse it.
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
    triangles: list[tuple[int, ...]], owner: dict[tuple[int, int], int], ear: int, loop_of: IntArray
) -> bool:
    """Flip an inner edge of an ear, if a neighbour has a corner elsewhere."""
    for b, c in _edges(triangles[ear]):
        neighbour = owner.get((c, b))
        if neighbour is None:
            continue
        (a,) = set(triangles[ear]) - {b, c}
        (d,) = set(triangles[neighbour]) - {b, c}
        # The flipped edge must be new: two sheets would be joined otherwise.
        if loop_of[d] == loop_of[a] or (a, d) in owner or (d, a) in owner:
            continue
        del owner[b, c], owner[c, b]
        for t, triangle in ((ear, (a, b, d)), (neighbour, (a, d, c))):
            triangles[t] = triangle
            owner.update(dict.fromkeys(_edges(triangle), t))
        return True
    return False


# -- checks ---------------------------------------------------------------------------------------
def check_band(vertices: FloatArray, triangles: IntArray, *, self_intersections: bool) -> None:
    """Raise unless a surface is a band: connected, oriented, two boundary loops and no handle.

    Every vertex must belong to a triangle.
    """
    check_surface(vertices, triangles, self_intersections=False)
    unused = np.setdiff1d(np.arange(len(vertices)), triangles)
    if len(unused):
        raise GeometryError(
            f"vertices {unused[:5].tolist()} ({len(unused)} in all) belong to no triangle; remove "
            "them"
        )
    edges, n = surface_edges(triangles), len(vertices)
    pieces, label = connected_pieces(edges, n)
    if pieces > 1:
        sizes = np.bincount(label).tolist()
        raise GeometryError(
            f"{pieces} pieces that do not touch ({', '.join(map(str, sizes[:5]))} vertices); "
            "expected one surface round the valve, its parts sharing the vertices of their seams"
        )
    # Last, since parts with double vertices along their seams pass through each other there.
    if self_intersections:
        check_surface(vertices, triangles)
    two_loops(vertices, triangles)
    euler = n - len(edges) + len(triangles)
    if euler != 0:
        raise GeometryError(
            f"Euler number {euler}, expected 0: the surface has {-euler // 2} handles, where "
            "leaflets that only touch were joined"
        )


def check_annulus_size(annulus: FloatArray) -> None:
    """Raise if the largest extent (mm) of the annulus is not that of a valve."""
    size = float(pdist(annulus).max())
    low, high = ANNULUS_DIAMETER
    if not low <= size <= high:
        factors = (("m", 1000.0), ("cm", 10.0), ("mm", 0.1), ("mm", 0.001))
        fits = [unit for unit, factor in factors if low <= size * factor <= high]
        guess = f" (its numbers would fit {fits[0]} instead)" if fits else ""
        raise GeometryError(
            f"the annulus is {size:.3g} mm across, expected {low:g} to {high:g} mm: is "
            f"units.length right?{guess}"
        )


def ventricular_side(annulus: FloatArray, free_edge: FloatArray) -> float:
    """1 if the vector area of an annulus (in its order) points to the free edge, else -1."""
    down = free_edge.mean(axis=0) - annulus.mean(axis=0)
    return 1.0 if down @ loop_vector_area(annulus) > 0 else -1.0


def check_tips(annulus: FloatArray, side: float, tips: FloatArray) -> None:
    """Raise if a papillary tip is not on the ventricular side of the annulus, or is too far away.

    ``side`` is `ventricular_side` of the open frame; the annulus has the same order here.
    """
    centre = annulus.mean(axis=0)
    normal = side * loop_vector_area(annulus)
    below = (tips - centre) @ (normal / np.linalg.norm(normal))
    if below.min() <= 0:
        k = int(np.argmin(below))
        raise GeometryError(
            f"tip {k} at {np.round(tips[k], 2).tolist()} mm lies {-below[k]:.1f} mm above the "
            "annulus, on the atrial side; expected below it, on the side of the free edge"
        )
    distance = np.linalg.norm(tips - centre, axis=1)
    if distance.max() > FARTHEST_TIP:
        k = int(np.argmax(distance))
        raise GeometryError(
            f"tip {k} is {distance[k]:.0f} mm from the centre of the annulus, expected at most "
            f"{FARTHEST_TIP:g} mm: is it in the same unit and the same axes as the surface?"
        )


def check_normals(
    vertices: FloatArray, triangles: IntArray, annulus: IntArray, tips: FloatArray
) -> None:
    """Raise unless the triangles face the ventricle.

    The vector area of the annulus in the direction of its triangles has their side, whatever the
    position of the leaflets and the width of the orifice. Inner edges cancel in pairs.
    """
    edges = directed_edges(triangles)
    start, end = np.moveaxis(vertices[edges[np.isin(edges, annulus).all(axis=1)]], 1, 0)
    area = np.cross(start, end).sum(axis=0)
    towards = tips.mean(axis=0) - vertices[annulus].mean(axis=0)
    if area @ towards <= 0:
        raise GeometryError(
            "flipped normals: the triangles face the atrium, expected the ventricle, where the "
            "papillary tips are; reverse every triangle"
        )


def check_thickness(thickness: FloatArray) -> None:
    """Raise unless every thickness (mm) is positive and at most `LARGEST_THICKNESS`."""
    bad = np.flatnonzero(~((thickness > 0) & (thickness <= LARGEST_THICKNESS)))
    if len(bad):
        k = int(bad[0])
        raise GeometryError(
            f"{thickness[k]:g} mm at vertex {k} ({len(bad)} vertices in all), expected above 0 and "
            f"at most {LARGEST_THICKNESS:g} mm"
        )


def check_closing_pressure(pressure_mmhg: float, unit: str) -> None:
    """Raise if the pressure on the closed valve cannot close a mitral valve."""
    low, high = CLOSING_PRESSURE
    if not low <= pressure_mmhg <= high:
        other = "kPa" if unit == "mmHg" else "mmHg"
        raise InputError(
            f"{pressure_mmhg:g} mmHg on the closed valve, expected {low:g} to {high:g} mmHg: is it "
            f"in {other} (the unit given is {unit})? A positive pressure closes the valve"
        )
