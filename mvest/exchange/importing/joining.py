"""Join two separate leaflet surfaces along their commissures to the band of a case.

Each leaflet is a disc: its boundary runs along the annulus from one commissure to the other, and
back along the free edge. At a commissure the boundaries of both leaflets run side by side before
the free edges part; a strip of triangles joins them there. The band is then remeshed along its
coordinate lines, with triangles of equal size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.band import loop_vector_area, two_loops, without_ears
from mvest.cases.tissue import LeafletBand
from mvest.errors import GeometryError
from mvest.exchange.importing.written import REGIONS
from mvest.exchange.surfaces import Surface, merged
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import BandGrid, band_grid
from mvest.valve.geometry.moving_distance import closest_on_loop
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.thickening import smooth_vertex_normals
from mvest.valve.geometry.triangles import (
    arc_length,
    areas,
    connected_pieces,
    directed_edges,
    loop_length,
    surface_edges,
)

COINCIDENT = 1e-6
"""Merge distance (mm) of the vertices of both leaflets."""
EDGE_MM = 0.7
"""Mean edge length of the triangles of a band; coarser ones cut folds short. With 1 mm posterior
leaflets stretched by 0.3 percentage points too little, with this by 0.1 (two simulated valves)."""
SEAM_MM = 1.5
"""Largest gap between boundaries that is bridged at a commissure."""
MAX_HOLE = 0.2
"""Holes are closed if their boundary, relative to that of the leaflet, is at most this long."""
MAX_GAP = 6.0
"""Largest distance (mm) between leaflets at a commissure, and of a commissure from them."""
MAX_MISS = 8.0
"""Largest distance (mm) along a leaflet's boundary of a marked commissure from the true one."""
CORNER, SETTLED = 3.0, 0.15
"""At a corner the distance to the other leaflet comes within the second length (mm) of its smallest
value, which is searched over the first length (mm)."""
OPENING = 0.4
"""Free edges begin to part where their distance exceeds that at the corner by this (mm)."""
CURL_AT, CURLED = (0.0, 0.6, 1.5, 2.5), 0.85
"""A side curls round a rim if its directions in the first and last interval between these distances
(mm) from an edge have at most this cosine (32 degrees or more; other surfaces have under 10).
"""
RIM_ROUNDS, SHRINK, SWELL = 2, 0.5, -0.53
"""Smoothing rounds of an edge, each a step that shrinks it and one that lengthens it again (Taubin,
SIGGRAPH 1995, 351). Waves of more than 13 vertices stay, so that leaflets keep their area."""
MAX_SEAM = 0.25
"""Largest joined fraction of a free edge, from commissure to commissure."""


@dataclass(frozen=True, slots=True, eq=False)
class Leaflet:
    """One leaflet as a disc: ``(n, 3)`` mm, ``(m, 3)``, and its boundary ``(k,)``.

    ``loop`` follows the triangles' orientation; ``holes`` is the number of holes that were closed.
    """

    vertices: FloatArray
    triangles: IntArray
    loop: IntArray
    holes: int

    @classmethod
    def of(cls, vertices: FloatArray, triangles: IntArray) -> Leaflet:
        """The largest piece of a surface, with merged vertices and closed holes.

        GeometryError if the piece is closed, not a manifold, or has a second long boundary.
        """
        whole = merged(Surface(vertices, triangles))
        points, faces = whole.vertices, whole.triangles
        apart = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        faces = faces[apart & (areas(points, faces) > 0)]
        piece = connected_pieces(surface_edges(faces), len(points))[1][faces[:, 0]]
        faces = faces[piece == np.argmax(np.bincount(piece, weights=areas(points, faces)))]
        loops = sorted(boundary_loops(faces), key=lambda loop: -loop_length(points[loop]))
        if not loops:
            raise GeometryError(
                "a closed surface, expected one side of a leaflet: an open surface that ends at "
                "the annulus and at the free edge"
            )
        outer, *holes = loops
        for hole in holes:
            around = [loop_length(points[loop]) for loop in (outer, hole)]
            if around[1] > MAX_HOLE * around[0]:
                raise GeometryError(
                    f"boundaries of {around[0]:.0f} and {around[1]:.0f} mm, expected one: a "
                    "leaflet that ends at the annulus and at the free edge"
                )
            middle = np.full(len(hole), len(points))
            faces = np.vstack([faces, np.column_stack([np.roll(hole, -1), hole, middle])])
            points = np.vstack([points, points[hole].mean(axis=0)])
        used, inverse = np.unique(faces, return_inverse=True)
        loop = np.searchsorted(used, outer)
        return cls(points[used], inverse.reshape(-1, 3), loop, len(holes))

    @property
    def curve(self) -> FloatArray:
        """The boundary, ``(k, 3)`` mm."""
        return self.vertices[self.loop]

    def arcs(self, ends: FloatArray) -> tuple[IntArray, IntArray]:
        """The part of the loop between the vertices nearest to two points ``(2, 3)``, and the rest.

        Both arcs include both ends.
        """
        start, stop = (int(np.argmin(np.linalg.norm(self.curve - end, axis=1))) for end in ends)
        if start == stop:
            raise GeometryError(
                "both commissures are at the same vertex of a leaflet; are they those of this "
                "valve, in the same axes?"
            )
        turned = np.roll(self.loop, -start)
        cut = (stop - start) % len(turned)
        return turned[: cut + 1], np.append(turned[cut:], turned[0])


