"""How far a valve is closed: orifice in the line of sight, coaptation length and area, and the gap.

Surfaces are leaflet midsurfaces in their current shape. Two midsurfaces that touch are one leaflet
thickness apart, so contact distances must include it.

The gap is where a closed valve leaks. The slit between two midsurfaces that touch is no leak: a
line of sight from the atrium counts as open only if it is farther from every leaflet than half the
distance at which two of them touch.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from mvest.errors import GeometryError, InputError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.proximity import closest_on_triangle, closest_points, plane_section, row
from mvest.valve.geometry.triangles import areas, unit_normals
from mvest.valve.measure.annulus import AnnulusPlane

MAX_PIXELS = 50_000_000


@dataclass(frozen=True, slots=True)
class LeafletProjection:
    """Leaflets seen from the atrium along the annulus normal, as an image."""

    #: (rows,) and (columns,) mm, pixel centres along those directions
    anterior: FloatArray
    lateral: FloatArray
    inside: BoolArray  #: (rows, columns), pixels inside the projected annulus
    #: (rows, columns) mm, depth of the first leaflet surface below the annulus plane, infinite if
    #: there is none
    depth: FloatArray


@njit(cache=True)
def _rasterise(
    points: FloatArray, triangles: IntArray, x0: float, y0: float, step: float, depth: FloatArray
) -> None:
    """Set `depth` at all pixel centres to that of the first triangle that covers them."""
    rows, columns = depth.shape
    for t in range(triangles.shape[0]):
        a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        first_row = max(int(np.floor((min(a[0], b[0], c[0]) - x0) / step)), 0)
        last_row = min(int(np.ceil((max(a[0], b[0], c[0]) - x0) / step)), rows - 1)
        first_column = max(int(np.floor((min(a[1], b[1], c[1]) - y0) / step)), 0)
        last_column = min(int(np.ceil((max(a[1], b[1], c[1]) - y0) / step)), columns - 1)
        for i in range(first_row, last_row + 1):
            x = x0 + i * step
            for j in range(first_column, last_column + 1):
                y = y0 + j * step
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                w = 1.0 - u - v
                if u >= -1e-9 and v >= -1e-9 and w >= -1e-9:
                    z = u * a[2] + v * b[2] + w * c[2]
                    if z < depth[i, j]:
                        depth[i, j] = z


@njit(cache=True)
def _inside_polygon(polygon: FloatArray, x: FloatArray, y: FloatArray) -> BoolArray:
    """Even-odd rule for the grid of points ``(x[i], y[j])``."""
    inside = np.zeros((x.size, y.size), dtype=np.bool_)
    n = polygon.shape[0]
    for i in range(x.size):
        for k in range(n):
            a, b = polygon[k], polygon[(k + 1) % n]
            if (a[0] > x[i]) != (b[0] > x[i]):
                crossing = a[1] + (x[i] - a[0]) / (b[0] - a[0]) * (b[1] - a[1])
                for j in range(y.size):
                    if y[j] < crossing:
                        inside[i, j] = not inside[i, j]
    return inside


def project_leaflets(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    resolution: float = 0.1,
) -> LeafletProjection:
    """Rasterise the leaflets inside the annulus, seen along the annulus normal.

    GeometryError if the pixel size is not positive or so small that the image has more than 50
    million pixels.

    Parameters
    ----------
    vertices, triangles
        Leaflets in their current shape, ``(n, 3)`` mm and ``(m, 3)``.
    annulus
        ``(k, 3)`` mm in loop order.
    plane
        Plane of that annulus; its normal is the line of sight.
    resolution
        Pixel size, mm.
    """
    if not (np.isfinite(resolution) and resolution > 0):
        raise GeometryError(f"resolution = {resolution} mm; give a positive pixel size")
    outline = plane.coordinates(annulus)
    low, high = outline[:, :2].min(axis=0), outline[:, :2].max(axis=0)
    # Pixel centres lie symmetrically about the middle plane, one of them on it.
    first = np.floor(low / resolution).astype(np.int64)
    last = np.ceil(high / resolution).astype(np.int64)
    if float(np.prod((last - first + 1).astype(np.float64))) > MAX_PIXELS:
        raise GeometryError(f"resolution = {resolution} mm gives over {MAX_PIXELS} pixels")
    x = np.arange(first[0], last[0] + 1) * resolution
    y = np.arange(first[1], last[1] + 1) * resolution
    depth = np.full((len(x), len(y)), np.inf)
    _rasterise(
        plane.coordinates(vertices), np.asarray(triangles, np.int64), x[0], y[0], resolution, depth
    )
    return LeafletProjection(x, y, _inside_polygon(outline[:, :2].copy(), x, y), depth)


def orifice_area(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    resolution: float = 0.1,
) -> float:
    """Orifice area (mm²) in the line of sight from the atrium.

    Pixels of `resolution` (mm) within the annulus that no triangle covers along its normal. An
    oblique gap between overlapping leaflets is not seen.
    """
    image = project_leaflets(vertices, triangles, annulus, plane, resolution)
    return float((image.inside & np.isinf(image.depth)).sum() * resolution**2)


def _in_contact(
    points: FloatArray,
    normals: FloatArray,
    vertices: FloatArray,
    opposing: IntArray,
    contact_distance: float,
) -> BoolArray:
    """Which points lie within the contact distance of an opposing, facing leaflet."""
    if len(points) == 0 or len(opposing) == 0:
        return np.zeros(len(points), dtype=np.bool_)
    corners = vertices[opposing]
    centroids = corners.mean(axis=1)
    # Nothing of a triangle is farther from its centroid than its corners are.
    reach = contact_distance + float(np.linalg.norm(corners - centroids[:, None], axis=2).max())
    gap = cKDTree(centroids).query(points, distance_upper_bound=reach * (1 + 1e-9))[0]
    near = np.asarray(np.isfinite(gap))
    candidate = np.flatnonzero(near)
    closest = closest_points(points[candidate], vertices, opposing)
    other = unit_normals(vertices, opposing)[closest.triangle]
    facing = (normals[candidate] * other).sum(axis=1) < 0
    near[candidate] = (closest.distance <= contact_distance) & facing
    return near


def coaptation_length(
    vertices: FloatArray,
    first: IntArray,
    second: IntArray,
    plane: AnnulusPlane,
    contact_distance: float,
    sampling: float = 0.02,
) -> float:
    """Length (mm) over which two leaflets touch in the middle anteroposterior plane.

    The arc length of each leaflet's section within `contact_distance` of the other leaflet (in or
    out of the plane), where the two face each other (normals more than 90° apart). The result is
    the smaller of both lengths.

    Parameters
    ----------
    vertices : (n, 3) mm
    first, second
        ``(m1, 3)`` and ``(m2, 3)`` triangles of the two leaflets, oriented alike (both towards
        the ventricle).
    contact_distance
        mm between midsurfaces: about the thickness plus the contact model's gap.
    sampling
        mm between the tested points of a section.
    """
    pair = (first, second), (second, first)
    sections = [_touching(vertices, *s, plane, contact_distance, sampling) for s in pair]
    return min(float(length.sum()) for _, length in sections)


def coaptation_depth(
    vertices: FloatArray,
    first: IntArray,
    second: IntArray,
    plane: AnnulusPlane,
    contact_distance: float,
) -> float:
    """Depth (mm) below the annulus plane where two leaflets first touch, seen from the atrium.

    In the middle anteroposterior plane, the mean of both leaflets' least depths; NaN if they do not
    touch there. This is the tenting height of echocardiography, which measures to the coaptation
    point. Parameters as in `coaptation_length`.
    """
    pair = (first, second), (second, first)
    points = [_touching(vertices, *s, plane, contact_distance, 0.02)[0] for s in pair]
    if not all(len(own) for own in points):
        return float("nan")
    return float(np.mean([plane.coordinates(own)[:, 2].min() for own in points]))


def _touching(
    vertices: FloatArray,
    own: IntArray,
    other: IntArray,
    plane: AnnulusPlane,
    contact_distance: float,
    sampling: float,
) -> tuple[FloatArray, FloatArray]:
    """Points ``(k, 3)`` of a leaflet's section that touch the other one, and lengths ``(k,)``."""
    segments, triangle = plane_section(vertices, own, plane.origin, plane.lateral)
    size = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    pieces = np.maximum(np.ceil(size / sampling), 1).astype(np.int64)
    owner = np.repeat(np.arange(len(segments)), pieces)
    position = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    fraction = ((position + 0.5) / pieces[owner])[:, None]
    points = segments[owner, 0] * (1 - fraction) + segments[owner, 1] * fraction
    normals = unit_normals(vertices, own)[triangle[owner]]
    near = _in_contact(points, normals, vertices, other, contact_distance)
    return points[near], (size / pieces)[owner][near]


