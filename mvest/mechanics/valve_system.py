"""A valve hung into a solid mesh, with everything that acts on it.

All of it is defined in the reference frame and embedded, so that the same valve gives the same
loads, contact and observations in every mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.forces.cables import Cables, Hinge, TiedPoints
from mvest.mechanics.forces.contact import Contact
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.law import Law
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw, StiffeningLaw
from mvest.mechanics.law.linear import LinearLaw
from mvest.mechanics.law.moduli import LeafletModuli
from mvest.mechanics.law.regional import FieldBasis, LeafletLaw, ModulusVariation, at_quadrature
from mvest.mechanics.parameters import NamePart, check_names, kind_of
from mvest.mechanics.settings import EXPONENTIAL_KINDS, ExponentialTissue, MechanicsSettings
from mvest.mechanics.solid import Solid
from mvest.mechanics.system import Factors, Loads, System
from mvest.typing import FloatArray, IntArray
from mvest.units import mmhg_to_mpa
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh, embed


class Pacing(Protocol):
    """How pressure and the motion of the boundary run in time."""

    def pressure(self, t: float, /) -> float:
        """Transmitral pressure (mmHg) at time ``t`` (s)."""
        ...

    def phase(self, t: float, /) -> float:
        """Share of the closure at time ``t`` (s), from 0 (open) to 1 (closed)."""
        ...


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
    values: Mapping[str, float],
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
    values : mapping
        Parameter (:data:`mvest.mechanics.parameters.KINDS`) -> value, at least the modulus of each
        region.
    ties : TiedPoints, optional
        Pairs of points that are held together, as by a clip.

    Raises
    ------
    InputError
        If a region has no tissue or no modulus, or there is no such parameter.
    MaterialError
        If a modulus is inadmissible.
    """
    check_parameters(values, valve, settings)
    chordae = valve.chordae
    law = material_law(mesh, settings, values, variation_of(valve, mesh, settings))
    solid = Solid(mesh, law, density=settings.density)
    surface = contact_valve.surface
    midpoints = embed(mesh, surface.vertices)
    members, weights, _ = patch_members(contact_valve, settings.patch_radius, chordae.insertion)
    cables = Cables(
        midpoints.average(weights, members),
        chordae.tip,
        chordae.rest_length,
        chordae.axial_stiffness,
        chordae.toe_strain,
        {name: chordae.family == k for k, name in enumerate(chordae.family_names)},
    )
    contact = None
    if settings.contact.active:
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
        factors=factors_of(cables, values),
        ties=None if ties is None else ties.within(mesh),
    )


def check_parameters(names: Iterable[str], valve: Valve, settings: MechanicsSettings) -> None:
    """Refuse names that are no parameters of this valve under these settings; InputError."""
    tips = [f"tip{k}" for k in range(len(valve.papillary_tips))]
    modes = {region: own.modes for region, own in settings.fields.items()}
    names = tuple(names)
    check_names(names, valve.surface.region_names, [*valve.chordae.family_names, *tips], modes)
    for name in names:
        kind, _, region = name.partition(".")
        tissue = settings.tissue.get(region) if kind_of(name).part is NamePart.REGION else None
        if tissue is not None and kind not in tissue.kinds:
            raise InputError(
                f"parameter {name!r}: the tissue of {region!r} follows the {tissue.law} law, which "
                f"has {', '.join(tissue.kinds)}"
            )


def material_law(
    mesh: SolidMesh,
    settings: MechanicsSettings,
    values: Mapping[str, float],
    variation: ModulusVariation | None = None,
) -> Law:
    """The law of the mesh.

    Parameters
    ----------
    mesh : SolidMesh
    settings : MechanicsSettings
    values : mapping
        Parameter -> value: ``E_f.REGION`` of each region that follows the linear law, and any of
        the others; those that are no parameters of tissue are passed over.
    variation : ModulusVariation, optional
        From `variation_of`; by default every leaflet has the same moduli throughout.

    Raises
    ------
    InputError
        If a region has no tissue or no modulus, or a value is of another region.
    MaterialError
        If a modulus is inadmissible.
    """
    tissues = [_tissue(region, settings, values) for region in mesh.region_names]
    linear = [t for t in tissues if isinstance(t, LeafletModuli)]
    exponential = [t for t in tissues if isinstance(t, ExponentialTissue)]
    corotational = {settings.tissue[r].law == "corotational" for r in mesh.region_names}
    if len(corotational) > 1:
        raise InputError("the corotational law is that of all regions of a mesh, or of none")
    laws: tuple[Law, ...]
    if corotational == {True}:
        laws = (LinearLaw.of_moduli(linear, corotational=True),)
    elif len(linear) == len(tissues):
        laws = (BiotLaw.of_moduli(linear),)
    elif len(exponential) == len(tissues):
        laws = (ExponentialLaw.of(exponential),)
    else:
        laws = tuple(map(_law_of_one, tissues))
    prestretch = _prestretch(mesh, settings, values)
    stretched = np.any(prestretch != 1.0) or any(name.startswith("prestretch.") for name in values)
    if variation is None and not stretched and len(laws) == 1:
        return laws[0]
    scale = 1.0 if variation is None else variation.scale(values)
    return LeafletLaw(laws, mesh.region, prestretch, scale, variation)


def _prestretch(
    mesh: SolidMesh, settings: MechanicsSettings, values: Mapping[str, float]
) -> FloatArray:
    """Of each region ``(r,)``; InputError if one is not positive."""
    found = np.array(
        [
            values.get(f"prestretch.{region}", settings.tissue[region].prestretch)
            for region in mesh.region_names
        ]
    )
    if not np.all(found > 0.0):
        raise InputError(f"prestretch of tissue = {found.tolist()}, expected > 0")
    return found


