"""Two leaflets that were surfaced one by one, joined along their commissures to the band of a case.

Each leaflet is a disc: its boundary runs along the annulus from one commissure to the other and
back along the free edge. At a commissure two such boundaries lie side by side for some way before
the free edges part; a strip of triangles is laid between them there. The band is then drawn anew on
the lines of its own coordinates, so that it has triangles of one size whatever the leaflets had.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.chord_layout import LeafletBand
from mvest.cases.rims import loop_vector_area, two_loops, without_ears
from mvest.errors import GeometryError
from mvest.exchange.importing.parts import Leaflet, loop_length
from mvest.exchange.regions import RegionSurface
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import band_grid
from mvest.valve.geometry.thickening import smooth_vertex_normals
from mvest.valve.geometry.triangles import areas

COINCIDENT = 1e-6
"""mm, below which vertices of both leaflets are one."""
REGIONS = ("anterior", "posterior")
MAX_GAP = 6.0
"""mm between the leaflets at a commissure, and from a commissure to the leaflets."""
MAX_MISS = 8.0
"""mm along a leaflet's boundary from where a commissure is marked to where it is."""
CORNER, SETTLED, DENSE = 3.0, 0.15, 0.2
"""mm: behind the corner the distance to the other leaflet no longer falls, by that much over that
way; spacing of the points among which the nearest is taken."""
OPENING = 0.4
"""mm more than at the corner, from which on two boundaries are free edges that part."""
CURL_AT, CURLED = (0.0, 0.6, 1.5, 2.5), 0.85
"""mm from an edge: a side that curls round a rim runs otherwise within the first two than between
the last two, by 32 degrees or more; a surface that ends there by less than 10."""
RIM_ROUNDS = 2
"""Of smoothing an edge: over one of its triangles' edges."""
MAX_SEAM = 0.25
"""Of a free edge, from commissure to commissure: how far it may run beside the other one."""


@dataclass(frozen=True, slots=True, eq=False)
class Commissures:
    """Where the annulus passes from one leaflet to the other.

    Attributes
    ----------
    points
        ``(2, 3)`` mm.
    contour
        ``(k, 3)`` mm, closed curve along the annulus, or None.
    """

    points: FloatArray
    contour: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class JoinedLeaflets:
    """Both leaflets as one surface, which faces the ventricle.

    Attributes
    ----------
    vertices, triangles, region
        ``(n, 3)`` mm, ``(m, 3)`` and ``(m,)``: 0 anterior, 1 posterior.
    annulus, free_edge
        The boundary loops, in the direction of their triangles.
    seams
        ``(2, 2)`` share of each leaflet's free edge (columns) that is joined at each commissure.
    gap
        mm, largest distance between the leaflets that a strip of triangles spans.
    """

    vertices: FloatArray
    triangles: IntArray
    region: IntArray
    annulus: IntArray
    free_edge: IntArray
    seams: FloatArray
    gap: float


def commissures_on(contour: FloatArray, anterior: Leaflet, posterior: Leaflet) -> FloatArray:
    """The two points ``(2, 3)`` of a contour where the nearer leaflet changes.

    Raises
    ------
    GeometryError
        It is not near to each of the leaflets once, in one piece.
    """
    distance = [
        _nearest(contour, leaflet.vertices[leaflet.loop])[0] for leaflet in (anterior, posterior)
    ]
    # Over as many neighbours as make a few mm, so that no single point decides.
    difference = distance[0] - distance[1]
    width = max(1, round(0.02 * len(contour)))
    smooth = sum(np.roll(difference, k) for k in range(-width, width + 1))
    nearer = smooth < 0
    changes = np.flatnonzero(nearer != np.roll(nearer, 1))
    if len(changes) != 2:
        raise GeometryError(
            f"along the annulus the nearer leaflet changes {len(changes)} times, expected twice; "
            "give the commissures as landmarks ALC and PMC"
        )
    return contour[changes]


