"""Clinical measurements of a valve: closure as a whole, tenting, leaflets, papillary tips.

Plain arrays in, numbers in mm, mm² or mm³ out. Lengths follow the usual echocardiographic
definitions; each docstring says which. The annulus is measured in `mvest.valve.measure.annulus`,
the parts of closure in `mvest.valve.measure.coaptation` and `mvest.valve.measure.passing_ball`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.proximity import intersecting_triangles, plane_section
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.annulus import AnnulusPlane, SpanningSurface, checked_loop, unit_vector
from mvest.valve.measure.coaptation import (
    coaptation_area,
    coaptation_length,
    orifice_area,
    project_leaflets,
)
from mvest.valve.measure.passing_ball import largest_passing_ball


@dataclass(frozen=True, slots=True)
class ClosureMeasurements:
    """How far two leaflets close their annulus.

    Attributes
    ----------
    orifice_area
        mm², open in the line of sight from the atrium.
    passing_ball_diameter
        mm, largest ball that passes between the leaflets (their thickness taken off).
    coaptation_length
        mm in the middle, the smaller of both leaflets'.
    coaptation_area
        mm², mean of both leaflets.
    contact_distance
        mm between midsurfaces, up to which they count as touching.
    intersections
        Number of pairs of midsurface triangles that pass through each other.
    """

    orifice_area: float
    passing_ball_diameter: float
    coaptation_length: float
    coaptation_area: float
    contact_distance: float
    intersections: int


def measure_closure(
    vertices: FloatArray,
    triangles: IntArray,
    region: IntArray,
    thickness: FloatArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    contact_distance: float,
) -> ClosureMeasurements:
    """Measure the closure of a valve from its midsurface in the current shape.

    Parameters
    ----------
    vertices, triangles
        ``(n, 3)`` mm and ``(m, 3)``, normals towards the ventricle.
    region
        ``(m,)`` leaflet of each triangle.
    thickness
        ``(n,)`` mm.
    annulus, plane
        Current annulus ``(k, 3)`` mm in loop order, and its plane.
    contact_distance
        mm between midsurfaces that count as touching: thickness plus the contact model's gap.
    """
    first, second = (triangles[np.asarray(region) == label] for label in (0, 1))
    return ClosureMeasurements(
        orifice_area=orifice_area(vertices, triangles, annulus, plane),
        passing_ball_diameter=largest_passing_ball(
            vertices, triangles, annulus, plane, thickness=thickness
        ).diameter,
        coaptation_length=coaptation_length(
            vertices, first, second, plane, contact_distance
        ).length,
        coaptation_area=coaptation_area(vertices, first, second, contact_distance),
        contact_distance=contact_distance,
        intersections=len(intersecting_triangles(vertices, triangles)),
    )


@dataclass(frozen=True, slots=True)
class TentingMeasurements:
    """Tenting of a closed valve.

    Attributes
    ----------
    height
        Largest distance of the coaptation line below the annulus plane, mm (negative: billowing).
    area
        Area between annulus plane and leaflets in the middle antero-posterior plane, mm².
    volume
        Volume between the annulus plane and the leaflets inside the annulus, mm³; parts of a
        leaflet above the plane count negative.
    """

    height: float
    area: float
    volume: float


def measure_tenting(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    resolution: float = 0.2,
) -> TentingMeasurements:
    """Measure tenting as seen from the atrium: first leaflet surface below each annulus point.

    Every point of the projected annulus is assigned the depth of the first leaflet surface met on
    the way from atrium to ventricle; height is the largest depth on the middle plane, area and
    volume its sums over the middle line and the whole annulus. Points where nothing is met (an
    open orifice) count as no depth. On a valve that is closed this is the usual definition.

    Parameters
    ----------
    vertices, triangles
        Midsurface of all leaflets, ``(n, 3)`` mm and ``(m, 3)``.
    annulus
        ``(k, 3)`` mm in loop order.
    resolution
        Pixel size, mm.
    """
    image = project_leaflets(vertices, triangles, annulus, plane, resolution)
    depth = np.where(image.inside & np.isfinite(image.depth), image.depth, 0.0)
    centre = int(np.argmin(np.abs(image.lateral)))
    column = depth[:, centre]
    return TentingMeasurements(
        height=float(column[np.argmax(column)]),
        area=float(column.sum() * resolution),
        volume=float(depth.sum() * resolution**2),
    )


@dataclass(frozen=True, slots=True)
class ProlapseMeasurements:
    """What of the leaflets lies on the atrial side.

    Attributes
    ----------
    height, volume
        Largest height above the annulus plane, mm, and volume between them there, mm³.
    billow_height, billow_volume
        The same above the minimal surface that spans the annulus.
    """

    height: float
    volume: float
    billow_height: float
    billow_volume: float


def measure_prolapse(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    spanning: SpanningSurface,
    resolution: float = 0.2,
) -> ProlapseMeasurements:
    """Measure what of the first leaflet surface seen from the atrium lies above the annulus.

    An annulus is a saddle, and the leaflets near its two high points lie above its plane in every
    valve (Levine et al. 1987, Circulation 75:756); above the surface that spans it only a leaflet
    that bulges into the atrium does. Parameters as in `measure_tenting`.
    """
    image = project_leaflets(vertices, triangles, annulus, plane, resolution)
    film = project_leaflets(spanning.vertices, spanning.triangles, annulus, plane, resolution)
    seen = image.inside & np.isfinite(image.depth)
    over_plane = np.where(seen, np.maximum(-image.depth, 0.0), 0.0)
    both = seen & np.isfinite(film.depth)
    over_film = np.zeros_like(over_plane)
    over_film[both] = np.maximum(film.depth[both] - image.depth[both], 0.0)
    pixel = resolution**2
    return ProlapseMeasurements(
        height=float(over_plane.max()),
        volume=float(over_plane.sum() * pixel),
        billow_height=float(over_film.max()),
        billow_volume=float(over_film.sum() * pixel),
    )


def leaflet_length(
    vertices: FloatArray,
    triangles: IntArray,
    plane: AnnulusPlane,
) -> float:
    """Length (mm) of a leaflet from annulus to free edge, in the middle of A2 or P2.

    The section is the plane through the annulus centre spanned by its normal and the anterior
    direction; its length is the sum of the segments in which it cuts the leaflet's triangles.

    Parameters
    ----------
    vertices, triangles
        The triangles of one leaflet.
    plane : AnnulusPlane
    """
    across = unit_vector(np.cross(plane.normal, plane.anterior), "anterior direction")
    segments, _ = plane_section(vertices, triangles, plane.origin, across)
    return float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum())


def surface_area(vertices: FloatArray, triangles: IntArray) -> float:
    """Area (mm²) of a triangulated surface."""
    return float(areas(vertices, triangles).sum())


@dataclass(frozen=True, slots=True)
class PapillaryMeasurements:
    """Place of the papillary tips (mm).

    Attributes
    ----------
    depth
        ``(n_tips,)`` distance below the annulus plane.
    centre_distance
        ``(n_tips,)`` distance to the annulus centre.
    annulus_distance
        ``(n_tips,)`` distance to the nearest annulus point (tethering length).
    separation
        ``(n_tips, n_tips)`` distances between tips.
    """

    depth: FloatArray
    centre_distance: FloatArray
    annulus_distance: FloatArray
    separation: FloatArray


def measure_papillary_tips(
    tips: FloatArray, annulus: FloatArray, plane: AnnulusPlane
) -> PapillaryMeasurements:
    """Measure where the papillary tips ``(n_tips, 3)`` mm lie relative to the annulus."""
    loop = checked_loop(annulus)
    points = np.asarray(tips, dtype=np.float64).reshape(-1, 3)
    following = np.roll(loop, -1, axis=0)
    step = following - loop
    squared = np.maximum((step**2).sum(axis=1), 1e-30)
    offset = points[:, None] - loop
    fraction = np.clip((offset * step).sum(axis=2) / squared, 0.0, 1.0)
    gaps = np.linalg.norm(offset - fraction[..., None] * step, axis=2)
    return PapillaryMeasurements(
        depth=plane.coordinates(points)[:, 2],
        centre_distance=np.linalg.norm(points - plane.origin, axis=1),
        annulus_distance=gaps.min(axis=1),
        separation=np.linalg.norm(points[:, None] - points[None], axis=2),
    )
