"""The largest ball that can roll through a valve: an oblique leak made one number.

A line of sight does not see a gap between overlapping leaflets; a ball does. On a regular grid the
distance to the leaflets is computed, and the path from the atrium to the ventricle whose smallest
distance is as large as possible (the widest path) gives the ball. A flange that continues the
annulus outwards to infinity keeps paths from going around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.proximity import distance_to_triangle, row
from mvest.valve.measure.annulus import AnnulusPlane, checked_loop

MAX_GRID_POINTS = 60_000_000


@dataclass(frozen=True, slots=True)
class PassingBall:
    """Largest ball that passes from atrium to ventricle.

    Attributes
    ----------
    diameter
        mm; 0 when none passes that the grid can see. The true diameter is at most
        ``sqrt(3) * resolution`` larger.
    centre
        ``(3,)`` mm, centre of the ball at the narrowest place of its path.
    resolution
        mm between grid points.
    """

    diameter: float
    centre: FloatArray
    resolution: float


@njit(cache=True)
def _near_distances(
    points: FloatArray,
    triangles: IntArray,
    origin: FloatArray,
    step: float,
    distance: FloatArray,
    owner: IntArray,
) -> None:
    """Exact distance and nearest triangle at grid points within one step of a triangle's box."""
    low = np.empty(3, dtype=np.int64)
    high = np.empty(3, dtype=np.int64)
    for t in range(triangles.shape[0]):
        a, b = row(points, triangles[t, 0]), row(points, triangles[t, 1])
        c = row(points, triangles[t, 2])
        for k in range(3):
            first = (min(a[k], b[k], c[k]) - origin[k]) / step
            last = (max(a[k], b[k], c[k]) - origin[k]) / step
            low[k] = max(int(np.floor(first)) - 1, 0)
            high[k] = min(int(np.ceil(last)) + 1, distance.shape[k] - 1)
        for i in range(low[0], high[0] + 1):
            x = origin[0] + i * step
            for j in range(low[1], high[1] + 1):
                y = origin[1] + j * step
                for k in range(low[2], high[2] + 1):
                    z = origin[2] + k * step
                    d = distance_to_triangle((x, y, z), a, b, c)[0]
                    if d < distance[i, j, k]:
                        distance[i, j, k] = d
                        owner[i, j, k] = t


@njit(cache=True)
def _far_distances(
    points: FloatArray,
    triangles: IntArray,
    half: FloatArray,
    origin: FloatArray,
    step: float,
    nearest: NDArray[np.int32],
    owner: IntArray,
    distance: FloatArray,
) -> None:
    """Distance beyond one step of any triangle, and of all of them what half a leaflet takes off.

    ``nearest`` holds the indices, axis first, of the nearest grid point that has an owner.
    """
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            for k in range(distance.shape[2]):
                t = owner[nearest[0, i, j, k], nearest[1, i, j, k], nearest[2, i, j, k]]
                if distance[i, j, k] > step:
                    p = (origin[0] + i * step, origin[1] + j * step, origin[2] + k * step)
                    a, b = row(points, triangles[t, 0]), row(points, triangles[t, 1])
                    c = row(points, triangles[t, 2])
                    distance[i, j, k] = distance_to_triangle(p, a, b, c)[0]
                distance[i, j, k] -= half[t]


