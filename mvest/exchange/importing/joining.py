"""Two leaflets that were surfaced one by one, joined along their commissures to the band of a case.

Each leaflet is a disc: its boundary runs along the annulus from one commissure to the other and
back along the free edge. At a commissure two such boundaries lie side by side for some way before
the free edges part; a strip of triangles is laid between them there. The band is then drawn anew on
the lines of its own coordinates, so that it has triangles of one size whatever the leaflets had.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mvest.cases.band import loop_vector_area, two_loops, without_ears
from mvest.cases.tissue import LeafletBand
from mvest.errors import GeometryError
from mvest.exchange.surfaces import Surface, merged
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import BandGrid, band_grid
from mvest.valve.geometry.moving_distance import closest_on_loop
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.thickening import smooth_vertex_normals
from mvest.valve.geometry.triangles import areas, surface_edges

COINCIDENT = 1e-6
"""mm, below which vertices of both leaflets are one."""
REGIONS = ("anterior", "posterior")
MAX_HOLE = 0.2
"""Of a leaflet's boundary: how long that of a hole may be, which is closed."""
MAX_GAP = 6.0
"""mm between the leaflets at a commissure, and from a commissure to the leaflets."""
MAX_MISS = 8.0
"""mm along a leaflet's boundary from where a commissure is marked to where it is."""
CORNER, SETTLED = 3.0, 0.15
"""mm: behind the corner the distance to the other leaflet no longer falls, by that much over that
way."""
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
class Leaflet:
    """One leaflet as a disc.

    Attributes
    ----------
    vertices, triangles
        ``(n, 3)`` mm and ``(m, 3)``.
    loop
        ``(k,)`` its boundary, in the direction of its triangles.
    holes : int
        How many were closed.
    """

    vertices: FloatArray
    triangles: IntArray
    loop: IntArray
    holes: int

    @classmethod
    def of(cls, vertices: FloatArray, triangles: IntArray) -> Leaflet:
        """The largest piece of a surface, with coincident vertices made one and holes closed.

        Raises
        ------
        GeometryError
            It is closed, no manifold, or has a hole that is a second boundary.
        """
        whole = merged(Surface(vertices, triangles))
        points, faces = whole.vertices, whole.triangles
        apart = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        faces = _largest_piece(points, faces[apart & (areas(points, faces) > 0)])
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
        """``(k, 3)`` mm, the boundary."""
        return self.vertices[self.loop]

    def turned(self) -> Leaflet:
        """The same with its triangles facing the other way."""
        return Leaflet(self.vertices, self.triangles[:, ::-1], self.loop[::-1], self.holes)

    def arcs(self, first: FloatArray, second: FloatArray) -> tuple[IntArray, IntArray]:
        """The loop from the vertex nearest to a point to that nearest to another, and the rest.

        Both arcs have both ends.
        """
        curve = self.curve
        start, stop = (
            int(np.argmin(np.linalg.norm(curve - point, axis=1))) for point in (first, second)
        )
        if start == stop:
            raise GeometryError(
                "both commissures are at the same vertex of a leaflet; are they those of this "
                "valve, in the same axes?"
            )
        turned = np.roll(self.loop, -start)
        cut = (stop - start) % len(turned)
        return turned[: cut + 1], np.append(turned[cut:], turned[0])


def loop_length(curve: FloatArray) -> float:
    """Length (mm) of a closed curve ``(k, 3)``."""
    return float(np.linalg.norm(curve - np.roll(curve, -1, axis=0), axis=1).sum())