def united(segments: Sequence[Leaflet]) -> Leaflet:
    """One leaflet from its segments (scallops), joined where their boundaries run side by side.

    GeometryError if a segment is farther than `SEAM_MM` from all others, or touches one at a point
    only.
    """
    whole, *rest = segments
    while rest:
        near = [_nearest(whole.curve, other.curve)[0] <= SEAM_MM for other in rest]
        other = rest.pop(int(np.argmax([own.sum() for own in near])))
        away, number = _nearest(whole.curve, other.curve)
        # Roll the loop to begin with the first vertex of the run that is near the other segment.
        beside = away <= SEAM_MM
        begins = np.flatnonzero(beside & ~np.roll(beside, 1))
        if len(begins) != 1 or beside.sum() < 2:
            raise GeometryError(
                f"segments of a leaflet, {away.min():.1f} mm apart, run side by side along "
                f"{len(begins)} parts of their boundaries, expected one within {SEAM_MM:g} mm"
            )
        run = np.roll(np.arange(len(away)), -int(begins[0]))[: int(beside.sum())]
        first, last = number[run[[0, -1]]]
        k = len(other.loop)
        ways = [
            np.arange(first, first + (last - first) % k + 1) % k,
            np.arange(first, first - (first - last) % k - 1, -1) % k,
        ]
        opposite = min(ways, key=lambda way: _nearest(other.curve[way], whole.curve)[0].mean())
        faces, n = other.triangles, len(whole.vertices)
        # The boundaries of two surfaces of the same orientation run against each other.
        faces = faces[:, ::-1] if opposite is ways[0] else faces
        vertices = np.concatenate([whole.vertices, other.vertices])
        strip, _, _ = _strip(vertices, whole.loop[run], n + other.loop[opposite])
        holes = whole.holes + other.holes
        joined_ = Leaflet.of(vertices, np.concatenate([whole.triangles, faces + n, strip]))
        whole = replace(joined_, holes=holes + joined_.holes)
    return whole


def commissures_on(contour: FloatArray, leaflets: Sequence[Leaflet]) -> FloatArray:
    """The two points ``(2, 3)`` of a contour at which the nearer leaflet changes.

    GeometryError if the nearer leaflet does not change exactly twice.
    """
    distance = [_nearest(contour, leaflet.curve)[0] for leaflet in leaflets]
    difference = distance[0] - distance[1]  # smoothed over a few mm
    width = max(1, round(0.02 * len(contour)))
    nearer = sum(np.roll(difference, k) for k in range(-width, width + 1)) < 0
    changes = np.flatnonzero(nearer != np.roll(nearer, 1))
    if len(changes) != 2:
        raise GeometryError(
            f"along the annulus the nearer leaflet changes {len(changes)} times, expected twice; "
            "give the commissures as landmarks ALC and PMC"
        )
    return contour[changes]


