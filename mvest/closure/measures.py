"""What a closing valve does, step by step: opening, leaks, coaptation, chordae, element quality."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.closure.model import ClosureModel, ClosureResult
from mvest.mechanics.system import System
from mvest.mechanics.valve_system import boundary_loading
from mvest.typing import FloatArray
from mvest.units import mpa_to_mmhg
from mvest.valve.geometry.proximity import intersecting_triangles
from mvest.valve.geometry.thickening import thicken
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.coaptation import coaptation_length, orifice_area
from mvest.valve.measure.passing_ball import largest_passing_ball
from mvest.valve.mesh.solid_mesh import embed, jacobian_determinants


@dataclass(frozen=True, slots=True)
class StepMeasures:
    """State of the valve after one step.

    Attributes
    ----------
    time : float
        s.
    pressure_mmhg : float
    orifice_mm2 : float
        Opening seen along the best annulus normal, between the thick leaflets.
    passing_ball_mm : float
        Diameter of the largest ball that passes between the thick leaflets.
    coaptation_mm : float
        Height in the middle of the valve over which the midsurfaces of opposing leaflets are within
        the contact distance.
    intersections : int
        Pairs of intersecting triangles of the leaflets' faces (both sides and rims).
    chord_strain : float
        Largest strain of a chord.
    chord_force_n : float
        Largest force of a chord, N.
    smallest_jacobian : float
        Smallest determinant of the deformation gradient at the quadrature points.
    newton_iterations : int
    """

    time: float
    pressure_mmhg: float
    orifice_mm2: float
    passing_ball_mm: float
    coaptation_mm: float
    intersections: int
    chord_strain: float
    chord_force_n: float
    smallest_jacobian: float
    newton_iterations: int


def measure_steps(
    model: ClosureModel,
    result: ClosureResult,
    contact_distance: float,
    normals: FloatArray | None = None,
) -> tuple[StepMeasures, ...]:
    """Measure every stored step of a closure.

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
    surface = valve.surface
    closed_surface = thicken(surface, normals)
    faces = embed(model.mesh, closed_surface.vertices)
    loading = boundary_loading(system, valve, model.contact_valve, model.settings)
    first = np.unique(surface.triangles[surface.region == 0])
    one, other = (surface.triangles[surface.region == k] for k in (0, 1))
    measures = []
    for time, x in zip(simulation.times, simulation.frames, strict=True):
        middle, outer = model.observed(x), faces(x)
        annulus = middle[valve.annulus]
        anterior = middle[np.intersect1d(valve.annulus, first)].mean(axis=0)
        plane = annulus_plane(annulus, valve.papillary_tips.mean(axis=0), anterior)
        loads = loading(time)
        strain, force = _chordae(system, x, loads.tips)
        iterations = sum(len(r.residuals) - 1 for r in simulation.records if r.time <= time + 1e-12)
        measures.append(
            StepMeasures(
                float(time),
                float(mpa_to_mmhg(loads.pressure)),
                orifice_area(outer, closed_surface.triangles, annulus, plane),
                largest_passing_ball(outer, closed_surface.triangles, annulus, plane).diameter,
                coaptation_length(middle, one, other, plane, contact_distance).length,
                len(intersecting_triangles(outer, closed_surface.triangles)),
                strain,
                force,
                _smallest_jacobian(model, x),
                iterations,
            )
        )
    return tuple(measures)


def _chordae(system: System, x: FloatArray, tips: FloatArray) -> tuple[float, float]:
    cables = system.cables
    if cables is None:
        return 0.0, 0.0
    factors = system.factors
    strain = cables.strain(x, tips, factors.chord_rest_length)
    force = cables.forces(x, tips, factors.chord_stiffness, factors.chord_rest_length)[0]
    return float(strain.max()), float(np.linalg.norm(force, axis=1).max())


def _smallest_jacobian(model: ClosureModel, x: FloatArray) -> float:
    mesh = model.mesh
    points = mesh.reference.points
    now = jacobian_determinants(x, mesh.elements, mesh.reference, points)
    rest = jacobian_determinants(mesh.nodes, mesh.elements, mesh.reference, points)
    return float((now / rest).min())
