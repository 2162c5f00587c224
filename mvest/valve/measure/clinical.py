"""Clinical measurements of a valve in one frame: plain arrays in, numbers with their units out.

Lengths follow the usual echocardiographic definitions, which the names below state. Annulus,
contact and orifice have modules of their own beside this one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from mvest.errors import MvestError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.moving_distance import closest_on_loop
from mvest.valve.geometry.proximity import plane_section
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.annulus import (
    AnnulusPlane,
    annulus_plane,
    checked_loop,
    measure_annulus,
    spanning_surface,
    unit_vector,
)
from mvest.valve.measure.coaptation import (
    coaptation_area,
    coaptation_length,
    orifice_area,
    project_leaflets,
)

Numbers: TypeAlias = dict[str, float]
"""Name with its unit -> number."""

_MEANING = {
    "annulus_circumference_mm": "length of the annulus in space",
    "annulus_area_mm2": "area within the annulus seen along the normal of its plane (2D area)",
    "annulus_area_3d_mm2": "area of the minimal surface that spans the annulus (3D area)",
    "ap_diameter_mm": "chord of the annulus through its centre from anterior to posterior, seen "
    "along the normal",
    "commissural_diameter_mm": "chord of the annulus through its centre across the former, seen "
    "along the normal",
    "annulus_height_mm": "extent of the annulus along the normal of its plane",
    "annulus_height_to_width_ratio": "height of the annulus over its commissural diameter",
    "annulus_sphericity_ratio": "anteroposterior over commissural diameter of the annulus",
    "tenting_height_mm": "largest depth of the leaflets below the annulus plane in the middle "
    "anteroposterior section",
    "tenting_volume_mm3": "volume between annulus plane and leaflets; parts above it count "
    "negative",
    "prolapse_height_mm": "largest height of the leaflets above the annulus plane; a saddle-shaped "
    "annulus has some of it in every valve",
    "prolapse_volume_mm3": "volume of the leaflets above the annulus plane; likewise",
    "billow_height_mm": "largest height of the leaflets above the minimal surface that spans the "
    "annulus",
    "billow_volume_mm3": "volume between the leaflets and the minimal surface that spans the "
    "annulus, above it",
    "orifice_mm2": "area within the annulus that no leaflet covers seen along the normal",
    "coaptation_length_mm": "length over which the leaflets touch in the middle anteroposterior "
    "section, the smaller of both",
    "coaptation_area_mm2": "area over which the leaflets touch, mean of both",
    "tip_depth_mm": "mean distance of the papillary tips below the annulus plane",
    "tip_annulus_distance_mm": "mean distance of the papillary tips to their nearest "
    "annulus points",
    "tip_separation_mm": "distance between the papillary tips",
}
_MEANING_OF_PART = {
    "area_mm2": "area of the {} leaflet",
    "length_mm": "length of the {} leaflet from annulus to free edge in the middle anteroposterior "
    "section",
    "depth_mm": "distance of papillary {} below the annulus plane",
    "annulus_distance_mm": "distance of papillary {} to its nearest annulus point",
}


class MeasuredLeaflets(Protocol):
    """What is measured of leaflets besides their shape, as `LeafletSurface` has it."""

    @property
    def triangles(self) -> IntArray:
        """``(m, 3)``, normals to the ventricle."""

    @property
    def region(self) -> IntArray:
        """``(m,)`` leaflet of each triangle."""

    @property
    def region_names(self) -> tuple[str, ...]:
        """Of the leaflets, the anterior one first."""


def clinical_names(region_names: Sequence[str], tip_names: Sequence[str] = ()) -> list[str]:
    """Every name that `clinical_measurements` can give two leaflets and two tips, in order."""
    leaflet, tip = list(_MEANING_OF_PART)[:2], list(_MEANING_OF_PART)[2:]
    named = [f"{name}_{ending}" for name in region_names for ending in leaflet]
    return [*_MEANING, *named, *(f"{name}_{ending}" for name in tip_names for ending in tip)]


def clinical_measurements(
    vertices: FloatArray,
    surface: MeasuredLeaflets,
    annulus: FloatArray,
    tips: FloatArray,
    contact_distance: float,
    *,
    tip_names: Sequence[str] = (),
) -> Numbers:
    """Measure a valve in one frame.

    Diameters, areas, height and circumference of the annulus are those of three-dimensional
    echocardiography (Grewal et al. 2010, Circulation 121:1423), its height over its width that of
    Salgo et al. 2002 (Circulation 106:711).

    Parameters
    ----------
    vertices : (n, 3) mm
        Where the vertices of ``surface`` are in this frame.
    surface : LeafletSurface or the like
        Triangles and regions.
    annulus : (k, 3) mm
        In loop order.
    tips : (t, 3) mm
        Papillary tips.
    contact_distance : float
        mm between midsurfaces that count as touching.
    tip_names : sequence of str
        For each tip, if every one is to be measured besides their mean: ``tip_0``.

    Returns
    -------
    dict
        Name with unit -> number; what the shape defies is not in it, and nothing is where the
        annulus has no plane. The first region is the anterior one.
    """
    try:
        plane = _plane(vertices, surface, annulus, tips)
    except MvestError:
        return {}
    triangles, region = surface.triangles, np.asarray(surface.region)
    pair = [triangles[region == number] for number in range(len(surface.region_names))]
    seen = vertices, triangles, annulus, plane
    numbers = _tried(_annulus, annulus, plane)
    numbers |= _tried(tenting, *seen)
    numbers |= _tried(_prolapse, *seen)
    if len(pair) == 2:
        numbers |= _tried(closure, *seen, pair, contact_distance)
    for name, own in zip(surface.region_names, pair, strict=True):
        numbers[f"{name}_area_mm2"] = float(areas(vertices, own).sum())
        if len(pair) == 2:
            numbers[f"{name}_length_mm"] = leaflet_length(vertices, own, plane)
    return numbers | _tips(tips, annulus, plane, tip_names)


def annulus_and_tips(
    vertices: FloatArray, surface: MeasuredLeaflets, annulus: FloatArray, tips: FloatArray
) -> Numbers:
    """Those of `clinical_measurements` that take no leaflets, in a hundredth of the time.

    Parameters
    ----------
    vertices, surface, annulus, tips
        As there; of the leaflets only which side the anterior one is on.
    """
    try:
        plane = _plane(vertices, surface, annulus, tips)
    except MvestError:
        return {}
    return _tried(_annulus, annulus, plane) | _tips(tips, annulus, plane, ())


def _plane(
    vertices: FloatArray, surface: MeasuredLeaflets, annulus: FloatArray, tips: FloatArray
) -> AnnulusPlane:
    # The middle of a leaflet's own annulus is nearest to that leaflet.
    first = np.unique(surface.triangles[surface.region == 0])
    gap = np.linalg.norm(annulus[:, None] - vertices[first][None], axis=2).min(axis=1)
    near = annulus[gap <= np.quantile(gap, 0.25)]
    return annulus_plane(annulus, tips.mean(axis=0), near.mean(axis=0))


def _tried(measure: Callable[..., Numbers], *shape: Any) -> Numbers:
    """Measurements, or none where the shape defies them."""
    try:
        return measure(*shape)
    except MvestError:
        return {}


def _annulus(annulus: FloatArray, plane: AnnulusPlane) -> Numbers:
    size = measure_annulus(annulus, plane)
    return {
        "ap_diameter_mm": size.anteroposterior_diameter,
        "commissural_diameter_mm": size.commissural_diameter,
        "annulus_height_mm": size.height,
        "annulus_height_to_width_ratio": size.height / size.commissural_diameter,
        "annulus_sphericity_ratio": size.anteroposterior_diameter / size.commissural_diameter,
        "annulus_circumference_mm": size.circumference,
        "annulus_area_mm2": size.projected_area,
    }


def tenting(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    resolution: float = 0.2,
) -> Numbers:
    """Tenting as seen from the atrium: depth of the first leaflet surface below the annulus plane.

    Height is the largest depth on the middle line, volume the sum over the whole annulus. Points
    where nothing is met (an open orifice) have no depth. On a closed valve this is the usual
    definition.

    Parameters
    ----------
    vertices, triangles
        Midsurface of all leaflets, ``(n, 3)`` mm and ``(m, 3)``.
    annulus
        ``(k, 3)`` mm in loop order.
    plane
        Of that annulus.
    resolution
        Pixel size, mm.
    """
    image = project_leaflets(vertices, triangles, annulus, plane, resolution)
    seen = image.inside & np.isfinite(image.depth)
    depth = np.where(seen, image.depth, 0.0)
    middle = int(np.argmin(np.abs(image.lateral)))
    return {
        "tenting_height_mm": float(depth[:, middle].max()),
        "tenting_volume_mm3": float(depth.sum() * resolution**2),
    }


def _prolapse(
    vertices: FloatArray, triangles: IntArray, annulus: FloatArray, plane: AnnulusPlane
) -> Numbers:
    """What of the first leaflet surface seen from the atrium lies above the annulus.

    An annulus is a saddle, and the leaflets near its two high points lie above its plane in every
    valve (Levine et al. 1987, Circulation 75:756); above the surface that spans it only a leaflet
    that bulges into the atrium does.
    """
    spanning, step = spanning_surface(annulus, plane), 0.2
    image = project_leaflets(vertices, triangles, annulus, plane, step)
    film = project_leaflets(spanning.vertices, spanning.triangles, annulus, plane, step)
    seen = image.inside & np.isfinite(image.depth)
    over_plane = np.where(seen, np.maximum(-image.depth, 0.0), 0.0)
    both = seen & np.isfinite(film.depth)
    over_film = np.zeros_like(over_plane)
    over_film[both] = np.maximum(film.depth[both] - image.depth[both], 0.0)
    return {
        "annulus_area_3d_mm2": spanning.area,
        "prolapse_height_mm": float(over_plane.max()),
        "prolapse_volume_mm3": float(over_plane.sum() * step**2),
        "billow_height_mm": float(over_film.max()),
        "billow_volume_mm3": float(over_film.sum() * step**2),
    }


def closure(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    pair: Sequence[IntArray],
    reach: float,
) -> Numbers:
    """Orifice and coaptation of two leaflets.

    Parameters
    ----------
    vertices, triangles, annulus, plane
        As in `tenting`.
    pair : two (m, 3) arrays
        Triangles of the anterior and of the posterior leaflet.
    reach : float
        mm between midsurfaces that count as touching.
    """
    first, second = pair
    return {
        "orifice_mm2": orifice_area(vertices, triangles, annulus, plane),
        "coaptation_length_mm": coaptation_length(vertices, first, second, plane, reach),
        "coaptation_area_mm2": coaptation_area(vertices, first, second, reach),
    }


def leaflet_length(vertices: FloatArray, triangles: IntArray, plane: AnnulusPlane) -> float:
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


def _tips(
    tips: FloatArray, annulus: FloatArray, plane: AnnulusPlane, names: Sequence[str]
) -> Numbers:
    depth = plane.coordinates(tips)[:, 2]
    away = np.linalg.norm(closest_on_loop(tips, checked_loop(annulus))[2], axis=1)
    numbers: Numbers = {
        "tip_depth_mm": float(depth.mean()),
        "tip_annulus_distance_mm": float(away.mean()),
    }
    if len(tips) == 2:
        numbers["tip_separation_mm"] = float(np.linalg.norm(tips[0] - tips[1]))
    for k, name in enumerate(names):
        numbers[f"{name}_depth_mm"] = float(depth[k])
        numbers[f"{name}_annulus_distance_mm"] = float(away[k])
    return numbers
