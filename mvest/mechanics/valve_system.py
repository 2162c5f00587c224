"""A valve hung into a solid mesh, with everything that acts on it.

All of it is defined in the reference frame and embedded, so that the same valve gives the same
loads, contact and observations in every mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.cables import Cables, Hinge
from mvest.mechanics.contact import Contact
from mvest.mechanics.law import BiotLaw
from mvest.mechanics.pressure import PressureLoad
from mvest.mechanics.settings import MechanicsSettings
from mvest.mechanics.solid import Solid
from mvest.mechanics.system import Factors, Loads, System
from mvest.mechanics.ties import TiedPoints
from mvest.typing import FloatArray
from mvest.units import mmhg_to_mpa
from mvest.valve.anatomy import Valve
from mvest.valve.embedding import Embedding, embed
from mvest.valve.mesh import SolidMesh

__all__ = ["HeldState", "boundary_loading", "build_system", "held_loading", "material_law"]


@dataclass(frozen=True, slots=True, eq=False)
class HeldState:
    """Conditions under which a closed valve is held in a further frame.

    Attributes
    ----------
    pressure_mmHg : float
    annulus : (k, 3) mm
        Where the annulus vertices of the *contact valve* are.
    papillary_tips : (t, 3) mm
    """

    pressure_mmHg: float
    annulus: FloatArray
    papillary_tips: FloatArray


def build_system(
    valve: Valve,
    contact_valve: Valve,
    mesh: SolidMesh,
    settings: MechanicsSettings,
    moduli: dict[str, float],
    factors: Factors | None = None,
    ties: TiedPoints | None = None,
) -> System:
    """A system of the valve in the given mesh.

    Parameters
    ----------
    valve : Valve
        Carries chordae, annulus and motion.
    contact_valve : Valve
        The same valve in the resolution at which contact is sampled.
    mesh : SolidMesh
    settings : MechanicsSettings
    moduli : dict
        Region -> E_f, MPa.
    factors : Factors, optional
    ties : TiedPoints, optional
        Pairs of points that are held together, as by a clip.
    """
    solid = Solid(mesh, material_law(mesh, settings, moduli), density=settings.density)
    surface = contact_valve.surface
    midpoints = embed(mesh, surface.vertices)
    chordae = valve.chordae
    cables = Cables(
        _patches(midpoints, contact_valve, settings.patch_radius, chordae.insertion),
        chordae.tip,
        chordae.rest_length,
        chordae.axial_stiffness,
        chordae.toe_strain,
    )
    contact = Contact(
        midpoints,
        midpoints(mesh.nodes),
        surface.areas,
        surface.thickness,
        surface.triangles,
        settings.contact,
    )
    return System(
        solid,
        pressure=PressureLoad(mesh.pressure_faces, mesh.reference.face),
        cables=cables,
        contact=contact,
        hinge=_support(mesh, contact_valve, settings),
        factors=factors,
        ties=None if ties is None else ties.within(mesh),
    )


def material_law(mesh: SolidMesh, settings: MechanicsSettings, moduli: dict[str, float]) -> BiotLaw:
    """The law of the mesh with one modulus E_f (MPa) per region.

    Raises
    ------
    InputError
        If a region has no tissue or no modulus.
    MaterialError
        If a modulus is inadmissible.
    """
    materials = []
    for region in mesh.region_names:
        if region not in settings.tissue or region not in moduli:
            raise InputError(
                f"region {region!r} of the mesh has no tissue or modulus; given are "
                f"{', '.join(sorted(settings.tissue))} and {', '.join(sorted(moduli))}"
            )
        materials.append(settings.tissue[region].material(moduli[region]))
    return BiotLaw.of(tuple(materials))


def _patches(points: Embedding, valve: Valve, radius: float, insertion: FloatArray) -> Embedding:
    """Leaflet ends of the chordae: averages over material points within ``radius`` mm.

    Weights ``area (1 - (d / radius)^2)^2``, of fixed physical size whatever the mesh.
    """
    vertices, areas = valve.surface.vertices, valve.surface.areas
    members, factors = [], []
    for centre in insertion:
        d = np.linalg.norm(vertices - centre, axis=1)
        reach = max(radius, 1.05 * float(d.min()))
        inside = np.flatnonzero(d < reach)
        weight = areas[inside] * (1 - (d[inside] / reach) ** 2) ** 2
        members.append(inside)
        factors.append(weight / weight.sum())
    width = max((len(m) for m in members), default=1)
    groups = np.zeros((len(members), width), dtype=np.int64)
    coefficients = np.zeros((len(members), width))
    for k, (m, f) in enumerate(zip(members, factors, strict=True)):
        groups[k, : len(m)] = m
        coefficients[k, : len(m)] = f
    return points.average(coefficients, groups)


def _support(mesh: SolidMesh, valve: Valve, settings: MechanicsSettings) -> Hinge:
    """Hinge or clamp along the annulus, with a fixed stiffness per length."""
    surface, loop = valve.surface, valve.annulus
    middle = surface.vertices[loop]
    half = 0.5 * surface.thickness[loop, None] * surface.normals[loop]
    ahead = np.linalg.norm(np.roll(middle, -1, axis=0) - middle, axis=1)
    share = 0.5 * (ahead + np.roll(ahead, 1)) * settings.support_stiffness
    n = len(loop)
    three = embed(mesh, np.concatenate([middle - half, middle, middle + half]))
    if settings.support == "hinge":
        groups = np.stack([np.arange(n), np.arange(n) + n, np.arange(n) + 2 * n], axis=1)
        simpson = np.tile([1 / 6, 4 / 6, 1 / 6], (n, 1))
        return Hinge(three.average(simpson, groups), share)
    if settings.support == "clamp":
        faces = np.concatenate([np.arange(n), np.arange(n) + 2 * n])
        points = Embedding(three.nodes[faces], three.weights[faces], three.host[faces])
        return Hinge(points, np.tile(0.5 * share, 2))
    raise InputError(f"annulus support {settings.support!r}, expected hinge or clamp")


def boundary_loading(
    system: System, valve: Valve, contact_valve: Valve, settings: MechanicsSettings
) -> Callable[[float], Loads]:
    """Time -> loads: pressure, annulus and papillary tips of the protocol."""
    protocol = settings.protocol
    assert system.hinge is not None
    start = system.hinge.points(system.solid.mesh.nodes)
    motion = contact_valve.motion
    shift = motion.annulus - motion.annulus[0]
    copies = len(start) // shift.shape[1]
    shift = np.tile(shift, (1, copies, 1))
    peak = mmhg_to_mpa(protocol.pressure_mmHg)

    def loading(t: float) -> Loads:
        phase = protocol.phase(t)
        return Loads(
            pressure=peak * phase,
            tips=_interpolate(motion.phase, motion.papillary_tips, phase),
            hinge=start + _interpolate(motion.phase, shift, phase),
            tie_lengths=_tie_lengths(system, phase),
        )

    return loading


def held_loading(
    system: System, contact_valve: Valve, state: HeldState
) -> Callable[[float], Loads]:
    """Time -> the loads of a held frame, which do not change.

    Raises
    ------
    InputError
        If the frame's annulus or tips are not those of the valve.
    """
    assert system.hinge is not None
    rest = contact_valve.motion.annulus[0]
    for name, given, own in (
        ("annulus", state.annulus, rest),
        ("papillary_tips", state.papillary_tips, contact_valve.papillary_tips),
    ):
        if given.shape != own.shape:
            raise InputError(f"held {name}: shape {given.shape}, expected {own.shape}")
    start = system.hinge.points(system.solid.mesh.nodes)
    shift = np.tile(state.annulus - rest, (len(start) // len(rest), 1))
    loads = Loads(
        pressure=mmhg_to_mpa(state.pressure_mmHg),
        tips=state.papillary_tips,
        hinge=start + shift,
        tie_lengths=_tie_lengths(system, 1.0),
    )
    return lambda t: loads


def _tie_lengths(system: System, phase: float) -> FloatArray | None:
    """Lengths ``(k,)`` mm of the ties: from those at rest, without force, to that when closed."""
    if system.ties is None:
        return None
    rest = system.ties.lengths(system.solid.mesh.nodes)
    return (1 - phase) * rest + phase * system.ties.closed_length


def _interpolate(phases: FloatArray, frames: FloatArray, phase: float) -> FloatArray:
    """Piecewise monotone cubic between key frames (linear for two)."""
    if len(phases) == 2:
        return (1 - phase) * frames[0] + phase * frames[1]
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(phases, frames, axis=0)(phase))
