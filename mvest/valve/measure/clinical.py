"""The numbers that users of valve software expect of a frame, in one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from mvest.errors import MvestError
from mvest.typing import FloatArray, IntArray
from mvest.valve.measure.annulus import (
    AnnulusPlane,
    annulus_plane,
    measure_annulus,
    spanning_surface,
)
from mvest.valve.measure.coaptation import coaptation_area, coaptation_length, orifice_area
from mvest.valve.measure.measurements import (
    leaflet_length,
    measure_papillary_tips,
    measure_prolapse,
    measure_tenting,
    surface_area,
)
from mvest.valve.measure.passing_ball import largest_passing_ball

Numbers: TypeAlias = dict[str, float | None]

UNITS = {"mm": "mm", "mm2": "mm²", "mm3": "mm³", "ratio": ""}
"""By the last part of a measurement's name."""

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
    "passing_ball_mm": "diameter of the largest ball that passes between the leaflets",
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
    """What is asked of leaflets besides their shape, as `LeafletSurface` has it."""

    @property
    def triangles(self) -> IntArray:
        """``(m, 3)``, normals to the ventricle."""

    @property
    def region(self) -> IntArray:
        """``(m,)`` leaflet of each triangle."""

    @property
    def region_names(self) -> tuple[str, ...]:
        """Of the leaflets, the anterior one first."""

    @property
    def thickness(self) -> FloatArray:
        """``(n,)`` mm."""


def clinical_meaning(name: str) -> tuple[str, str]:
    """Unit (empty for ratios) and meaning of a measurement that `clinical_measurements` names."""
    unit = UNITS[name.rpartition("_")[2]]
    if name in _MEANING:
        return unit, _MEANING[name]
    # The longest ending first: `tip_0_annulus_distance_mm`.
    for ending in sorted(_MEANING_OF_PART, key=len, reverse=True):
        if name.endswith(f"_{ending}"):
            part = name.removesuffix(f"_{ending}").replace("_", " ")
            return unit, _MEANING_OF_PART[ending].format(part)
    raise KeyError(name)


def clinical_names(
    region_names: Sequence[str], tip_names: Sequence[str] = (), passing_ball: bool = True
) -> list[str]:
    """Every name that `clinical_measurements` can give two leaflets and two tips, in order."""
    named = [name for name in _MEANING if passing_ball or name != "passing_ball_mm"]
    leaflet, tip = list(_MEANING_OF_PART)[:2], list(_MEANING_OF_PART)[2:]
    named += [f"{name}_{ending}" for name in region_names for ending in leaflet]
    return named + [f"{name}_{ending}" for name in tip_names for ending in tip]


def clinical_measurements(
    vertices: FloatArray,
    surface: MeasuredLeaflets,
    annulus: FloatArray,
    tips: FloatArray,
    contact_distance: float,
    *,
    tip_names: Sequence[str] = (),
    passing_ball: bool = True,
) -> dict[str, float | None]:
    """Measure a valve in one frame.

    Diameters, areas, height and circumference of the annulus are those of three-dimensional
    echocardiography (Grewal et al. 2010, Circulation 121:1423), its height over its width that of
    Salgo et al. 2002 (Circulation 106:711); `clinical_meaning` says what each number is.

    Parameters
    ----------
    vertices : (n, 3) mm
        Where the vertices of ``surface`` are in this frame.
    surface : LeafletSurface or the like
        Triangles, regions and thickness.
    annulus : (k, 3) mm
        In loop order.
    tips : (t, 3) mm
        Papillary tips.
    contact_distance : float
        mm between midsurfaces that count as touching.
    tip_names : sequence of str
        For each tip, if every one is to be measured besides their mean: ``tip_0``.
    passing_ball : bool
        Whether the largest ball that passes is looked for, which takes about a second.

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
    numbers |= _tried(_annulus_in_space, annulus, plane)
    numbers |= _tried(_tenting, *seen)
    numbers |= _tried(_prolapse, *seen)
    if len(pair) == 2:
        numbers |= _tried(_closure, *seen, pair, contact_distance)
        numbers |= _tried(_ball, *seen, surface.thickness) if passing_ball else {}
    for name, own in zip(surface.region_names, pair, strict=True):
        numbers[f"{name}_area_mm2"] = surface_area(vertices, own)
        if len(pair) == 2:
            numbers[f"{name}_length_mm"] = leaflet_length(vertices, own, plane)
    return numbers | _tips(tips, annulus, plane, tip_names)


def annulus_and_tips(
    vertices: FloatArray, surface: MeasuredLeaflets, annulus: FloatArray, tips: FloatArray
) -> dict[str, float | None]:
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


def _annulus_in_space(annulus: FloatArray, plane: AnnulusPlane) -> Numbers:
    return {"annulus_area_3d_mm2": spanning_surface(annulus, plane).area}


def _tenting(
    vertices: FloatArray, triangles: IntArray, annulus: FloatArray, plane: AnnulusPlane
) -> Numbers:
    tenting = measure_tenting(vertices, triangles, annulus, plane)
    return {"tenting_height_mm": tenting.height, "tenting_volume_mm3": tenting.volume}


def _prolapse(
    vertices: FloatArray, triangles: IntArray, annulus: FloatArray, plane: AnnulusPlane
) -> Numbers:
    film = spanning_surface(annulus, plane)
    above = measure_prolapse(vertices, triangles, annulus, plane, film)
    return {
        "prolapse_height_mm": above.height,
        "prolapse_volume_mm3": above.volume,
        "billow_height_mm": above.billow_height,
        "billow_volume_mm3": above.billow_volume,
    }


def _closure(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    pair: Sequence[IntArray],
    reach: float,
) -> Numbers:
    first, second = pair
    return {
        "orifice_mm2": orifice_area(vertices, triangles, annulus, plane),
        "coaptation_length_mm": coaptation_length(vertices, first, second, plane, reach).length,
        "coaptation_area_mm2": coaptation_area(vertices, first, second, reach),
    }


def _ball(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    thickness: FloatArray,
) -> Numbers:
    ball = largest_passing_ball(vertices, triangles, annulus, plane, thickness=thickness)
    return {"passing_ball_mm": ball.diameter}


def _tips(
    tips: FloatArray, annulus: FloatArray, plane: AnnulusPlane, names: Sequence[str]
) -> Numbers:
    place = measure_papillary_tips(tips, annulus, plane)
    numbers: Numbers = {
        "tip_depth_mm": float(place.depth.mean()),
        "tip_annulus_distance_mm": float(place.annulus_distance.mean()),
    }
    if len(tips) == 2:
        numbers["tip_separation_mm"] = float(place.separation[0, 1])
    for k, name in enumerate(names):
        numbers[f"{name}_depth_mm"] = float(place.depth[k])
        numbers[f"{name}_annulus_distance_mm"] = float(place.annulus_distance[k])
    return numbers