def _tissue(
    region: str, settings: MechanicsSettings, values: Mapping[str, float]
) -> LeafletModuli | ExponentialTissue | StiffeningLaw:
    """The law of one region, or what it is made of."""
    tissue = settings.tissue.get(region)
    if tissue is not None and tissue.law == "exponential":
        names = {kind: f"{kind}.{region}" for kind in EXPONENTIAL_KINDS}
        return tissue.coefficients({k: values[n] for k, n in names.items() if n in values})
    if tissue is None or f"E_f.{region}" not in values:
        raise InputError(
            f"region {region!r} of the mesh has no tissue or modulus; given are "
            f"{', '.join(sorted(settings.tissue))} and {', '.join(sorted(values))}"
        )
    if tissue.law == "stiffening":
        stiffening = values.get(f"stiffening.{region}", tissue.stiffening)
        return StiffeningLaw.of(tissue, values[f"E_f.{region}"], stiffening)
    return tissue.moduli(
        values[f"E_f.{region}"], values.get(f"ratio.{region}"), values.get(f"G.{region}")
    )


def _law_of_one(tissue: LeafletModuli | ExponentialTissue | StiffeningLaw) -> Law:
    """The law of a body of one region."""
    if isinstance(tissue, StiffeningLaw):
        return tissue
    if isinstance(tissue, LeafletModuli):
        return BiotLaw.of_moduli([tissue])
    return ExponentialLaw.of([tissue])


def variation_of(
    valve: Valve, mesh: SolidMesh, settings: MechanicsSettings
) -> ModulusVariation | None:
    """How the settings let the modulus vary within the leaflets, at the mesh's points."""
    if not settings.fields and not settings.patches:
        return None
    modes = {
        region: at_quadrature(mesh, region, FieldBasis.of(valve.surface, region, own))
        for region, own in settings.fields.items()
    }
    given = sum(
        (at_quadrature(mesh, patch.region, patch.log_scale) for patch in settings.patches.values()),
        np.zeros((len(mesh.elements), len(mesh.reference.points))),
    )
    return ModulusVariation(modes, given)


def retune(system: System, settings: MechanicsSettings, values: Mapping[str, float]) -> None:
    """Give a system of a valve other values of its parameters; see `build_system`."""
    assert system.cables is not None
    old = system.solid.law
    variation = old.variation if isinstance(old, LeafletLaw) else None
    law = material_law(system.solid.mesh, settings, values, variation)
    system.retune(law, factors_of(system.cables, values))


def factors_of(cables: Cables, values: Mapping[str, float]) -> Factors:
    """The factors on pressure and cables among the values; InputError if a part is unknown."""
    return Factors(
        values.get("pressure_scale", 1.0),
        cables.factor("chord_stiffness", values),
        cables.factor("chord_rest_length", values),
    )


def patch_members(
    valve: Valve, radius: float, insertion: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Leaflet ends of the chordae: averages over material points within ``radius`` mm.

    Weights ``area (1 - (d / radius)^2)^2``, of fixed physical size whatever the mesh.

    Returns
    -------
    members : (c, s)
        Vertices; padding has the weight zero.
    weights : (c, s)
        Rows sum to one.
    slope : (c, s, 3) 1/mm
        Derivatives of the weights by the place of the insertion, before rows are made to sum to
        one again; see `patch_change`.
    """
    vertices, areas = valve.surface.vertices, valve.surface.areas
    rows = []
    for centre in insertion:
        away = vertices - centre
        d = np.linalg.norm(away, axis=1)
        reach = max(radius, 1.05 * float(d.min()))
        inside = np.flatnonzero(d < reach)
        level = 1 - (d[inside] / reach) ** 2
        weight = areas[inside] * level**2
        slope = (areas[inside] * level * 4 / reach**2)[:, None] * away[inside]
        total = weight.sum()
        rows.append((inside, weight / total, slope / total))
    width = max((len(row[0]) for row in rows), default=1)
    members = np.zeros((len(rows), width), dtype=np.int64)
    weights, slopes = np.zeros((len(rows), width)), np.zeros((len(rows), width, 3))
    for k, (inside, weight, slope) in enumerate(rows):
        members[k, : len(inside)] = inside
        weights[k, : len(inside)] = weight
        slopes[k, : len(inside)] = slope
    return members, weights, slopes


def patch_change(
    weights: FloatArray, slope: FloatArray, ends: FloatArray, log_areas: FloatArray | float = 0.0
) -> FloatArray:
    """Change ``(q, c, s)`` of the weights of `patch_members`.

    Parameters
    ----------
    weights, slope : (c, s) and (c, s, 3)
    ends : (q, c, s, 3) mm
        Displacement of the insertion against that of each member.
    log_areas : (q, c, s)
        Relative change of the areas of the members.
    """
    change = np.einsum("csi,qcsi->qcs", slope, ends) + weights * log_areas
    return np.asarray(change - weights * change.sum(axis=2, keepdims=True))


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
    system: System,
    valve: Valve,
    contact_valve: Valve,
    settings: MechanicsSettings,
    pacing: Pacing | None = None,
) -> Callable[[float], Loads]:
    """Time -> loads: pressure, annulus and papillary tips of ``pacing`` (default: the closure)."""
    protocol: Pacing = settings.protocol if pacing is None else pacing
    assert system.hinge is not None
    start = system.hinge.points(system.solid.mesh.nodes)
    motion = contact_valve.motion
    shift = motion.annulus - motion.annulus[0]
    copies = len(start) // shift.shape[1]
    shift = np.tile(shift, (1, copies, 1))

    def loading(t: float) -> Loads:
        phase = protocol.phase(t)
        return Loads(
            pressure=mmhg_to_mpa(protocol.pressure(t)),
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
