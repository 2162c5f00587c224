r"""Measures of a closing valve, step by step, and of a closed one.

Steps: opening, leaks, coaptation, chordae, element quality. Closed: gap, coaptation, tenting,
annulus and peak stress.

With the right stretch :math:`U = \sqrt{I + 2E}` and the second Piola-Kirchhoff stress :math:`S` the
Cauchy stress is :math:`\sigma = F S F^T / \det F = R \, (U S U / \det U) \, R^T` (Holzapfel 2000,
Nonlinear Solid Mechanics, equation 3.65, with :math:`F = R U`), so that its principal values are
those of :math:`U S U / \det U`. Taken from the Green-Lagrange strain rather than from F, they
include the enhanced strain of solid-shells, which no displacement has.
"""

from __future__ import annotations

import numpy as np

from mvest.closure.model import ClosureModel, ClosureResult
from mvest.errors import InputError
from mvest.mechanics.system import System
from mvest.mechanics.valve_system import boundary_loading
from mvest.scenarios.scenario import plane_of
from mvest.typing import FloatArray
from mvest.units import mpa_to_mmhg
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


def measure_steps(
    model: ClosureModel,
    result: ClosureResult,
    contact_distance: float,
    normals: FloatArray | None = None,
) -> list[dict[str, float]]:
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

    Returns
    -------
    list of dict
        Of each step ``time`` (s); ``pressure`` (mmHg); ``orifice`` (mm²), the opening seen along
        the best annulus normal between the thick leaflets; ``coaptation`` (mm), the height in the
        middle of the valve over which the midsurfaces of opposing leaflets are within the contact
        distance;
        ``intersections``, pairs of intersecting triangles of the leaflets' faces (both sides and
        rims); the largest ``chord strain`` and ``chord force`` (N); ``smallest det F``, the
        determinant of the deformation gradient at the quadrature points; ``Newton iterations``.
    """
    valve, system, simulation = model.valve, result.system, result.simulation
    surface = valve.surface
    closed_surface = thicken(surface, normals)
    faces = embed(model.mesh, closed_surface.vertices)
    loading = boundary_loading(system, valve, model.contact_valve, model.settings)
    one, other = (surface.triangles[surface.region == k] for k in (0, 1))
    measures = []
    for time, x in zip(simulation.times, simulation.frames, strict=True):
        middle, outer = model.observed(x), faces(x)
        annulus = middle[valve.annulus]
        plane = plane_of(valve, annulus)
        loads = loading(time)
        strain, force = _chordae(system, x, loads.tips)
        iterations = sum(len(r.residuals) - 1 for r in simulation.records if r.time <= time + 1e-12)
        length = coaptation_length(middle, one, other, plane, contact_distance)
        measures.append(
            {
                "time": float(time),
                "pressure": float(mpa_to_mmhg(loads.pressure)),
                "orifice": orifice_area(outer, closed_surface.triangles, annulus, plane),
                "coaptation": length,
                "intersections": len(intersecting_triangles(outer, closed_surface.triangles)),
                "chord strain": strain,
                "chord force": force,
                "smallest det F": _smallest_jacobian(model, x),
                "Newton iterations": iterations,
            }
        )
    return measures


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


_PLACE = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
"""Of tensor components in a six-vector 11, 22, 33, 23, 13, 12."""


def principal_cauchy(green: FloatArray, stress: FloatArray) -> FloatArray:
    """Largest principal Cauchy stress (MPa).

    Parameters
    ----------
    green : ndarray
        ``(..., 6)`` Green-Lagrange strain, engineering shear.
    stress : ndarray
        ``(..., 6)`` second Piola-Kirchhoff stress, MPa.
    """
    strain = green[..., _PLACE] * np.where(np.eye(3, dtype=bool), 1.0, 0.5)
    squared, axes = np.linalg.eigh(np.eye(3) + 2 * strain)
    stretch = np.sqrt(squared)
    u = np.einsum("...ik,...k,...jk->...ij", axes, stretch, axes)
    sigma = u @ stress[..., _PLACE] @ u / np.prod(stretch, axis=-1)[..., None, None]
    return np.asarray(np.linalg.eigvalsh(sigma)[..., -1])


def _stress(system: System, x: FloatArray) -> FloatArray:
    """First principal Cauchy stress ``(e, q)`` MPa at the points of quadrature."""
    solid = system.solid
    state = solid.evaluate(x, solid.initial_strain(), 0.0)
    return principal_cauchy(state.green, state.stress)


def peak_stress(system: System, x: FloatArray) -> Measured:
    """Peak stress of each region in equilibrium, as `Measured` names it; volumes are at rest.

    The largest belongs to the insertion of a chord or to the hinge, where the stress grows as the
    mesh is refined; the percentiles do so much less.

    Parameters
    ----------
    system : System
        Set to its parameters.
    x : ndarray
        ``(n, 3)`` mm nodal positions.

    Raises
    ------
    InputError
        If an element is turned inside out.
    """
    values, mesh = _stress(system, x), system.solid.mesh
    if not np.isfinite(values).all():
        raise InputError("the stress is not finite: an element is turned inside out")
    peaks: Measured = {}
    for number, name in enumerate(mesh.region_names):
        own = mesh.region == number
        for kind, peak in _peaks(values[own].ravel(), system.solid.volumes[own].ravel()).items():
            peaks[f"stress_{kind}_{name}_mpa"] = peak
    return peaks


def nodal_stress(system: System, x: FloatArray) -> FloatArray:
    """First principal Cauchy stress ``(n,)`` (MPa) at the nodes, means of their elements by volume.

    Parameters are those of `peak_stress`.
    """
    solid = system.solid
    weight = solid.volumes.sum(axis=1)
    mean = (_stress(system, x) * solid.volumes).sum(axis=1) / weight
    nodes, count = solid.mesh.elements, solid.mesh.elements.shape[1]
    total = np.bincount(nodes.ravel(), np.repeat(weight, count), len(x))
    stress = np.bincount(nodes.ravel(), np.repeat(mean * weight, count), len(x))
    return np.asarray(stress / np.maximum(total, np.finfo(float).tiny), dtype=np.float64)


def contact_pressure(system: System, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the midsurface is sampled for contact ``(k, 3)`` (mm, at rest), and the pressure there.

    The pressure ``(k,)`` (MPa) is the force on a point over its area; empty without contact.
    """
    contact = system.contact
    if contact is None:
        return np.zeros((0, 3)), np.zeros(0)
    y = contact.points(x)
    force = np.linalg.norm(contact.forces(contact.search(y), y), axis=1)
    return contact.sheet.rest, force / contact.sheet.areas


