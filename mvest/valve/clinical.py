"""The numbers that users of valve software expect of a frame, in one table."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mvest.errors import MvestError
from mvest.typing import FloatArray
from mvest.valve.anatomy import LeafletSurface
from mvest.valve.annulus import AnnulusPlane, annulus_plane, measure_annulus
from mvest.valve.measurements import (
    leaflet_length,
    measure_closure,
    measure_papillary_tips,
    measure_tenting,
    surface_area,
)

__all__ = ["clinical_measurements"]


def clinical_measurements(
    vertices: FloatArray,
    surface: LeafletSurface,
    annulus: FloatArray,
    tips: FloatArray,
    contact_distance: float,
) -> dict[str, float | None]:
    """Measure a valve in one frame.

    Parameters
    ----------
    vertices : (n, 3) mm
        Where the vertices of ``surface`` are in this frame.
    surface : LeafletSurface
        Triangles, regions and thickness.
    annulus : (k, 3) mm
        In loop order.
    tips : (t, 3) mm
        Papillary tips.
    contact_distance : float
        mm between midsurfaces that count as touching.

    Returns
    -------
    dict
        Name with unit -> number; what the shape defies is not in it, and nothing is where the
        annulus has no plane. The first region is the anterior one.
    """
    # The middle of a leaflet's own annulus is nearest to that leaflet.
    first = np.unique(surface.triangles[surface.region == 0])
    gap = np.linalg.norm(annulus[:, None] - vertices[first][None], axis=2).min(axis=1)
    near = annulus[gap <= np.quantile(gap, 0.25)]
    try:
        plane = annulus_plane(annulus, tips.mean(axis=0), near.mean(axis=0))
    except MvestError:
        return {}
    found: dict[str, float | None] = {}
    size = measure_annulus(annulus, plane)
    found["ap_diameter_mm"] = size.anteroposterior_diameter
    found["commissural_diameter_mm"] = size.commissural_diameter
    found["annulus_height_mm"] = size.height
    found["annulus_circumference_mm"] = size.circumference
    found["annulus_area_mm2"] = size.projected_area
    _add(found, _tenting, vertices, surface, annulus, plane)
    if len(surface.region_names) == 2:
        _add(found, _closure(contact_distance), vertices, surface, annulus, plane)
    for number, name in enumerate(surface.region_names):
        triangles = surface.triangles[surface.region == number]
        found[f"{name}_area_mm2"] = surface_area(vertices, triangles)
        if len(surface.region_names) == 2:
            found[f"{name}_length_mm"] = leaflet_length(vertices, triangles, plane)
    found["tip_depth_mm"] = float(measure_papillary_tips(tips, annulus, plane).depth.mean())
    return found


Measure = Callable[[FloatArray, LeafletSurface, FloatArray, AnnulusPlane], dict[str, float | None]]


def _add(
    found: dict[str, float | None],
    measure: Measure,
    vertices: FloatArray,
    surface: LeafletSurface,
    annulus: FloatArray,
    plane: AnnulusPlane,
) -> None:
    """Add measurements, or nothing where the shape defies them."""
    try:
        found |= measure(vertices, surface, annulus, plane)
    except MvestError:
        return


def _tenting(
    vertices: FloatArray, surface: LeafletSurface, annulus: FloatArray, plane: AnnulusPlane
) -> dict[str, float | None]:
    tenting = measure_tenting(vertices, surface.triangles, annulus, plane)
    return {"tenting_height_mm": tenting.height, "tenting_volume_mm3": tenting.volume}


def _closure(contact_distance: float) -> Measure:
    def measure(
        vertices: FloatArray, surface: LeafletSurface, annulus: FloatArray, plane: AnnulusPlane
    ) -> dict[str, float | None]:
        closed = measure_closure(
            vertices,
            surface.triangles,
            surface.region,
            surface.thickness,
            annulus,
            plane,
            contact_distance,
        )
        return {
            "orifice_mm2": closed.orifice_area,
            "passing_ball_mm": closed.passing_ball_diameter,
            "coaptation_length_mm": closed.coaptation_length,
            "coaptation_area_mm2": closed.coaptation_area,
        }

    return measure
