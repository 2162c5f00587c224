"""Computes the midsurface of thick leaflets: from a closed surface to a band with a thickness.

The two walls of the closed surface (`mvest.valve.geometry.walls`) are bands with common edges.
Points of both walls with equal harmonic coordinates face each other, and the midpoints of such
pairs form a first midsurface. It is then moved until it is equally far from both walls: the medial
sheet of the tissue. Near the edges, where the nearest wall is the rim, the thickness is taken from
the tissue farther in.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.distance import cdist

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import band_grid, lumped_areas, vertex_normals
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import (
    SurfaceCoordinates,
    cotangent_laplacian,
    surface_coordinates,
    wrapped,
)
from mvest.valve.geometry.triangles import arc_length, area_vectors, loop_length
from mvest.valve.geometry.walls import Wall, closed_band, walls

EDGE_MM = 1.2
"""Mean edge length of the triangles, mm."""
ROUNDS = 8
"""Rounds of centring the sheet and redistributing its vertices."""
MAX_STEP = 0.5
"""Largest centring step, mm."""
RIM_SHARE = 0.8
"""Distance from an edge, relative to the thickness, within which the nearest wall is the rim."""
FINE = 200
"""Samples of a line from annulus to free edge before its vertices are redistributed."""
LEVELS, ANGLES = 50, 8
"""Samples, from annulus to free edge and per column around the valve, that find the commissures."""
SEAM_SMOOTHING = 0.0025
"""Weight of a seam's squared second derivative beside its squared distances from the labels."""
TIP_CONE = 60.0
"""Largest angle (degrees) between a papillary tip and its commissure, around the valve."""