def touching_triangles(
    vertices: FloatArray, triangles: IntArray, contact_distance: float
) -> BoolArray:
    """Which triangles ``(m,)`` touch a leaflet that faces them, another one or their own in a fold.

    Those whose centroid is within the distance (mm) of a triangle with a normal more than 90° away.
    """
    corners = vertices[triangles]
    centroids, normals = corners.mean(axis=1), unit_normals(vertices, triangles)
    size = float(np.linalg.norm(corners - centroids[:, None], axis=2).max())
    pairs = cKDTree(centroids).query_pairs(contact_distance + size, output_type="ndarray")
    pairs = pairs[np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1) < 0]
    both = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)
    gap = _distances(centroids, vertices, np.asarray(triangles, np.int64), both)
    touching = np.zeros(len(triangles), dtype=np.bool_)
    touching[both[gap <= contact_distance, 0]] = True
    return touching


@njit(cache=True)
def _distances(
    points: FloatArray, vertices: FloatArray, triangles: IntArray, pairs: IntArray
) -> FloatArray:
    """Distances ``(k,)`` of a point from a triangle, for pairs ``(k, 2)`` of both."""
    out = np.empty(len(pairs))
    for k in range(len(pairs)):
        a, b, c = triangles[pairs[k, 1]]
        p = points[pairs[k, 0]]
        u, v, w = closest_on_triangle(
            row(points, pairs[k, 0]), row(vertices, a), row(vertices, b), row(vertices, c)
        )
        out[k] = np.sqrt(np.sum((p - u * vertices[a] - v * vertices[b] - w * vertices[c]) ** 2))
    return out