def joined(
    leaflets: Sequence[Leaflet],
    commissures: FloatArray,
    contour: FloatArray | None,
    down: FloatArray,
    *,
    offset_mm: tuple[float, float] | None,
    seams: FloatArray | None = None,
) -> tuple[Surface, FloatArray, float]:
    """Join the anterior and posterior leaflets into a band that faces the ventricle.

    GeometryError if the commissures are far from the leaflets, the surfaces are not leaflets, or
    the band's coordinates fold over.

    Parameters
    ----------
    leaflets
        Anterior, posterior.
    commissures, contour
        ``(2, 3)`` mm; closed curve along the annulus, ``(k, 3)`` mm, or None.
    down
        ``(3,)`` direction from the annulus to the ventricle.
    offset_mm
        Shifts of the anterior and the posterior leaflet towards the ventricle: half a thickness
        turns an atrial surface into the midsurface. None: half the template's thickness.
    seams : (2, 2) or None
        Joined fraction of each leaflet's free edge (columns) at each commissure (rows). A closed
        valve needs the value of an open frame, because its edges touch all along.

    Returns the surface with the regions 0 (anterior) and 1 (posterior), the seams, and the largest
    width (mm) of the strips of triangles.
    """
    for name, leaflet in zip(REGIONS, leaflets, strict=True):
        away = float(_nearest(commissures, leaflet.curve)[0].max())
        if away > MAX_GAP:
            raise GeometryError(
                f"the {name} leaflet ends {away:.1f} mm from a commissure, expected at most "
                f"{MAX_GAP:g} mm: do leaflets and annulus have the same axes and phase?"
            )
    front, *arcs = _facing_ventricle(leaflets[0], leaflets[1], commissures, contour, down)
    back, *others = _facing_ventricle(leaflets[1], leaflets[0], commissures, contour, down)
    ends, begins = front.vertices[arcs[0][[-1, 0]]], back.vertices[others[0][[0, -1]]]
    gap = np.linalg.norm(ends - begins, axis=1)
    if gap.sum() > np.linalg.norm(ends - begins[::-1], axis=1).sum():
        raise GeometryError("both leaflets lie on the same side of the commissures")
    if gap.max() > MAX_GAP:
        raise GeometryError(
            f"the leaflets are {gap.max():.1f} mm apart at a commissure, expected at most "
            f"{MAX_GAP:g} mm"
        )
    vertices = np.concatenate([front.vertices, back.vertices])
    faces = [front.triangles, back.triangles + len(front.vertices)]
    region = [np.full(len(own), k) for k, own in enumerate(faces)]
    edges = (arcs[1], others[1] + len(front.vertices))
    same, shares, gaps = np.arange(len(vertices)), np.zeros((2, 2)), []
    # One leaflet's free edge begins where the other's ends.
    for k in range(2):
        a, b = edges[k], edges[1 - k][::-1]
        given = None if seams is None else (seams[k, k], seams[k, 1 - k])
        i, j = _seam(vertices[a], vertices[b], given)
        shares[k, k], shares[k, 1 - k] = _shares(vertices[a])[i], _shares(vertices[b])[j]
        a, b = a[: i + 1], b[: j + 1]
        strip, sides, width = _strip(vertices, a, b)
        distance, nearest = _nearest(vertices[b], vertices[a])
        same[b[distance < COINCIDENT]] = a[nearest[distance < COINCIDENT]]
        faces.append(strip)
        region.append(np.where(sides == 0, k, 1 - k))
        gaps.append(width)
    corners, labels = same[np.concatenate(faces)], np.concatenate(region)
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    # A strip may lie back to back on a triangle of a leaflet; both are left out.
    _, same_three, times = np.unique(
        np.sort(corners, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    proper &= times[same_three.ravel()] == 1
    used, inverse = np.unique(corners[proper], return_inverse=True)
    triangles, _ = without_ears(inverse.reshape(-1, 3))
    middle = np.searchsorted(used, same[arcs[0][len(arcs[0]) // 2]])
    loops = sorted(two_loops(vertices[used], triangles), key=lambda loop: middle not in loop)
    around = 0.5 * sum(loop_length(vertices[used][loop]) for loop in loops)
    points, triangles, labels = _without_chords(vertices[used], triangles, labels[proper], loops)
    band = LeafletBand.of(points, triangles, labels, loops[0], loops[1], 0)
    along = areas(points, triangles).sum() / around
    columns = 4 * max(6, round(around / EDGE_MM / 4))
    grid = band_grid(columns, 1 + max(4, round(along / EDGE_MM)))
    return _drawn(band, labels, grid, columns, offset_mm), shares, max(gaps)


def _without_chords(
    vertices: FloatArray, triangles: IntArray, region: IntArray, loops: Sequence[IntArray]
) -> tuple[FloatArray, IntArray, IntArray]:
    """Split the inner edges between two vertices of one loop, beyond which no coordinate varies."""
    on = np.zeros(len(vertices), dtype=np.int64)
    for number, loop in enumerate(loops, 1):
        on[loop] = number
    edges, times = np.unique(np.sort(directed_edges(triangles), axis=1), axis=0, return_counts=True)
    a, b = edges.T
    chords = edges[(times == 2) & (on[a] > 0) & (on[a] == on[b])]
    points, faces, labels = [vertices], triangles, region
    for k, (start, end) in enumerate(chords, len(vertices)):
        points.append(0.5 * (vertices[start] + vertices[end])[None])
        beside = (faces == start).any(axis=1) & (faces == end).any(axis=1)
        halves = [np.where(faces[beside] == corner, k, faces[beside]) for corner in (start, end)]
        faces = np.concatenate([faces[~beside], *halves])
        labels = np.concatenate([labels[~beside], labels[beside], labels[beside]])
    return np.concatenate(points), faces, labels


def _facing_ventricle(
    leaflet: Leaflet,
    other: Leaflet,
    commissures: FloatArray,
    contour: FloatArray | None,
    down: FloatArray,
) -> tuple[Leaflet, IntArray, IntArray]:
    """The leaflet oriented towards the ventricle, and its arcs of annulus and free edge."""
    turned = replace(leaflet, triangles=leaflet.triangles[:, ::-1], loop=leaflet.loop[::-1])
    for candidate in (leaflet, turned):
        arcs = candidate.arcs(commissures)
        to = other.vertices if contour is None else contour
        away = [float(_nearest(candidate.vertices[arc], to)[0].mean()) for arc in arcs]
        # The annulus is the arc nearer to the contour, or else farther from the other leaflet.
        annulus = arcs[int(np.argmax(away) if contour is None else np.argmin(away))]
        ring = np.vstack([candidate.vertices[annulus], other.curve.mean(0)])
        if loop_vector_area(ring) @ down > 0:
            return candidate, *_cornered(candidate, annulus, other)
    raise GeometryError("a leaflet lies in the axis of the annulus, to neither side of the other")


def _cornered(leaflet: Leaflet, rough: IntArray, other: Leaflet) -> tuple[IntArray, IntArray]:
    """Arcs of annulus and free edge, split at the corners of the leaflet.

    Marked commissures are wrong by a few mm. Along the annulus the other leaflet comes nearer up to
    the corner; past it the two boundaries run side by side.
    """
    middle = len(rough) // 2
    loop = np.roll(leaflet.loop, -int(np.flatnonzero(leaflet.loop == rough[middle])[0]))
    reach = min(MAX_MISS, 0.2 * loop_length(leaflet.curve))
    rough_way = arc_length(leaflet.vertices[rough])
    ends = []
    for way, expected in (
        (loop, rough_way[-1] - rough_way[middle]),
        (np.r_[loop[0], loop[:0:-1]], rough_way[middle]),
    ):
        along = arc_length(leaflet.vertices[way])
        off = np.linalg.norm(closest_on_loop(leaflet.vertices[way], other.curve)[2], axis=1)
        distance = np.where(np.abs(along - expected) <= reach, off, np.inf)
        first = int(np.argmax(distance <= max(SEAM_MM, float(distance.min()))))
        window = (along >= along[first]) & (along <= along[first] + CORNER)
        settled = distance <= distance[window].min() + SETTLED
        ends.append(way[first + int(np.argmax(settled[first:]))])
    last, begin = (int(np.flatnonzero(loop == end)[0]) for end in ends)
    if last >= begin:
        raise GeometryError("the two leaflets run side by side all along the annulus")
    return np.r_[loop[begin:], loop[: last + 1]], loop[last : begin + 1]


def _shares(curve: FloatArray) -> FloatArray:
    length = arc_length(curve)
    return length / length[-1]


def _seam(a: FloatArray, b: FloatArray, given: tuple[float, float] | None) -> tuple[int, int]:
    """Indices (at least 1) of the last joined points of two curves that begin side by side."""
    shares = _shares(a), _shares(b)
    if given is None:
        distance, nearest = _nearest(a, b)
        apart = min(SEAM_MM, float(distance[0]) + OPENING)
        beside = (distance <= apart) & (shares[0] <= MAX_SEAM) & (shares[1][nearest] <= MAX_SEAM)
        last = len(a) if beside.all() else int(np.argmin(beside))
        i = max(1, last - 1)
        given = float(shares[0][i]), float(shares[1][nearest[i]])
    i, j = (
        int(np.clip(np.searchsorted(share, part, "right") - 1, 1, len(share) - 2))
        for share, part in zip(shares, given, strict=True)
    )
    return i, j


def _strip(vertices: FloatArray, a: IntArray, b: IntArray) -> tuple[IntArray, IntArray, float]:
    """Triangles between two rows of vertices, the row with two of their corners, and the width.

    The first row follows its leaflet's boundary, the second opposes it. The next triangle is the
    one with the shorter new edge.
    """
    x, y = vertices[a], vertices[b]
    across = np.pad(np.linalg.norm(x[:, None] - y, axis=2), (0, 1), constant_values=np.inf)
    i = j = 0
    triangles, sides, width = [], [], across[0, 0]
    while (i, j) != (len(a) - 1, len(b) - 1):
        side = int(across[i + 1, j] > across[i, j + 1])
        triangles.append([b[j], b[j + 1], a[i]] if side else [a[i + 1], a[i], b[j]])
        sides.append(side)
        i, j = i + 1 - side, j + side
        width = max(width, across[i, j])
    return np.array(triangles, dtype=np.int64), np.array(sides, dtype=np.int64), float(width)


def _nearest(points: FloatArray, to: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance ``(k,)`` from each point ``(k, 3)`` to the nearest one in ``to``, and its index."""
    distance, number = cKDTree(to).query(points)
    return np.atleast_1d(distance), np.atleast_1d(number)


def _drawn(
    band: LeafletBand,
    region: IntArray,
    grid: BandGrid,
    columns: int,
    offset_mm: tuple[float, float] | None,
) -> Surface:
    """A band shifted along its normals, and remeshed along its coordinate lines.

    Before remeshing it is shifted by its own normals: those of a coarse mesh are wrong in folds.
    """
    triangles = band.coordinates.triangles
    if offset_mm is None:
        by = 0.5 * band.thickness
    else:
        beside = np.zeros((len(band.vertices), 2))
        np.add.at(beside, (triangles, region[:, None]), 1.0)
        by = beside @ offset_mm / beside.sum(axis=1)
    middle = band.vertices + by[:, None] * smooth_vertex_normals(band.vertices, triangles)
    # The grid's angle is opposite to the band's; in both, the anterior leaflet spans 0-180.
    phi = np.mod(180.0 - grid.phi, 360.0)
    corners, weights = band.locate(phi, grid.s)
    radius = np.einsum("ka,ka->k", weights, by[corners]).reshape(-1, columns)
    rows = np.einsum("ka,kai->ki", weights, band.vertices[corners]).reshape(-1, columns, 3)
    low, high = _curled(rows, radius[[0, -1]])
    s = (low + grid.s.reshape(-1, columns) * (1.0 - low - high)).ravel()
    flat = replace(band, vertices=middle).position(phi, s).reshape(rows.shape)
    return Surface(_smooth_rims(flat).reshape(-1, 3), grid.triangles, region=grid.region)


def _curled(rows: FloatArray, radius: FloatArray) -> FloatArray:
    """Shares ``(2, k)`` of the columns of a band ``(r, k, 3)`` that curl round its two rims.

    The side of a thick leaflet includes half of its rim: a quarter circle with a ``radius (2, k)``
    of half the thickness.
    """
    along = arc_length(rows)
    part = np.linspace(0.0, 1.0, len(rows))
    ends = []
    for turned, own in zip((False, True), radius, strict=True):
        way, curve = (along[-1] - along[::-1], rows[::-1]) if turned else (along, rows)
        columns = range(rows.shape[1])
        at = np.array(
            [[np.interp(CURL_AT, way[:, k], curve[:, k, i]) for i in range(3)] for k in columns]
        )
        first, last = at[..., 1] - at[..., 0], at[..., 3] - at[..., 2]
        length = np.linalg.norm(first, axis=1) * np.linalg.norm(last, axis=1)
        cosine = np.median((first * last).sum(axis=1) / np.maximum(length, 1e-12))
        arc = np.pi / 2 * own * (cosine < CURLED)
        ends.append([float(np.interp(arc[k], way[:, k], part)) for k in columns])
    return np.array(ends)


def _smooth_rims(rows: FloatArray) -> FloatArray:
    """Rows ``(r, k, 3)`` with the first and last curve smoothed, and their neighbours less so.

    A clipped edge is as rough as its triangles and has a kink where the free edges part.
    """
    result = rows.copy()
    for end, inwards in ((0, 1), (len(rows) - 1, -1)):
        curve = rows[end]
        for step in RIM_ROUNDS * (SHRINK, SWELL):
            mean = 0.5 * (np.roll(curve, 1, axis=0) + np.roll(curve, -1, axis=0))
            curve = curve + step * (mean - curve)
        for k in range(min(3, len(rows) // 2)):
            result[end + inwards * k] += (1 - k / 3) * (curve - rows[end])
    return result
