"""The annulus: its plane, the three clinical directions, and its size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import GeometryError
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True)
class AnnulusPlane:
    """Best plane through an annulus, with the three clinical directions.

    Attributes
    ----------
    origin
        ``(3,)`` mm, centroid of the annulus curve (weighted by length).
    normal
        ``(3,)`` unit, points from the atrium to the ventricle.
    anterior
        ``(3,)`` unit, in the plane, points from the posterior to the anterior side.
    lateral
        ``(3,)`` unit, ``normal × anterior``, along the commissures.
    """

    origin: FloatArray
    normal: FloatArray
    anterior: FloatArray
    lateral: FloatArray

    def coordinates(self, points: FloatArray) -> FloatArray:
        """Coordinates ``(n, 3)`` mm of `points` along anterior, lateral and normal."""
        axes = np.column_stack([self.anterior, self.lateral, self.normal])
        result: FloatArray = (np.asarray(points, dtype=np.float64) - self.origin) @ axes
        return result


def checked_loop(annulus: FloatArray) -> FloatArray:
    """Return a closed curve ``(k, 3)`` mm as an array, or say what is wrong with it."""
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
    result: FloatArray = vector / length
    return result


def annulus_plane(
    annulus: FloatArray, ventricle_point: FloatArray, anterior_point: FloatArray
) -> AnnulusPlane:
    """Fit the annulus plane by least squares, every stretch of the curve weighted by its length.

    Parameters
    ----------
    annulus
        ``(k, 3)`` mm, closed curve in order (the last point joins the first).
    ventricle_point
        ``(3,)`` mm, any point on the ventricular side (the middle of the papillary tips).
    anterior_point
        ``(3,)`` mm, any point on the anterior side (the middle of the anterior annulus).

    Raises
    ------
    GeometryError
        Wrong shape, non-finite or collinear points, or a point that gives no direction.
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

    Attributes
    ----------
    anteroposterior_diameter
        Extent along the anterior direction of the chord through the centre, mm.
    commissural_diameter
        Extent along the lateral direction of the chord through the centre, mm.
    height
        Extent along the normal (saddle height), mm.
    circumference, projected_circumference
        Length of the curve in space and of its projection on the plane, mm.
    area, projected_area
        Area of the cone of triangles from the centroid to the curve, and of the projection, mm².
    """

    anteroposterior_diameter: float
    commissural_diameter: float
    height: float
    circumference: float
    projected_circumference: float
    area: float
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
    following = np.roll(loop, -1, axis=0)
    spokes = np.cross(loop - plane.origin, following - plane.origin)
    flat = np.column_stack([x, y])
    flat_following = np.roll(flat, -1, axis=0)
    return AnnulusMeasurements(
        anteroposterior_diameter=_chord(x, y),
        commissural_diameter=_chord(y, x),
        height=float(np.ptp(z)),
        circumference=float(np.linalg.norm(following - loop, axis=1).sum()),
        projected_circumference=float(np.linalg.norm(flat_following - flat, axis=1).sum()),
        area=float(0.5 * np.linalg.norm(spokes, axis=1).sum()),
        projected_area=float(
            0.5 * abs((x * flat_following[:, 1] - flat_following[:, 0] * y).sum())
        ),
    )
