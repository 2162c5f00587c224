"""The annulus: its plane, the three clinical directions, its size and its minimal surface."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class AnnulusPlane:
    """Best plane through an annulus, with the three clinical directions."""

    origin: FloatArray  #: (3,) mm, centroid of the annulus curve, weighted by length
    #: (3,) unit, from atrium to ventricle; in the plane from posterior to anterior; ``normal ×
    #: anterior``
    normal: FloatArray
    anterior: FloatArray
    lateral: FloatArray

    def coordinates(self, points: FloatArray) -> FloatArray:
        """Coordinates ``(n, 3)`` mm of `points` along anterior, lateral and normal."""
        axes = np.column_stack([self.anterior, self.lateral, self.normal])
        return np.asarray((np.asarray(points, dtype=np.float64) - self.origin) @ axes)


def checked_loop(annulus: FloatArray) -> FloatArray:
    """A closed curve ``(k, 3)`` mm as an array; GeometryError if it is none."""
    loop = np.asarray(annulus, dtype=np.float64)
    if loop.ndim != 2 or loop.shape[1] != 3 or len(loop) < 3:
        raise GeometryError(f"annulus: shape {loop.shape}, expected (k, 3) with k >= 3 points (mm)")
    bad = np.flatnonzero(~np.isfinite(loop).all(axis=1))
    if len(bad):
        raise GeometryError(f"annulus: points {bad[:5].tolist()} are not finite numbers")
    return loop


def unit_vector(vector: FloatArray, what: str) -> FloatArray:
    """Scale a direction to length one; `what` names it in the error."""
    length = float(np.linalg.norm(vector))
    if not length > 1e-9:
        raise GeometryError(f"{what}: direction has no length; give a point away from the centre")
    return np.asarray(vector / length)


def annulus_plane(
    annulus: FloatArray, ventricle_point: FloatArray, anterior_point: FloatArray
) -> AnnulusPlane:
    """Fit the annulus plane by least squares, each segment of the curve weighted by its length.

    GeometryError for wrong shape, non-finite or collinear points, or a point that gives no
    direction.

    Parameters
    ----------
    annulus
        ``(k, 3)`` mm, closed curve in order (the last point joins the first).
    ventricle_point
        ``(3,)`` mm, any point on the ventricular side (the middle of the papillary tips).
    anterior_point
        ``(3,)`` mm, any point on the anterior side (the middle of the anterior annulus).
    """
    loop = checked_loop(annulus)
    following = np.roll(loop, -1, axis=0)
    length = np.linalg.norm(following - loop, axis=1)
    middle = 0.5 * (loop + following)
    if not length.sum() > 0:
        raise GeometryError("annulus: all points coincide")
    origin = (length[:, None] * middle).sum(axis=0) / length.sum()
    weighted = np.sqrt(length)[:, None] * (middle - origin)
    _, singular, directions = np.linalg.svd(weighted, full_matrices=False)
    if singular[1] <= 1e-9 * singular[0]:
        raise GeometryError("annulus: points lie on one line; no plane can be fitted")
    normal = directions[2]
    side = float((np.asarray(ventricle_point) - origin) @ normal)
    if abs(side) < 1e-9:
        raise GeometryError("ventricle_point lies in the annulus plane; it must lie below it")
    normal = normal if side > 0 else -normal
    offset = np.asarray(anterior_point, dtype=np.float64) - origin
    anterior = unit_vector(offset - (offset @ normal) * normal, "anterior_point")
    return AnnulusPlane(origin, normal, anterior, np.cross(normal, anterior))


@dataclass(frozen=True, slots=True)
class AnnulusMeasurements:
    """Size of an annulus (mm, mm²).

    Diameters are chords through the centre along the anterior and the lateral direction, the height
    is the extent along the normal, and the area that of the projection on the plane.
    """

    anteroposterior_diameter: float
    commissural_diameter: float
    height: float
    circumference: float
    projected_area: float


def _chord(along: FloatArray, across: FloatArray) -> float:
    """Length of the polygon's chord on the line ``across = 0``."""
    next_along, next_across = np.roll(along, -1), np.roll(across, -1)
    crosses = (across <= 0) != (next_across <= 0)
    if crosses.sum() < 2:
        raise GeometryError("annulus: its centroid lies outside the curve; check the point order")
    fraction = across[crosses] / (across[crosses] - next_across[crosses])
    hits = along[crosses] + fraction * (next_along[crosses] - along[crosses])
    return float(hits.max() - hits.min())