@njit(cache=True)
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def _bottleneck(distance: FloatArray, order: IntArray) -> int:
    """Grid point of smallest distance on the widest path from the first to the last layer.

    Points are added from the widest to the narrowest and joined with their six neighbours; the
    point whose addition joins both end layers is the narrowest of the widest path.
    """
    nx, ny, nz = distance.shape
    n = nx * ny * nz
    atrium, ventricle = n, n + 1
    parent = np.arange(n + 2)
    added = np.zeros(n, dtype=np.bool_)
    strides = (ny * nz, nz, 1)
    for index in order:
        added[index] = True
        i = index // strides[0]
        j = (index // nz) % ny
        k = index % nz
        for axis in range(3):
            position = (i, j, k)[axis]
            for side in range(2):
                if side == 0 and position == 0:
                    continue
                if side == 1 and position == (nx, ny, nz)[axis] - 1:
                    continue
                neighbour = index + strides[axis] * (2 * side - 1)
                if added[neighbour]:
                    first, second = _root(parent, index), _root(parent, neighbour)
                    if first != second:
                        parent[first] = second
        if k == 0:
            parent[_root(parent, index)] = _root(parent, atrium)
        if k == nz - 1:
            parent[_root(parent, index)] = _root(parent, ventricle)
        if _root(parent, atrium) == _root(parent, ventricle):
            return index
    return -1


def annulus_flange(
    annulus: FloatArray, reach: float, spacing: float
) -> tuple[FloatArray, IntArray]:
    """Continue an annulus outwards, each point along its own radius at its own height.

    Parameters
    ----------
    annulus
        ``(k, 3)`` mm in annulus coordinates (the third along the normal), in loop order.
    reach
        mm from the centre up to which the flange goes at least.
    spacing
        mm, largest radial size of a triangle.

    Returns
    -------
    vertices, triangles
        Ring after ring, the first being the annulus itself.
    """
    radius = np.linalg.norm(annulus[:, :2], axis=1)
    if not radius.min() > 0:
        raise GeometryError("annulus: the curve passes through its own centre")
    growth = reach / radius.min()
    rings = max(int(np.ceil((growth - 1.0) * radius.max() / spacing)), 1)
    factors = np.linspace(1.0, max(growth, 1.0 + 1e-6), rings + 1)
    vertices = np.concatenate(
        [np.column_stack([factor * annulus[:, :2], annulus[:, 2]]) for factor in factors]
    )
    k = len(annulus)
    here = np.arange(k)
    after = (here + 1) % k
    quads = np.concatenate(
        [np.column_stack([here, after, after + k, here + k]) + ring * k for ring in range(rings)]
    )
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def largest_passing_ball(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    resolution: float = 0.3,
    thickness: FloatArray | None = None,
) -> PassingBall:
    """Find the largest ball that passes between the leaflets from atrium to ventricle.

    Parameters
    ----------
    vertices, triangles
        Leaflets in their current shape, ``(n, 3)`` mm and ``(m, 3)``, attached to the annulus:
        their midsurface with its `thickness`, or their outer surface without.
    annulus
        ``(k, 3)`` mm in loop order.
    plane
        Plane of that annulus.
    resolution
        mm between grid points.
    thickness
        ``(n,)`` mm, half of which is taken from the distance to the midsurface.

    Returns
    -------
    PassingBall
        Its diameter is 0 when nothing passes that is wider than `resolution` less the thickness:
        below that a step between two grid points could cross a leaflet unseen.

    Raises
    ------
    GeometryError
        The resolution is not positive, the grid would have more than 60 million points, or the
        thickness is not one positive number per vertex.
    """
    if not (np.isfinite(resolution) and resolution > 0):
        raise GeometryError(f"resolution = {resolution} mm; give a positive grid step")
    if thickness is not None:
        thickness = np.asarray(thickness, dtype=np.float64)
        if thickness.shape != (len(vertices),) or not (thickness > 0).all():
            raise GeometryError(
                f"thickness: shape {thickness.shape}, expected ({len(vertices)},) positive mm"
            )
    leaflets = plane.coordinates(vertices)
    ring = plane.coordinates(checked_loop(annulus))
    everything = np.concatenate([leaflets[np.unique(triangles)], ring])
    margin = 2 * resolution + 1.0
    low, high = everything.min(axis=0) - margin, everything.max(axis=0) + margin
    shape = np.ceil((high - low) / resolution).astype(np.int64) + 1
    if float(np.prod(shape.astype(np.float64))) > MAX_GRID_POINTS:
        raise GeometryError(
            f"resolution = {resolution} mm gives a grid of {shape.tolist()} points, more than "
            f"{MAX_GRID_POINTS}; give a coarser one"
        )
    corner = float(np.hypot(*np.abs([low[:2], high[:2]]).max(axis=0))) + margin
    flange, flange_triangles = annulus_flange(ring, corner, 5 * resolution)
    half = np.zeros(len(triangles))
    if thickness is not None:
        half = 0.5 * thickness[triangles].mean(axis=1)
    # Leaflets and flange apart: nearest of all is not always what leaves least room. The flange,
    # as thick as a grid step, cannot be crossed unseen.
    wall = np.full(len(flange_triangles), 0.5 * resolution)
    distance = np.minimum(
        _distance_field(leaflets, triangles, half, low, shape, resolution),
        _distance_field(flange, flange_triangles, wall, low, shape, resolution),
    )
    unseen = max(0.5 * resolution - float(half.min()), 0.0)
    order = np.argsort(-distance.ravel())
    narrowest = int(_bottleneck(distance, order))
    radius = float(distance.ravel()[narrowest])
    where = low + resolution * np.array(np.unravel_index(narrowest, tuple(shape)))
    axes = np.column_stack([plane.anterior, plane.lateral, plane.normal])
    return PassingBall(
        diameter=2 * radius if radius > unseen else 0.0,
        centre=plane.origin + axes @ where,
        resolution=resolution,
    )


def _distance_field(
    points: FloatArray,
    triangles: IntArray,
    half: FloatArray,
    low: FloatArray,
    shape: IntArray,
    step: float,
) -> FloatArray:
    """Distance (mm) of every grid point to the nearest triangle, less that triangle's `half`.

    Exact near the triangles. Farther away it is the distance to the triangle that is nearest to
    the nearest of those near points: never below the true one, and above it by a fraction of a
    step at most.
    """
    triangles = np.ascontiguousarray(triangles, dtype=np.int64)
    distance = np.full(tuple(shape), np.inf)
    owner = np.full(tuple(shape), -1, dtype=np.int64)
    _near_distances(points, triangles, low, step, distance, owner)
    nearest = distance_transform_edt(distance > step, return_distances=False, return_indices=True)
    _far_distances(points, triangles, half, low, step, nearest, owner, distance)
    return distance