def joined(
    anterior: Leaflet,
    posterior: Leaflet,
    where: Commissures,
    down: FloatArray,
    max_seam_mm: float,
    seams: FloatArray | None = None,
) -> JoinedLeaflets:
    """Join two leaflets.

    Parameters
    ----------
    anterior, posterior
    where
    down
        ``(3,)`` from the annulus to the ventricle.
    max_seam_mm
        Distance up to which boundaries that leave a commissure side by side are joined.
    seams
        Share of the free edges that is joined instead, `seams` of another frame: where the
        valve is closed the edges lie side by side all along.

    Raises
    ------
    GeometryError
        The commissures are not at the leaflets, or what is joined is no leaflets.
    """
    leaflets = (anterior, posterior)
    for name, leaflet in zip(REGIONS, leaflets, strict=True):
        away = float(_nearest(where.points, leaflet.vertices[leaflet.loop])[0].max())
        if away > MAX_GAP:
            raise GeometryError(
                f"the {name} leaflet ends {away:.1f} mm from a commissure, expected at most "
                f"{MAX_GAP:g} mm: do leaflets and annulus have the same axes and phase?"
            )
    front, front_annulus, front_edge = _facing_ventricle(
        anterior, posterior, where, down, max_seam_mm
    )
    back, back_annulus, back_edge = _facing_ventricle(posterior, anterior, where, down, max_seam_mm)
    ends = front.vertices[front_annulus[[0, -1]]]
    begin = back.vertices[back_annulus[0]]
    if np.argmin(np.linalg.norm(ends - begin, axis=1)) != 1:
        raise GeometryError("both leaflets lie on the same side of the commissures")
    gap = max(
        float(np.linalg.norm(front.vertices[a] - back.vertices[b]))
        for a, b in ((front_annulus[0], back_annulus[-1]), (front_annulus[-1], back_annulus[0]))
    )
    if gap > MAX_GAP:
        raise GeometryError(
            f"the leaflets are {gap:.1f} mm apart at a commissure, expected at most {MAX_GAP:g} mm"
        )
    vertices = np.concatenate([front.vertices, back.vertices])
    offset = len(front.vertices)
    front_edge, back_edge = front_edge, back_edge + offset
    triangles = [front.triangles, back.triangles + offset]
    region = [np.zeros(len(triangles[0]), np.int64), np.ones(len(triangles[1]), np.int64)]
    same, shares, gaps = np.arange(len(vertices)), np.zeros((2, 2)), []
    # A free edge begins where the annulus of its leaflet ends, and there the other one ends.
    for k, (a, b) in enumerate(((front_edge, back_edge[::-1]), (back_edge, front_edge[::-1]))):
        given = None if seams is None else (seams[k, k], seams[k, 1 - k])
        i, j = _seam(vertices[a], vertices[b], max_seam_mm, given)
        shares[k, k], shares[k, 1 - k] = _shares(vertices[a])[i], _shares(vertices[b])[j]
        a, b = a[: i + 1], b[: j + 1]
        strip, of_first, gap = _strip(vertices, a, b)
        distance, nearest = _nearest(vertices[b], vertices[a])
        same[b[distance < COINCIDENT]] = a[nearest[distance < COINCIDENT]]
        triangles.append(strip)
        region.append(np.where(of_first, k, 1 - k))
        gaps.append(gap)
    faces, labels = same[np.concatenate(triangles)], np.concatenate(region)
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    used, inverse = np.unique(faces[proper], return_inverse=True)
    vertices = vertices[used]
    faces, _ = without_ears(inverse.reshape(-1, 3))
    middle = np.searchsorted(used, same[front_annulus[len(front_annulus) // 2]])
    annulus, edge = sorted(two_loops(vertices, faces), key=lambda loop: middle not in loop)
    return JoinedLeaflets(vertices, faces, labels[proper], annulus, edge, shares, max(gaps))


def _facing_ventricle(
    leaflet: Leaflet, other: Leaflet, where: Commissures, down: FloatArray, beside_mm: float
) -> tuple[Leaflet, IntArray, IntArray]:
    """The leaflet with its triangles facing the ventricle, its arcs of annulus and free edge."""
    for candidate in (leaflet, leaflet.turned()):
        arcs = candidate.arcs(where.points[0], where.points[1])
        annulus = arcs[_which_is_annulus(candidate, arcs, other, where.contour)]
        ring = np.vstack([candidate.vertices[annulus], other.vertices[other.loop].mean(0)])
        if loop_vector_area(ring) @ down > 0:
            return candidate, *_cornered(candidate, annulus, other, beside_mm)
    raise GeometryError("a leaflet lies in the axis of the annulus, to neither side of the other")


def _cornered(
    leaflet: Leaflet, rough: IntArray, other: Leaflet, beside_mm: float
) -> tuple[IntArray, IntArray]:
    """Arcs of annulus and free edge, parted where the boundary comes to lie beside the other one.

    A commissure is marked to some mm. Along the annulus the other leaflet comes nearer up to the
    corner; behind it the two boundaries lie beside each other.
    """
    start = rough[len(rough) // 2]
    loop = np.roll(leaflet.loop, -int(np.flatnonzero(leaflet.loop == start)[0]))
    to = _dense(other.vertices[other.loop])
    reach = loop_length(leaflet.vertices[loop])
    half = _shares(leaflet.vertices[rough])[len(rough) // 2] * _arc(leaflet.vertices[rough])
    ends = []
    for way, expected in (
        (loop, _arc(leaflet.vertices[rough]) - half),
        (loop[[0, *range(len(loop) - 1, 0, -1)]], half),
    ):
        along = np.cumsum(
            np.r_[0.0, np.linalg.norm(np.diff(leaflet.vertices[way], axis=0), axis=1)]
        )
        near = np.abs(along - expected) <= min(MAX_MISS, 0.2 * reach)
        distance = np.where(near, _nearest(leaflet.vertices[way], to)[0], np.inf)
        beside = distance <= max(beside_mm, float(distance.min()))
        first = int(np.argmax(beside))
        window = (along >= along[first]) & (along <= along[first] + CORNER)
        settled = distance <= distance[window].min() + SETTLED
        ends.append(way[first + int(np.argmax(settled[first:]))])
    last, begin = (int(np.flatnonzero(loop == end)[0]) for end in ends)
    if last >= begin:
        raise GeometryError("the two leaflets lie beside each other all along the annulus")
    return np.r_[loop[begin:], loop[: last + 1]], loop[last : begin + 1]


def _arc(curve: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def _dense(loop: FloatArray) -> FloatArray:
    """A closed curve with points so near to each other that the nearest is that of the curve."""
    following = np.roll(loop, -1, axis=0)
    count = np.maximum(1, np.ceil(np.linalg.norm(following - loop, axis=1) / DENSE).astype(int))
    share = np.concatenate([np.arange(n) / n for n in count])[:, None]
    return (
        np.repeat(loop, count, axis=0) * (1 - share) + np.repeat(following, count, axis=0) * share
    )


def _which_is_annulus(
    leaflet: Leaflet,
    arcs: tuple[IntArray, IntArray],
    other: Leaflet,
    contour: FloatArray | None,
) -> int:
    """The arc that is nearer to the annulus, or else farther from the other leaflet."""
    to = other.vertices if contour is None else contour
    distance = [float(_nearest(leaflet.vertices[arc], to)[0].mean()) for arc in arcs]
    return int(np.argmax(distance) if contour is None else np.argmin(distance))


def _shares(curve: FloatArray) -> FloatArray:
    length = np.cumsum(np.r_[0.0, np.linalg.norm(np.diff(curve, axis=0), axis=1)])
    return length / length[-1]


def _seam(
    a: FloatArray, b: FloatArray, max_mm: float, given: tuple[float, float] | None
) -> tuple[int, int]:
    """How far two curves that begin beside each other are joined: last point of each, 1 or more."""
    shares = _shares(a), _shares(b)
    if given is None:
        distance, nearest = _nearest(a, b)
        apart = min(max_mm, float(distance[0]) + OPENING)
        beside = (distance <= apart) & (shares[0] <= MAX_SEAM) & (shares[1][nearest] <= MAX_SEAM)
        last = len(a) if beside.all() else int(np.argmin(beside))
        i = max(1, last - 1)
        given = float(shares[0][i]), float(shares[1][nearest[i]])
    i, j = (
        int(np.clip(np.searchsorted(share, part, "right") - 1, 1, len(share) - 2))
        for share, part in zip(shares, given, strict=True)
    )
    return i, j


def _strip(vertices: FloatArray, a: IntArray, b: IntArray) -> tuple[IntArray, BoolArray, float]:
    """Triangles between two rows of vertices, whether each has two of the first, and their width.

    The first row runs as the boundary of its leaflet does, the second one against it.
    """
    i = j = 0
    triangles, of_first = [], []
    width = float(np.linalg.norm(vertices[a[0]] - vertices[b[0]]))
    while i + 1 < len(a) or j + 1 < len(b):
        ahead_a = ahead_b = np.inf
        if i + 1 < len(a):
            ahead_a = float(np.linalg.norm(vertices[a[i + 1]] - vertices[b[j]]))
        if j + 1 < len(b):
            ahead_b = float(np.linalg.norm(vertices[b[j + 1]] - vertices[a[i]]))
        first = ahead_a <= ahead_b
        triangles.append([a[i + 1], a[i], b[j]] if first else [b[j], b[j + 1], a[i]])
        of_first.append(first)
        i, j = (i + 1, j) if first else (i, j + 1)
        width = max(width, min(ahead_a, ahead_b))
    return np.array(triangles, dtype=np.int64), np.array(of_first, dtype=np.bool_), width


def _nearest(points: FloatArray, to: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance ``(k,)`` of each point ``(k, 3)`` to the nearest of others, and its number."""
    distance, number = cKDTree(to).query(points)
    return np.atleast_1d(distance), np.atleast_1d(number)


def drawn_anew(
    leaflets: JoinedLeaflets, edge_mm: float, offset_mm: tuple[float, float]
) -> RegionSurface:
    """The band with triangles of one size on the lines of its coordinates, moved off its side.

    Parameters
    ----------
    leaflets
    edge_mm
        Of the triangles, on average.
    offset_mm
        By which the anterior and the posterior leaflet are moved to the ventricle: half a thickness
        turns an atrial surface into the midsurface.

    Raises
    ------
    GeometryError
        Its coordinates fold over.
    """
    loops = leaflets.annulus, leaflets.free_edge
    chart = LeafletBand.of(leaflets.vertices, leaflets.triangles, leaflets.region, *loops, 0)
    around = 0.5 * sum(loop_length(leaflets.vertices[loop]) for loop in loops)
    along = areas(leaflets.vertices, leaflets.triangles).sum() / around
    columns = 4 * max(6, round(around / edge_mm / 4))
    grid = band_grid(columns, 1 + max(4, round(along / edge_mm)))
    # The grid's angle runs against that of the chart; both have the anterior leaflet in 0 to 180.
    phi = np.mod(180.0 - grid.phi, 360.0)
    drawn = chart.position(phi, grid.s).reshape(-1, columns, 3)
    drawn = _smooth_rims(_flat_part(drawn, np.where(phi[:columns] < 180, *offset_mm)))
    vertices: FloatArray = drawn.reshape(-1, 3)
    between = np.mod(grid.phi, 180.0) == 0
    by = np.where(between, sum(offset_mm) / 2, np.where(grid.phi < 180, *offset_mm))
    if any(offset_mm):
        normals = smooth_vertex_normals(vertices, grid.triangles)
        vertices = vertices + by[:, None] * normals
    return RegionSurface(vertices, grid.triangles, grid.region, {})


def _flat_part(rows: FloatArray, offset_mm: FloatArray) -> FloatArray:
    """Rows ``(r, k, 3)`` of a band, drawn closer where its edges curl round the rims of leaflets.

    A side that was cut out of a thick leaflet goes on round half of its rim, which is left out: a
    quarter of a circle, whose radius ``(k,)`` is what the side is moved by.
    """
    step = np.linalg.norm(np.diff(rows, axis=0), axis=2)
    along = np.vstack([np.zeros(rows.shape[1]), np.cumsum(step, axis=0)])
    part = np.linspace(0.0, 1.0, len(rows))
    ends = []
    for turned in (False, True):
        way, curve = (along[-1] - along[::-1], rows[::-1]) if turned else (along, rows)
        columns = range(rows.shape[1])
        at = np.array(
            [[np.interp(CURL_AT, way[:, k], curve[:, k, i]) for i in range(3)] for k in columns]
        )
        first, last = at[..., 1] - at[..., 0], at[..., 3] - at[..., 2]
        length = np.linalg.norm(first, axis=1) * np.linalg.norm(last, axis=1)
        cosine = np.median((first * last).sum(axis=1) / np.maximum(length, 1e-12))
        arc = np.pi / 2 * offset_mm * (cosine < CURLED)
        ends.append([float(np.interp(arc[k], way[:, k], part)) for k in columns])
    if not np.any(ends):
        return rows
    result = rows.copy()
    for k, (low, high) in enumerate(zip(*ends, strict=True)):
        place = low + part * (1.0 - low - high)
        for axis in range(3):
            result[:, k, axis] = np.interp(place, part, rows[:, k, axis])
    return result


def _smooth_rims(rows: FloatArray) -> FloatArray:
    """Rows ``(r, k, 3)`` with the first and the last curve smoothed, and those beside them less.

    Where a surface was clipped its edge is as rough as its triangles, and where the free edges
    part it has a kink that no leaflet of that thickness has.
    """
    result = rows.copy()
    for end, inwards in ((0, 1), (len(rows) - 1, -1)):
        curve = rows[end]
        for _ in range(RIM_ROUNDS):
            curve = 0.5 * curve + 0.25 * (np.roll(curve, 1, axis=0) + np.roll(curve, -1, axis=0))
        for k in range(min(3, len(rows) // 2)):
            result[end + inwards * k] += (1 - k / 3) * (curve - rows[end])
    return result
