"""Measures of a predicted closed valve: gap, coaptation, tenting, annulus and peak stress."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.system import System
from mvest.scenarios.scenario import plane_of
from mvest.scenarios.stress import peak_stress
from mvest.typing import FloatArray, IntArray
from mvest.valve.measure.annulus import AnnulusPlane, measure_annulus
from mvest.valve.measure.coaptation import coaptation_area, coaptation_length, find_gap
from mvest.valve.measure.measurements import measure_tenting

Measured = dict[str, float]
"""Name with its unit -> number."""

MEASURES = {
    "gap_mm2": "regurgitant gap: area within the annulus, seen along its normal, of the lines of "
    "sight that stay farther than half the contact reach from every leaflet's midsurface",
    "coaptation_length_mm": "length over which the leaflets touch (midsurfaces within the contact "
    "reach) in the middle anteroposterior section, the smaller of both",
    "coaptation_area_mm2": "area over which the leaflets touch, mean of both",
    "coaptation_height_mm": "coaptation area over the commissural diameter: the mean height of "
    "the touching zone across the valve",
    "tenting_height_mm": "largest depth of the leaflets below the annulus plane in the middle "
    "anteroposterior section",
    "tenting_volume_mm3": "volume between annulus plane and leaflets",
    "ap_diameter_mm": "anteroposterior diameter of the annulus",
    "annulus_circumference_mm": "length of the annulus in space",
    "stress_p95_{}_mpa": "first principal Cauchy stress that 95 % of the {} leaflet's volume stays "
    "below",
    "stress_p99_{}_mpa": "the same for 99 %",
    "stress_max_{}_mpa": "largest first principal Cauchy stress of the {} leaflet, which depends "
    "on the mesh",
}
"""Meaning by name; {} stands for a leaflet."""

NEVER_NEGATIVE = ("gap_", "coaptation_", "ap_diameter_", "annulus_", "stress_")
"""Beginnings of names of measures that have no negative values: areas, lengths, and the highest
tension of a leaflet that is under pressure."""


def meaning_of(name: str) -> str:
    """What a measure is."""
    if name in MEASURES:
        return MEASURES[name]
    _, which, region, _ = name.split("_", 3)
    return MEASURES[f"stress_{which}_{{}}_mpa"].format(region)


@dataclass(frozen=True, slots=True, eq=False)
class _Shape:
    vertices: FloatArray
    triangles: tuple[IntArray, IntArray]
    annulus: FloatArray
    plane: AnnulusPlane


def measure_closed(
    model: ClosureModel,
    system: System,
    x: FloatArray,
    changes: Mapping[Parameter, float] | None = None,
) -> Measured:
    """Measure one closed valve of two leaflets.

    Parameters
    ----------
    model : ClosureModel
        Whose valve it is.
    system : System
        The model's, set to the parameters at which ``x`` is in equilibrium.
    x : ndarray
        ``(n, 3)`` mm nodal positions.
    changes : mapping, optional
        Parameter -> by how much it differs from the system's in ``x``; the law is changed with it
        to first order.
    """
    valve, surface = model.valve, model.valve.surface
    vertices = model.observed(x)
    annulus = vertices[valve.annulus]
    pair = surface.triangles[surface.region == 0], surface.triangles[surface.region == 1]
    shape = _Shape(vertices, pair, annulus, plane_of(valve, annulus))
    measures = _closure(shape, model.contact_reach_mm)
    tenting = measure_tenting(vertices, surface.triangles, annulus, shape.plane)
    measures |= {"tenting_height_mm": tenting.height, "tenting_volume_mm3": tenting.volume}
    size = measure_annulus(annulus, shape.plane)
    measures["coaptation_height_mm"] = measures["coaptation_area_mm2"] / size.commissural_diameter
    measures["ap_diameter_mm"] = size.anteroposterior_diameter
    measures["annulus_circumference_mm"] = size.circumference
    for region, peak in peak_stress(system, x, dict(changes or {})).items():
        measures[f"stress_p95_{region}_mpa"] = peak.p95
        measures[f"stress_p99_{region}_mpa"] = peak.p99
        measures[f"stress_max_{region}_mpa"] = peak.largest
    return measures


def _closure(shape: _Shape, reach: float) -> Measured:
    both = np.concatenate(shape.triangles)
    length = coaptation_length(shape.vertices, *shape.triangles, shape.plane, reach).length
    return {
        "gap_mm2": find_gap(shape.vertices, both, shape.annulus, shape.plane, reach).area,
        "coaptation_length_mm": length,
        "coaptation_area_mm2": coaptation_area(shape.vertices, *shape.triangles, reach),
    }