def _peaks(values: FloatArray, volumes: FloatArray) -> Measured:
    order = np.argsort(values)
    below = np.cumsum(volumes[order]) / volumes.sum()
    p95, p99 = (float(values[order][np.searchsorted(below, q)]) for q in (0.95, 0.99))
    return {"p95": p95, "p99": p99, "max": float(values.max())}


Measured = dict[str, float]
"""Name with its unit -> number; each leaflet has stresses of its own.

* ``gap_mm2``: regurgitant gap, the area within the annulus, seen along its normal, of the lines of
  sight that stay farther than half the contact reach from every leaflet's midsurface;
* ``coaptation_length_mm``: length over which the leaflets touch (midsurfaces within the contact
  reach) in the middle anteroposterior section, the smaller of both;
* ``coaptation_area_mm2``: area over which the leaflets touch, mean of both;
* ``coaptation_height_mm``: that area over the commissural diameter, the mean height of the touching
  zone across the valve;
* ``tenting_height_mm``: largest depth of the leaflets below the annulus plane in the middle
  anteroposterior section;
* ``tenting_volume_mm3``: volume between annulus plane and leaflets;
* ``ap_diameter_mm``: anteroposterior diameter of the annulus;
* ``annulus_circumference_mm``: length of the annulus in space;
* ``stress_p95_LEAFLET_mpa``: first principal Cauchy stress that 95 % of the leaflet's volume stays
  below; ``stress_p99_``: the same for 99 %; ``stress_max_``: the largest, which depends on the
  mesh.
"""

NEVER_NEGATIVE = ("gap_", "coaptation_", "ap_diameter_", "annulus_", "stress_")
"""Beginnings of names of measures that have no negative values: areas, lengths, and the highest
tension of a leaflet that is under pressure."""


def measure_closed(model: ClosureModel, system: System, x: FloatArray) -> Measured:
    """Measure one closed valve of two leaflets.

    Parameters
    ----------
    model : ClosureModel
        Whose valve it is.
    system : System
        The model's, set to the parameters at which ``x`` is in equilibrium.
    x : ndarray
        ``(n, 3)`` mm nodal positions.
    """
    valve, surface = model.valve, model.valve.surface
    vertices = model.observed(x)
    annulus = vertices[valve.annulus]
    plane, reach = plane_of(valve, annulus), model.contact_reach_mm
    pair = surface.triangles[surface.region == 0], surface.triangles[surface.region == 1]
    measures = {
        "gap_mm2": find_gap(vertices, np.concatenate(pair), annulus, plane, reach).area,
        "coaptation_length_mm": coaptation_length(vertices, *pair, plane, reach),
        "coaptation_area_mm2": coaptation_area(vertices, *pair, reach),
    }
    measures |= tenting(vertices, surface.triangles, annulus, plane)
    size = measure_annulus(annulus, plane)
    measures["coaptation_height_mm"] = measures["coaptation_area_mm2"] / size.commissural_diameter
    measures["ap_diameter_mm"] = size.anteroposterior_diameter
    measures["annulus_circumference_mm"] = size.circumference
    return measures | peak_stress(system, x)