def measure_annulus(annulus: FloatArray, plane: AnnulusPlane) -> AnnulusMeasurements:
    """Measure an annulus curve ``(k, 3)`` mm in the directions of its `plane`."""
    loop = checked_loop(annulus)
    x, y, z = plane.coordinates(loop).T
    step = np.roll(loop, -1, axis=0) - loop
    return AnnulusMeasurements(
        anteroposterior_diameter=_chord(x, y),
        commissural_diameter=_chord(y, x),
        height=float(np.ptp(z)),
        circumference=float(np.linalg.norm(step, axis=1).sum()),
        projected_area=float(0.5 * abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())),
    )


RINGS = 12
"""Of vertices between the curve and its centre."""
MAX_ROUNDS = 100
TOLERANCE = 1e-7
"""Relative change of the area at which the surface is taken as minimal."""


def spanning_surface(annulus: FloatArray, plane: AnnulusPlane) -> tuple[FloatArray, IntArray]:
    """Triangulate the minimal surface (the soap film) in a closed curve.

    Its height ``h`` over the plane solves ``div(grad h / sqrt(1 + |grad h|²)) = 0`` with linear
    triangles (Johnson and Thomée 1975, Math. Comp. 29:343); the root is that of the iteration
    before. Over a convex outline this surface is unique (Radó 1930, Math. Z. 32:763).

    GeometryError if it is no curve, or its projection on the plane is not star-shaped about its
    centre.

    Parameters
    ----------
    annulus : (k, 3) mm
        In loop order.
    plane : AnnulusPlane
        Of this annulus.

    Returns
    -------
    vertices : (n, 3) mm
        The points of the curve first, in their order.
    triangles : (m, 3)
    """
    loop = plane.coordinates(checked_loop(annulus))
    k = len(loop)
    outline = loop[:, :2] - loop[:, :2].mean(axis=0)
    following = np.roll(outline, -1, axis=0)
    turn = outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]
    if not ((turn > 0).all() or (turn < 0).all()):
        raise GeometryError(
            f"annulus: its outline turns back at point {int(np.argmin(np.abs(turn)))} seen from "
            "its centre; check the order of its points"
        )
    shrink = 1.0 - np.arange(RINGS) / RINGS
    flat = np.concatenate([(shrink[:, None, None] * outline).reshape(-1, 2), np.zeros((1, 2))])
    triangles = _disc(k)
    gradient, size = _gradient(flat, triangles)
    height = np.concatenate([np.tile(loop[:, 2], RINGS), [loop[:, 2].mean()]])
    area = np.inf
    for _ in range(MAX_ROUNDS):
        slope = (gradient @ height).reshape(2, -1)
        stretch = np.sqrt(1.0 + (slope**2).sum(axis=0))
        before, area = area, float((size * stretch).sum())
        if abs(before - area) <= TOLERANCE * area:
            break
        stiffness = (gradient.T @ sp.diags_array(np.tile(size / stretch, 2)) @ gradient).tocsr()
        rows = stiffness[k:]
        height = np.concatenate(
            [loop[:, 2], spla.spsolve(rows[:, k:].tocsc(), -(rows[:, :k] @ loop[:, 2]))]
        )
    flat = flat + loop[:, :2].mean(axis=0)
    axes = np.stack([plane.anterior, plane.lateral, plane.normal])
    return plane.origin + np.column_stack([flat, height]) @ axes, triangles


def _disc(k: int) -> IntArray:
    """Triangles between rings of k vertices, from the outermost to the centre."""
    here = np.arange(k)
    after = (here + 1) % k
    triangles = []
    for ring in range(RINGS - 1):
        a, b = here + ring * k, after + ring * k
        triangles += [np.stack([a, b, b + k], 1), np.stack([a, b + k, a + k], 1)]
    last = (RINGS - 1) * k
    triangles.append(np.stack([here + last, after + last, np.full(k, RINGS * k)], 1))
    return np.concatenate(triangles)


def _gradient(points: FloatArray, triangles: IntArray) -> tuple[sp.csr_array, FloatArray]:
    """Matrix of the triangles' derivatives along x, then along y; and their areas, mm²."""
    m = len(triangles)
    corner = points[triangles]
    # The edge opposite to a corner, turned by a right angle, is the gradient times twice the area.
    edge = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
    doubled = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    derivative = np.stack([-edge[..., 1], edge[..., 0]]) / doubled[None, :, None]
    row = np.arange(2 * m).repeat(3)
    column = np.tile(triangles.ravel(), 2)
    matrix = sp.csr_array((derivative.ravel(), (row, column)), shape=(2 * m, len(points)))
    return matrix, np.abs(0.5 * doubled)
