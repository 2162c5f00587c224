"""Measures of a closing valve, step by step, and of a closed valve."""

import numpy as np

from mvest.closure.model import ClosureModel, ClosureResult
from mvest.closure.physiology import chord_loads
from mvest.closure.stress import peak_stress
from mvest.mechanics.system import System
from mvest.mechanics.valve_system import boundary_loading
from mvest.scenarios.scenario import plane_of
from mvest.typing import FloatArray, IntArray
from mvest.units import mpa_to_mmhg
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.proximity import intersecting_triangles
from mvest.valve.geometry.thickening import thicken
from mvest.valve.measure.annulus import measure_annulus
from mvest.valve.measure.clinical import tenting
from mvest.valve.measure.coaptation import (
    coaptation_area,
    coaptation_length,
    find_gap,
    orifice_area,
)
from mvest.valve.mesh.solid_mesh import embed, jacobian_determinants


def _leaflets(surface: LeafletSurface) -> list[IntArray]:
    """Triangles ``(m, 3)`` of each leaflet."""
    return [surface.triangles[surface.region == k] for k in range(len(surface.region_names))]


def measure_steps(
    model: ClosureModel,
    result: ClosureResult,
    contact_distance: float,
    normals: FloatArray | None = None,
) -> list[dict[str, float]]:
    """Measure every stored step of a closure.

    Returns for each step: ``time`` (s); ``pressure`` (mmHg); ``orifice`` (mm²),
    the opening between the thick leaflets along the best annulus normal; ``coaptation`` (mm), the
    height at mid-valve over which two leaflets are within the contact distance (NaN for more);
    ``intersections``, pairs of intersecting triangles of the leaflets' faces; the largest ``chord
    strain`` and ``chord force`` (N); ``smallest det F`` at the quadrature points; ``Newton
    iterations``.

    Parameters
    ----------
    model : ClosureModel
    result : ClosureResult
        Of ``model.close``.
    contact_distance : float
        mm between midsurfaces up to which leaflets count as coapting.
    normals : ndarray, optional
        ``(n, 3)`` directions of the thickness at the observed vertices.
    """
    valve, system, simulation = model.valve, result.system, result.simulation
    surface, mesh = valve.surface, model.mesh
    closed_surface = thicken(surface, normals)
    faces = embed(mesh, closed_surface.vertices)
    loading = boundary_loading(system, valve, model.contact_valve, model.settings)
    leaflets = _leaflets(surface)
    measures = []
    for time, x in zip(simulation.times, simulation.frames, strict=True):
        middle, outer, loads = model.observed(x), faces(x), loading(time)
        annulus = middle[valve.annulus]
        plane = plane_of(valve, annulus)
        chords = chord_loads(system, x, loads)
        now, rest = (
            jacobian_determinants(y, mesh.elements, mesh.reference, mesh.reference.points)
            for y in (x, mesh.nodes)
        )
        iterations = sum(len(r.residuals) - 1 for r in simulation.records if r.time <= time + 1e-12)
        length = np.nan
        if len(leaflets) == 2:
            one, other = leaflets
            length = coaptation_length(middle, one, other, plane, contact_distance)
        measures.append(
            {
                "time": float(time),
                "pressure": float(mpa_to_mmhg(loads.pressure)),
                "orifice": orifice_area(outer, closed_surface.triangles, annulus, plane),
                "coaptation": length,
                "intersections": len(intersecting_triangles(outer, closed_surface.triangles)),
                "chord strain": float(chords.strain.max(initial=0.0)),
                "chord force": float(chords.force.max(initial=0.0)),
                "smallest det F": float((now / rest).min()),
                "Newton iterations": iterations,
            }
        )
    return measures


def contact_pressure(system: System, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Contact samples ``(k, 3)`` (mm, at rest), and the pressure ``(k,)`` (MPa) there.

    The pressure is the force on a sample over its area; empty without contact.
    """
    contact = system.contact
    if contact is None:
        return np.zeros((0, 3)), np.zeros(0)
    y = contact.points(x)
    force = np.linalg.norm(contact.forces(contact.search(y), y), axis=1)
    return contact.sheet.rest, force / contact.sheet.areas


Measured = dict[str, float]
"""Name (including the unit) -> number.

* ``gap_mm2``: regurgitant gap, the area within the annulus where lines of sight along its normal
  stay farther than half the contact reach from every leaflet's midsurface;
* ``coaptation_area_mm2``: area over which the leaflets touch (midsurfaces within the contact
  reach), half the sum over all leaflets;
* of two leaflets also ``coaptation_length_mm``: length over which they touch in the middle
  anteroposterior section, the smaller of their values; and ``coaptation_height_mm``: the area over
  the commissural diameter, the mean height of the touching zone across the valve;
* ``tenting_height_mm``: largest depth of the leaflets below the annulus plane in the middle
  anteroposterior section;
* ``tenting_volume_mm3``: volume between annulus plane and leaflets;
* ``ap_diameter_mm``: anteroposterior diameter of the annulus;
* ``annulus_circumference_mm``: length of the annulus in space;
* ``stress_p95_LEAFLET_mpa``: 95th percentile, by volume, of the leaflet's first principal Cauchy
  stress; also ``stress_p99_`` and ``stress_max_``, which depends on the mesh.
"""

NEVER_NEGATIVE = ("gap_", "coaptation_", "ap_diameter_", "annulus_", "stress_")
"""Name prefixes of measures that are never negative: areas, lengths, and the highest tension of a
leaflet under pressure."""


def measure_closed(model: ClosureModel, system: System, x: FloatArray) -> Measured:
    """Measure one closed valve.

    ``system`` is the model's, at the parameters for which ``x (n, 3)`` mm is in equilibrium.
    """
    valve, surface = model.valve, model.valve.surface
    vertices = model.observed(x)
    annulus = vertices[valve.annulus]
    plane, reach = plane_of(valve, annulus), model.contact_reach_mm
    leaflets, size = _leaflets(surface), measure_annulus(annulus, plane)
    area = coaptation_area(vertices, leaflets, reach)
    measures = {
        "gap_mm2": find_gap(vertices, np.concatenate(leaflets), annulus, plane, reach).area,
        "coaptation_area_mm2": area,
    }
    if len(leaflets) == 2:
        one, other = leaflets
        measures["coaptation_length_mm"] = coaptation_length(vertices, one, other, plane, reach)
        measures["coaptation_height_mm"] = area / size.commissural_diameter
    measures |= tenting(vertices, surface.triangles, annulus, plane)
    measures["ap_diameter_mm"] = size.anteroposterior_diameter
    measures["annulus_circumference_mm"] = size.circumference
    return measures | peak_stress(system, x)