def coaptation_area(
    vertices: FloatArray,
    leaflets: Sequence[IntArray],
    contact_distance: float,
    subdivisions: int = 3,
) -> float:
    """Area (mm²) over which leaflets touch.

    Half the sum of the leaflets' areas within `contact_distance` of another leaflet and facing it.
    Each triangle is cut into ``subdivisions²`` equal parts. ``leaflets`` are triangles of each, the
    other parameters as in `coaptation_length`.
    """
    weights = _part_centroids(subdivisions)
    touching = []
    for k, own in enumerate(leaflets):
        other = np.concatenate([own[:0], *leaflets[:k], *leaflets[k + 1 :]])
        corners = vertices[own]
        points = np.einsum("qk,mkd->mqd", weights, corners).reshape(-1, 3)
        normals = np.repeat(unit_normals(vertices, own), len(weights), axis=0)
        near = _in_contact(points, normals, vertices, other, contact_distance)
        part = np.repeat(areas(vertices, own) / len(weights), len(weights))
        touching.append(float(part[near].sum()))
    return 0.5 * sum(touching)


def _part_centroids(n: int) -> FloatArray:
    """Barycentric centroids ``(n², 3)`` of a triangle cut into n² equal ones."""
    centroids = []
    for i in range(n):
        for j in range(n - i):
            centroids.append(((i + 1 / 3) / n, (j + 1 / 3) / n))
            if i + j < n - 1:
                centroids.append(((i + 2 / 3) / n, (j + 2 / 3) / n))
    uv = np.array(centroids)
    return np.column_stack([1 - uv.sum(axis=1), uv])


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """The gap of a closed valve as an image, seen from the atrium along the annulus normal."""

    #: (rows,) and (columns,) mm, pixel centres along those directions of the annulus
    anterior: FloatArray
    lateral: FloatArray
    #: (rows, columns), pixels of the gap, and other pixels within the annulus that no midsurface
    #: covers
    open: BoolArray
    slit: BoolArray
    #: (rows, columns) mm, depth of the nearest midsurface below the annulus plane
    level: FloatArray
    resolution: float  #: mm

    @property
    def area(self) -> float:
        """Regurgitant gap, mm²."""
        return float(self.open.sum() * self.resolution**2)


def find_gap(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    reach: float,
    resolution: float = 0.1,
) -> Gap:
    """Find the gap of a closed valve; a gap that an overlapping leaflet hides is not counted.

    InputError or GeometryError if the reach is negative or the resolution gives too large an image.

    Parameters
    ----------
    vertices, triangles : ndarray
        Midsurfaces in their current shape, ``(n, 3)`` mm and ``(m, 3)``.
    annulus, plane
        ``(k, 3)`` mm in loop order, and its plane.
    reach : float
        mm, largest distance of two midsurfaces that touch.
    resolution : float
        mm, size of a pixel.
    """
    if not (np.isfinite(reach) and reach >= 0):
        raise InputError(f"reach of the contact = {reach} mm, expected >= 0")
    image = project_leaflets(vertices, triangles, annulus, plane, resolution)
    uncovered = np.isinf(image.depth)
    pixels, nearest = distance_transform_edt(uncovered, return_indices=True)
    inside = image.inside & uncovered
    open_ = inside & (resolution * pixels > 0.5 * reach)
    level = image.depth[tuple(nearest)]
    return Gap(image.anterior, image.lateral, open_, inside & ~open_, level, resolution)