@dataclass(frozen=True, slots=True, eq=False)
class Midsurface:
    """The midsurface of two leaflets."""

    #: (n, 3) mm, a grid: vertex ``j * columns + i`` is column i, row j. The first row is the
    #: annulus, the last the free edge; the commissures are columns 0 and ``columns / 2``.
    vertices: FloatArray
    triangles: IntArray  #: (m, 3), facing the ventricle
    region: IntArray  #: (m,), 0 anterior, 1 posterior
    thickness: FloatArray  #: (n,) mm
    #: (columns,), vertices in loop order
    annulus: IntArray
    free_edge: IntArray
    derived: tuple[str, ...]  #: properties that were not given but derived from the shape

    @property
    def commissures(self) -> IntArray:
        """Vertices ``(2, 2)``: for each commissure, one on the annulus and one on the free edge."""
        columns = len(self.annulus)
        return np.column_stack([self.annulus, self.free_edge])[[0, columns // 2]]

    @property
    def heights(self) -> FloatArray:
        """Largest length ``(2,)`` mm of each leaflet, from annulus to free edge."""
        grid = self.vertices.reshape(-1, len(self.annulus), 3)
        return np.asarray(arc_length(grid)[-1].reshape(2, -1).max(axis=1))

    def exchanged(self) -> Midsurface:
        """The same surface with anterior and posterior leaflets swapped."""
        columns = len(self.annulus)

        def turned(values: FloatArray) -> FloatArray:
            grid = values.reshape(-1, columns, *values.shape[1:])
            return np.roll(grid, columns // 2, axis=1).reshape(values.shape)

        return replace(self, vertices=turned(self.vertices), thickness=turned(self.thickness))

    def extended(self, by_mm: FloatArray) -> Midsurface:
        """The surface with its two edges farther out by ``(2, columns)`` mm."""
        grid = self.vertices.reshape(-1, len(self.annulus), 3).copy()
        outwards = grid[[0, -1]] - grid[[1, -2]]
        grid[[0, -1]] += by_mm[..., None] * outwards / np.linalg.norm(outwards, axis=2)[..., None]
        return replace(self, vertices=grid.reshape(-1, 3))

    def unblurred(self, blur_mm: float) -> Midsurface:
        """The surface before a Gaussian blur of its tissue, to first order.

        The blur has moved it towards its centres of curvature by ``blur^2 / 2`` times the sum of
        its principal curvatures (`mvest.valve.geometry.segmented.segmentation_std`), which is its
        Laplacian along the normal; edges, by their curvature as space curves.
        """
        x, triangles = self.vertices, self.triangles
        normals = vertex_normals(x, triangles)
        outwards = cotangent_laplacian(x, triangles) @ x / lumped_areas(x, triangles)[:, None]
        away = normals * np.sum(outwards * normals, axis=1, keepdims=True)
        for edge in (self.annulus, self.free_edge):
            ahead = np.roll(x[edge], -1, axis=0) - x[edge]
            length = np.linalg.norm(ahead, axis=1, keepdims=True)
            turn = ahead / length - np.roll(ahead / length, 1, axis=0)
            away[edge] = -2 * turn / (length + np.roll(length, 1, axis=0))
        return replace(self, vertices=x + 0.5 * blur_mm**2 * away)

    def smoothed(self, width_mm: float) -> tuple[Midsurface, float]:
        """Smooth the surface around the valve; also return the largest move (mm) of a vertex.

        The Gaussian weights have the standard deviation `width_mm` along the annulus, and
        proportionally less on shorter lines such as the free edge.
        """
        grid = self.vertices.reshape(-1, len(self.annulus), 3)
        step = np.linalg.norm(np.roll(grid[0], -1, axis=0) - grid[0], axis=1).mean()
        smooth = gaussian_filter1d(grid, width_mm / step, axis=1, mode="wrap") if width_mm else grid
        moved = float(np.linalg.norm(smooth - grid, axis=2).max())
        return replace(self, vertices=smooth.reshape(-1, 3)), moved


def midsurface(
    vertices: FloatArray,
    triangles: IntArray,
    *,
    tips: FloatArray,
    anterior: FloatArray | None = None,
    label: Callable[[FloatArray], IntArray] | None = None,
    edge_mm: float = EDGE_MM,
) -> Midsurface:
    """Compute the midsurface of two thick leaflets around one orifice.

    GeometryError if the surface is not a closed thin band, or the leaflets cannot be distinguished.

    Parameters
    ----------
    vertices, triangles
        ``(n, 3)`` mm and ``(m, 3)``.
    tips
        ``(2, 3)`` mm, papillary tips. The free edge is the loop nearer to them. Each commissure is
        where the leaflets are shortest on the side of a tip.
    anterior
        ``(3,)`` mm, a point near the anterior annulus, if known. Otherwise the anterior leaflet is
        the taller one.
    label
        Returns the leaflet (0 anterior, 1 posterior) of points ``(k, 3)``, if known.
    edge_mm
        Mean edge length of the triangles.
    """
    first, second = walls(*closed_band(vertices, triangles))
    derived: list[str] = []
    # The annulus is the loop farther from the tips.
    away = [cdist(first.vertices[loop], tips).min(axis=1).mean() for loop in first.loops]
    annulus = int(np.argmax(away))
    pair = _PairedWalls(first, second, annulus)
    perimeter = np.mean([loop_length(first.vertices[loop]) for loop in first.loops])
    columns = max(24, 2 * round(perimeter / edge_mm / 2))
    angle = 2 * np.pi * np.arange(ANGLES * columns) / (ANGLES * columns)
    lines = pair.middle(angle, np.linspace(0, 1, LEVELS)[:, None])
    heights = arc_length(lines)[-1]
    if label is not None:
        seams = _label_seams(lines, angle, label)
    else:
        seams = _short_seams(lines, angle, heights, tips, anterior, derived)
    rows = max(6, round(float(heights.mean()) / edge_mm) + 1)
    sheet = _sheet(pair, seams, columns, rows)
    for _ in range(ROUNDS):
        sheet = _centred(_spread(_smoothed(sheet), rows), first, second)
    thickness = _thickness(sheet, first, second)
    grid = band_grid(columns, rows)
    points = sheet.reshape(-1, 3)
    triangles = grid.triangles
    down = tips.mean(axis=0) - sheet[0].mean(axis=0)
    if area_vectors(points, triangles).sum(axis=0) @ down < 0:
        triangles = triangles[:, ::-1]
    return Midsurface(
        points,
        triangles,
        grid.region,
        thickness.ravel(),
        np.arange(columns),
        np.arange(columns) + (rows - 1) * columns,
        tuple(derived),
    )


class _PairedWalls:
    """Both walls in coordinates (angle in rad, s) that agree along their common edges.

    The harmonic angles of the two walls differ along the edges; in between, the difference is
    interpolated linearly in s.
    """

    def __init__(self, first: Wall, second: Wall, annulus: int) -> None:
        self._walls = (first, second)
        self._coordinates: list[SurfaceCoordinates] = []
        for wall in self._walls:
            around, edge = wall.loops[annulus], wall.loops[1 - annulus]
            self._coordinates.append(
                surface_coordinates(wall.vertices, wall.triangles, around, edge)
            )
        # For each wall, at each end, (2, k): common angle and wall's own angle.
        self._tables: list[list[FloatArray]] = [[], []]
        beginning = 0.0
        for end in (annulus, 1 - annulus):
            own = [
                np.unwrap(coordinates.theta[wall.loops[end]])
                for wall, coordinates in zip(self._walls, self._coordinates, strict=True)
            ]
            if end == annulus:
                # The angles of the two walls have different origins.
                beginning = float(np.mean(own[0] - own[1]))
            shifted = own[1] + beginning
            turns = 2 * np.pi * np.round(np.mean(own[0] - shifted) / (2 * np.pi))
            common = 0.5 * (own[0] + shifted + turns)
            self._tables[0].append(np.stack([common, own[0]]))
            self._tables[1].append(np.stack([common, own[1] + turns]))

    def middle(self, angle: FloatArray, s: FloatArray) -> FloatArray:
        """Midpoints ``(..., 3)`` mm of the pairs of points at common angles and s ``(...)``."""
        angle, s = np.broadcast_arrays(angle, s)
        points = []
        for wall, coordinates, tables in zip(
            self._walls, self._coordinates, self._tables, strict=True
        ):
            ends = [_periodic(angle, *table) for table in tables]
            # Shift the second end's angle by the turn nearest to the first's.
            ends[1] = ends[0] + wrapped(ends[1] - ends[0])
            theta = (1 - s) * ends[0] + s * ends[1]
            triangle, weights = coordinates.locate(np.mod(theta.ravel(), 2 * np.pi), s.ravel())
            corners = wall.vertices[wall.triangles[triangle]]
            points.append(np.einsum("kc,kci->ki", weights, corners).reshape(*angle.shape, 3))
        return np.asarray(0.5 * (points[0] + points[1]))


def _periodic(angle: FloatArray, common: FloatArray, own: FloatArray) -> FloatArray:
    """A wall's own angle at common angles; both change by one turn along the table."""
    order = np.argsort(common, kind="stable")
    x, y = common[order], np.maximum.accumulate(np.sort(own))
    turn = 2 * np.pi
    low = x[0]
    inside = low + np.mod(angle - low, turn)
    x, y = np.append(x, x[0] + turn), np.append(y, y[0] + turn)
    return np.asarray(np.interp(inside, x, y))


def _label_seams(
    lines: FloatArray, angle: FloatArray, label: Callable[[FloatArray], IntArray]
) -> FloatArray:
    """Angles ``(FINE, 2)`` of the seams, by level and commissure; the first starts the anterior.

    The anterior label is an arc of each level line; its fraction and centre give both ends. Seams
    bend most at the annulus, so a straight fit would displace their ends there.
    """
    front = label(lines.reshape(-1, 3)).reshape(lines.shape[:2]) == 0
    share = front.mean(axis=1)
    if not 0.1 <= front.mean() <= 0.9:
        raise GeometryError(
            f"{100 * front.mean():.0f} % of the leaflets are anterior by their labels; expected "
            "both leaflets"
        )
    known = (share > 0.02) & (share < 0.98)
    if known.mean() < 0.5:
        raise GeometryError(
            "the labels do not part the leaflets at two commissures, from annulus to free edge; "
            "give anterior= and posterior=, or leaflets= if one label is both of them"
        )
    s, half = np.linspace(0, 1, len(lines))[known], np.pi * share[known]
    centre = np.unwrap(np.angle(np.sum(front[known] * np.exp(1j * angle), axis=1)))
    at = np.clip(np.linspace(0, 1, FINE), s[0], s[-1])
    seams = [
        make_smoothing_spline(s, seam, lam=SEAM_SMOOTHING)(at)
        for seam in (centre - half, centre + half)
    ]
    return np.stack(seams, axis=1)


def _short_seams(
    lines: FloatArray,
    angle: FloatArray,
    heights: FloatArray,
    tips: FloatArray,
    anterior: FloatArray | None,
    derived: list[str],
) -> FloatArray:
    """As `_label_seams`, but with seams where the leaflets are shortest."""
    annulus = lines[0]
    smooth = gaussian_filter1d(heights, max(1.0, len(angle) / 60), mode="wrap")
    derived.append("commissures: where the leaflets are shortest on the side of each tip")
    a, b = sorted(_shortest(annulus, smooth, tips).tolist())
    within = (np.arange(len(angle)) > a) & (np.arange(len(angle)) < b)
    if not 2 < within.sum() < len(angle) - 2:
        raise GeometryError("both commissures are at the same place of the annulus")
    if anterior is None:
        first = smooth[within].max() > smooth[~within].max()
        derived.append(
            f"anterior leaflet: the taller one ({smooth.max():.1f} mm, the other "
            f"{min(smooth[within].max(), smooth[~within].max()):.1f} mm)"
        )
    else:
        away = np.linalg.norm(annulus - np.asarray(anterior), axis=1)
        first = bool(within[away.argmin()])
    seam = np.array([angle[a], angle[b]]) if first else np.array([angle[b], angle[a] + 2 * np.pi])
    return np.tile(seam, (FINE, 1))


def _shortest(annulus: FloatArray, heights: FloatArray, tips: FloatArray) -> IntArray:
    """Two columns where the leaflets are shortest, one on the side of each tip."""
    centre = annulus.mean(axis=0)
    normal = np.cross(annulus - centre, np.roll(annulus, -1, axis=0) - centre).sum(axis=0)
    normal /= np.linalg.norm(normal)
    rays = [v - (v @ normal) * normal for v in (tips - np.mean(tips, axis=0))]
    cosine = [(annulus - centre) @ ray / np.linalg.norm(ray) for ray in rays]
    flat = annulus - centre - ((annulus - centre) @ normal)[:, None] * normal
    size = np.linalg.norm(flat, axis=1)
    sides = [c / size > np.cos(np.radians(TIP_CONE)) for c in cosine]
    return np.array([np.where(side, heights, np.inf).argmin() for side in sides])


def _sheet(pair: _PairedWalls, seams: FloatArray, columns: int, rows: int) -> FloatArray:
    """A first midsurface ``(rows, columns, 3)``, with columns at equal arc lengths of the edges."""
    begin, middle = seams.T[..., None]
    middle = begin + np.mod(middle - begin, 2 * np.pi)
    s, share = np.linspace(0, 1, FINE)[:, None], np.linspace(0, 1, FINE)
    stops, angles = (begin, middle, begin + 2 * np.pi), []
    for low, high in itertools.pairwise(stops):
        shares = []
        for end in (0, -1):
            curve = pair.middle(low[end] + share * (high - low)[end], s[end])
            arc = arc_length(curve)
            equal = np.arange(columns // 2) / (columns // 2)
            shares.append(np.interp(equal, arc / arc[-1], share))
        angles.append(low + ((1 - s) * shares[0] + s * shares[1]) * (high - low))
    return _spread(pair.middle(np.concatenate(angles, axis=1), s), rows)


def _spread(lines: FloatArray, rows: int) -> FloatArray:
    """Columns ``(k, c, 3)`` resampled at equal arc lengths to ``(rows, c, 3)``."""
    arc = arc_length(lines)
    share = np.linspace(0, 1, rows)
    result = np.empty((rows, lines.shape[1], 3))
    for column in range(lines.shape[1]):
        for axis in range(3):
            result[:, column, axis] = np.interp(
                share, arc[:, column] / arc[-1, column], lines[:, column, axis]
            )
    return result


def _centred(sheet: FloatArray, first: Wall, second: Wall) -> FloatArray:
    """Move the sheet, except its edges, to equal distance from both walls.

    One Newton step on the difference of the two distances, along its gradient.
    """
    inner = sheet[1:-1].reshape(-1, 3)
    distances, directions = [], []
    for wall in (first, second):
        found = closest_points(inner, wall.vertices, wall.triangles)
        away = inner - found.interpolate(wall.vertices, wall.triangles)
        distances.append(found.distance)
        directions.append(away / np.maximum(found.distance, 1e-9)[:, None])
    difference = distances[0] - distances[1]
    gradient = directions[0] - directions[1]
    squared = np.einsum("ij,ij->i", gradient, gradient)
    step = np.where(squared > 0.5, -difference / np.maximum(squared, 0.5), 0.0)[:, None] * gradient
    length = np.linalg.norm(step, axis=1, keepdims=True)
    step *= np.minimum(1.0, MAX_STEP / np.maximum(length, 1e-9))
    result = sheet.copy()
    result[1:-1] += step.reshape(sheet[1:-1].shape)
    return result


def _smoothed(sheet: FloatArray) -> FloatArray:
    """Move interior vertices a quarter of the way to the mean of their neighbours."""
    result = sheet.copy()
    around = np.roll(sheet, 1, axis=1) + np.roll(sheet, -1, axis=1)
    mean = 0.25 * (around[1:-1] + sheet[:-2] + sheet[2:])
    result[1:-1] += 0.25 * (mean - sheet[1:-1])
    return result


def _thickness(sheet: FloatArray, first: Wall, second: Wall) -> FloatArray:
    """Sum ``(rows, columns)`` mm of the distances to both walls; edges get the value farther in."""
    shape = sheet.shape[:2]
    points = sheet.reshape(-1, 3)
    total = sum(
        closest_points(points, wall.vertices, wall.triangles).distance for wall in (first, second)
    )
    thickness = np.asarray(total).reshape(shape)
    arc = arc_length(sheet)
    near = np.minimum(arc, arc[-1] - arc)
    row = np.arange(shape[0])
    for column in range(shape[1]):
        known = near[:, column] > RIM_SHARE * thickness[:, column]
        if not known.any():
            known = row == shape[0] // 2
        thickness[:, column] = np.interp(row, row[known], thickness[known, column])
    return thickness