def _largest_piece(vertices: FloatArray, triangles: IntArray) -> IntArray:
    edges = surface_edges(triangles)
    n = len(vertices)
    graph = coo_matrix((np.ones(len(edges), dtype=np.int8), edges.T), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    of_triangle = label[triangles[:, 0]]
    area = np.bincount(of_triangle, weights=areas(vertices, triangles))
    return triangles[of_triangle == np.argmax(area)]


def commissures_on(contour: FloatArray, leaflets: Sequence[Leaflet]) -> FloatArray:
    """The two points ``(2, 3)`` of a contour where the nearer leaflet changes.

    Raises
    ------
    GeometryError
        It is not near to each of the leaflets once, in one piece.
    """
    distance = [_nearest(contour, leaflet.curve)[0] for leaflet in leaflets]
    # Over as many neighbours as make a few mm, so that no single point decides.
    difference = distance[0] - distance[1]
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
    seam_mm: float,
    edge_mm: float,
    offset_mm: tuple[float, float],
    seams: FloatArray | None = None,
) -> tuple[Surface, FloatArray, float]:
    """Join the anterior and the posterior leaflet to a band that faces the ventricle.

    Parameters
    ----------
    leaflets
    commissures
        ``(2, 3)`` mm, where the annulus passes from one leaflet to the other.
    contour
        ``(k, 3)`` mm, closed curve along the annulus, or None.
    down
        ``(3,)`` from the annulus to the ventricle.
    seam_mm
        Distance up to which boundaries that leave a commissure side by side are joined.
    edge_mm
        Of the triangles, on average.
    offset_mm
        By which the anterior and the posterior leaflet are moved to the ventricle: half a thickness
        turns an atrial surface into the midsurface.
    seams : (2, 2) or None
        Share of each leaflet's free edge (columns) that is joined at each commissure. That of
        another frame where the valve is closed and the edges lie side by side all along; else it
        is found.

    Returns
    -------
    surface : Surface
        Regions 0 (anterior) and 1 (posterior).
    seams : (2, 2)
    gap : float
        mm, largest distance between the leaflets that a strip of triangles spans.

    Raises
    ------
    GeometryError
        The commissures are not at the leaflets, what is joined is no leaflets, or the coordinates
        of the band fold over.
    """
    for name, leaflet in zip(REGIONS, leaflets, strict=True):
        away = float(_nearest(commissures, leaflet.curve)[0].max())
        if away > MAX_GAP:
            raise GeometryError(
                f"the {name} leaflet ends {away:.1f} mm from a commissure, expected at most "
                f"{MAX_GAP:g} mm: do leaflets and annulus have the same axes and phase?"
            )
    place = (commissures, contour, down, seam_mm)
    front, *arcs = _facing_ventricle(leaflets[0], leaflets[1], *place)
    back, *others = _facing_ventricle(leaflets[1], leaflets[0], *place)
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
    # A free edge begins where the annulus of its leaflet ends, and there the other one ends.
    for k in range(2):
        a, b = edges[k], edges[1 - k][::-1]
        given = None if seams is None else (seams[k, k], seams[k, 1 - k])
        i, j = _seam(vertices[a], vertices[b], seam_mm, given)
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
    used, inverse = np.unique(corners[proper], return_inverse=True)
    triangles, _ = without_ears(inverse.reshape(-1, 3))
    middle = np.searchsorted(used, same[arcs[0][len(arcs[0]) // 2]])
    loops = sorted(two_loops(vertices[used], triangles), key=lambda loop: middle not in loop)
    band = LeafletBand.of(vertices[used], triangles, labels[proper], loops[0], loops[1], 0)
    around = 0.5 * sum(loop_length(vertices[used][loop]) for loop in loops)
    along = areas(vertices[used], triangles).sum() / around
    columns = 4 * max(6, round(around / edge_mm / 4))
    grid = band_grid(columns, 1 + max(4, round(along / edge_mm)))
    return _drawn(band, grid, columns, offset_mm), shares, max(gaps)


def _facing_ventricle(
    leaflet: Leaflet,
    other: Leaflet,
    commissures: FloatArray,
    contour: FloatArray | None,
    down: FloatArray,
    beside_mm: float,
) -> tuple[Leaflet, IntArray, IntArray]:
    """The leaflet with its triangles facing the ventricle, its arcs of annulus and free edge."""
    for candidate in (leaflet, leaflet.turned()):
        arcs = candidate.arcs(commissures[0], commissures[1])
        to = other.vertices if contour is None else contour
        away = [float(_nearest(candidate.vertices[arc], to)[0].mean()) for arc in arcs]
        # The annulus is nearer to the contour, or else farther from the other leaflet.
        annulus = arcs[int(np.argmax(away) if contour is None else np.argmin(away))]
        ring = np.vstack([candidate.vertices[annulus], other.curve.mean(0)])
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
    middle = len(rough) // 2
    loop = np.roll(leaflet.loop, -int(np.flatnonzero(leaflet.loop == rough[middle])[0]))
    reach = min(MAX_MISS, 0.2 * loop_length(leaflet.curve))
    rough_way = _along(leaflet.vertices[rough])
    ends = []
    for way, expected in (
        (loop, rough_way[-1] - rough_way[middle]),
        (np.r_[loop[0], loop[:0:-1]], rough_way[middle]),
    ):
        along = _along(leaflet.vertices[way])
        off = np.linalg.norm(closest_on_loop(leaflet.vertices[way], other.curve)[2], axis=1)
        distance = np.where(np.abs(along - expected) <= reach, off, np.inf)
        first = int(np.argmax(distance <= max(beside_mm, float(distance.min()))))
        window = (along >= along[first]) & (along <= along[first] + CORNER)
        settled = distance <= distance[window].min() + SETTLED
        ends.append(way[first + int(np.argmax(settled[first:]))])
    last, begin = (int(np.flatnonzero(loop == end)[0]) for end in ends)
    if last >= begin:
        raise GeometryError("the two leaflets lie beside each other all along the annulus")
    return np.r_[loop[begin:], loop[: last + 1]], loop[last : begin + 1]


def _along(curve: FloatArray) -> FloatArray:
    """Length (mm) of a curve ``(k, 3)`` up to each of its points."""
    return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]


def _shares(curve: FloatArray) -> FloatArray:
    return _along(curve) / _along(curve)[-1]


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


def _strip(vertices: FloatArray, a: IntArray, b: IntArray) -> tuple[IntArray, IntArray, float]:
    """Triangles between two rows of vertices, the row that has two corners of each, their width.

    The first row runs as the boundary of its leaflet does, the second one against it. Of the two
    triangles that may come next, the one with the shorter new edge is taken.
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
    """Distance ``(k,)`` of each point ``(k, 3)`` to the nearest of others, and its number."""
    distance, number = cKDTree(to).query(points)
    return np.atleast_1d(distance), np.atleast_1d(number)


def _drawn(
    band: LeafletBand, grid: BandGrid, columns: int, offset_mm: tuple[float, float]
) -> Surface:
    """A band on the lines of its coordinates, moved off its side."""
    # The grid's angle runs against that of the chart; both have the anterior leaflet in 0 to 180.
    phi = np.mod(180.0 - grid.phi, 360.0)
    rows = band.position(phi, grid.s).reshape(-1, columns, 3)
    rows = _smooth_rims(_flat_part(rows, np.where(phi[:columns] < 180, *offset_mm)))
    vertices: FloatArray = rows.reshape(-1, 3)
    by = np.where(grid.phi < 180, *offset_mm)
    by = np.where(np.mod(grid.phi, 180.0) == 0, sum(offset_mm) / 2, by)
    vertices = vertices + by[:, None] * smooth_vertex_normals(vertices, grid.triangles)
    return Surface(vertices, grid.triangles, region=grid.region)


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
