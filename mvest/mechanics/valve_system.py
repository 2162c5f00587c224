"""A valve in a solid mesh, with all its loads, supports and contact.

Everything is defined in the reference frame and embedded, so that loads, contact and observations
do not depend on the mesh.
"""

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
from mvest.mechanics.law.exponential import ExponentialLaw, StiffeningLaw, as_stiff
from mvest.mechanics.law.regional import (
    FieldBasis,
    LeafletLaw,
    ModulusVariation,
    at_quadrature,
    prestretch_map,
    relaxed_map,
)
from mvest.mechanics.parameters import NamePart, kind_of
from mvest.mechanics.settings import EXPONENTIAL_KINDS, MechanicsSettings
from mvest.mechanics.solid import Solid
from mvest.mechanics.system import Factors, Loads, System
from mvest.typing import FloatArray, IntArray
from mvest.units import mmhg_to_mpa
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.solid_mesh import SolidMesh, embed


class Pacing(Protocol):
    """Pressure and motion of the boundary as functions of time."""

    def pressure(self, t: float, /) -> float:
        """Transmitral pressure (mmHg) at time ``t`` (s)."""

    def phase(self, t: float, /) -> float:
        """Share of the closure at time ``t`` (s), from 0 (open) to 1 (closed)."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldState:
    """Boundary conditions of a closed valve in a further frame."""

    pressure_mmHg: float
    annulus: FloatArray  #: (k, 3) mm, of the annulus vertices of the *contact valve*
    papillary_tips: FloatArray  #: (t, 3) mm


def build_system(
    valve: Valve,
    contact_valve: Valve,
    mesh: SolidMesh,
    settings: MechanicsSettings,
    values: Mapping[str, float],
    ties: TiedPoints | None = None,
    relaxed: FloatArray | None = None,
) -> System:
    """A system of the valve in the given mesh.

    InputError if a region has no tissue or no modulus, or there is no such parameter. MaterialError
    if a modulus is inadmissible.

    Parameters
    ----------
    valve : Valve
        With chordae, annulus and motion.
    contact_valve : Valve
        The same valve in the resolution of the contact samples.
    mesh : SolidMesh
    settings : MechanicsSettings
    values : mapping
        Parameter (:data:`mvest.mechanics.parameters.KINDS`) -> value, at least the modulus of each
        region.
    ties : TiedPoints, optional
    relaxed : (e, q, 6), optional
        See `material_law`.
    """
    check_parameters(values, valve, settings)
    chordae = valve.chordae
    law = material_law(mesh, settings, values, variation_of(valve, mesh, settings), relaxed)
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
        chordae.parent,
        chordae.junction - valve.papillary_tips[chordae.tip[len(chordae.insertion) :]],
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
    """Raise InputError for names that are no parameters of this valve with these settings."""
    tips = [f"tip{k}" for k in range(len(valve.papillary_tips))]
    parts = {
        NamePart.REGION: valve.surface.region_names,
        NamePart.CHORDS: (*valve.chordae.family_names, *tips),
        NamePart.MODE: [f"{r}.{k}" for r, own in settings.fields.items() for k in range(own.modes)],
    }
    for name in names:
        kind, _, part = name.partition(".")
        known = parts.get(kind_of(name).part, ())
        if part and part not in known:
            raise InputError(
                f"parameter {name!r}: unknown {part!r}; known here: {', '.join(known) or '(none)'}"
            )
        tissue = settings.tissue.get(part)
        if tissue is not None and kind not in tissue.kinds:
            raise InputError(
                f"parameter {name!r}: the tissue of {part!r} follows the {tissue.law} law, which "
                f"has {', '.join(tissue.kinds)}"
            )


def material_law(
    mesh: SolidMesh,
    settings: MechanicsSettings,
    values: Mapping[str, float],
    variation: ModulusVariation | None = None,
    relaxed: FloatArray | None = None,
) -> Law:
    """The law of the mesh.

    InputError if a region has no tissue or no modulus, or a value is of another region.
    MaterialError if a modulus is inadmissible.

    Parameters
    ----------
    mesh : SolidMesh
    settings : MechanicsSettings
    values : mapping
        Parameter -> value: ``E_f.REGION`` of each region with a linear law, and any others. Those
        of other parts than tissue are ignored.
    variation : ModulusVariation, optional
        From `variation_of`; by default the moduli are constant within each leaflet.
    relaxed : (e, q, 6), optional
        Green-Lagrange strain of the shape that is free of stress, by default the mesh's.
    """
    regions = mesh.region_names
    kinds = {settings.tissue[region].law for region in regions if region in settings.tissue}
    if "corotational" in kinds and len(kinds) > 1:
        raise InputError("the corotational law is that of all regions of a mesh, or of none")
    together = [regions] if len(kinds) == 1 and "stiffening" not in kinds else zip(regions)
    laws = tuple(_law_of(own, settings, values) for own in together)
    tissues = [settings.tissue[region] for region in regions]
    prestretch = np.array(
        [values.get(f"prestretch.{r}", t.prestretch) for r, t in zip(regions, tissues, strict=True)]
    )
    ratio = np.array([tissue.prestretch_ratio for tissue in tissues])
    if not np.all(prestretch > 0.0):
        raise InputError(f"prestretch of tissue = {prestretch.tolist()}, expected > 0")
    stretched = any(name.startswith("prestretch.") for name in values)
    stretched |= bool(np.any(prestretch != 1.0) or np.any(ratio != 1.0))
    if variation is None and not stretched and relaxed is None and len(laws) == 1:
        return laws[0]
    scale = 1.0 if variation is None else variation.scale(values)
    stress_free = prestretch_map(prestretch, ratio)[mesh.region, None]
    if relaxed is not None:
        own, volume = relaxed_map(relaxed)
        stress_free, scale = stress_free @ own, scale * volume
    return LeafletLaw(laws, mesh.region, stress_free, scale, variation, relaxed)


def _law_of(
    regions: tuple[str, ...], settings: MechanicsSettings, values: Mapping[str, float]
) -> Law:
    """The law of a body of these regions, whose tissue is of one kind."""
    for region in regions:
        tissue = settings.tissue.get(region)
        if tissue is None or (tissue.law != "exponential" and f"E_f.{region}" not in values):
            raise InputError(
                f"region {region!r} of the mesh has no tissue or modulus; given are "
                f"{', '.join(sorted(settings.tissue))} and {', '.join(sorted(values))}"
            )
    tissues = [settings.tissue[region] for region in regions]

    def given(region: str, *kinds: str) -> dict[str, float]:
        return {k: values[f"{k}.{region}"] for k in kinds if f"{k}.{region}" in values}

    if tissues[0].law == "exponential":
        curves = []
        for region, tissue in zip(regions, tissues, strict=True):
            own, modulus = given(region, *EXPONENTIAL_KINDS), values.get(f"E_f.{region}")
            if own and modulus is not None:
                raise InputError(
                    f"parameters E_f.{region} and {', '.join(own)} of {region!r}: expected either "
                    "the modulus of an exponential law or its coefficients"
                )
            curve = tissue.coefficients(own)
            curves.append(curve if modulus is None else as_stiff(curve, tissue, modulus))
        return ExponentialLaw.of(curves)
    if tissues[0].law == "stiffening":
        own = {"stiffening": tissues[0].stiffening, **given(regions[0], "E_f", "stiffening")}
        return StiffeningLaw.of(tissues[0], **own)
    materials = [
        tissue.material(values[f"E_f.{region}"])
        for tissue, region in zip(tissues, regions, strict=True)
    ]
    return BiotLaw.of(materials, corotational=tissues[0].law == "corotational")


def variation_of(
    valve: Valve, mesh: SolidMesh, settings: MechanicsSettings
) -> ModulusVariation | None:
    """Variation of the modulus within the leaflets, at the mesh's points; None if constant."""
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
    """Set other parameter values in a valve's system; see `build_system`."""
    assert system.cables is not None
    old = system.solid.law
    kept = (old.variation, old.relaxed) if isinstance(old, LeafletLaw) else ()
    law = material_law(system.solid.mesh, settings, values, *kept)
    system.retune(law, factors_of(system.cables, values))


def factors_of(cables: Cables, values: Mapping[str, float]) -> Factors:
    """Factors on pressure and cables from the values; InputError if a part is unknown."""
    return Factors(
        values.get("pressure_scale", 1.0),
        cables.factor("chord_stiffness", values),
        cables.factor("chord_rest_length", values),
    )


def patch_members(
    valve: Valve, radius: float, insertion: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Leaflet ends of the chordae: averages over material points within ``radius`` mm.

    The weights are ``area (1 - (d / radius)^2)^2``.

    Returns
    -------
    members : (c, s)
        Vertices; padding has the weight zero.
    weights : (c, s)
        Rows sum to one.
    slope : (c, s, 3) 1/mm
        Derivatives of the weights by the insertion, without normalisation; see `patch_change`.
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
        Displacement of the insertion relative to each member.
    log_areas : (q, c, s)
        Relative change of the areas of the members.
    """
    change = np.einsum("csi,qcsi->qcs", slope, ends) + weights * log_areas
    return np.asarray(change - weights * change.sum(axis=2, keepdims=True))


def _support(mesh: SolidMesh, valve: Valve, settings: MechanicsSettings) -> Hinge:
    """Hinge or clamp along the annulus, of a given stiffness per length."""
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
    faces = np.concatenate([np.arange(n), np.arange(n) + 2 * n])
    return Hinge(three.take(faces), np.tile(0.5 * share, 2))


def boundary_loading(
    system: System,
    valve: Valve,
    contact_valve: Valve,
    settings: MechanicsSettings,
    pacing: Pacing | None = None,
) -> Callable[[float], Loads]:
    """Time -> loads: pressure, annulus and papillary tips of ``pacing`` (default: the closure)."""
    protocol: Pacing = settings.protocol if pacing is None else pacing
    motion = contact_valve.motion
    shift = motion.annulus - motion.annulus[0]

    def loading(t: float) -> Loads:
        phase = protocol.phase(t)
        moved = _interpolate(motion.phase, shift, phase)
        tips = _interpolate(motion.phase, motion.papillary_tips, phase)
        return _loads(system, protocol.pressure(t), moved, tips, phase)

    return loading


def held_loading(
    system: System, contact_valve: Valve, state: HeldState
) -> Callable[[float], Loads]:
    """Time -> the constant loads of a further frame.

    InputError if the numbers of annulus points or tips are not those of the valve.
    """
    rest = contact_valve.motion.annulus[0]
    for name, given, own in (
        ("annulus", state.annulus, rest),
        ("papillary_tips", state.papillary_tips, contact_valve.papillary_tips),
    ):
        if given.shape != own.shape:
            raise InputError(f"held {name}: shape {given.shape}, expected {own.shape}")
    moved = state.annulus - rest
    loads = _loads(system, state.pressure_mmHg, moved, state.papillary_tips, 1.0)
    return lambda t: loads


def _loads(
    system: System, pressure_mmHg: float, moved: FloatArray, tips: FloatArray, phase: float
) -> Loads:
    """Loads with the annulus ``moved (k, 3)`` mm from rest, and tips ``(t, 3)`` mm.

    The force-free lengths of ties run from those at rest to those in the closed valve.
    """
    assert system.hinge is not None
    nodes, lengths = system.solid.mesh.nodes, None
    if system.ties is not None:
        lengths = (1 - phase) * system.ties.lengths(nodes) + phase * system.ties.closed_length
    start = system.hinge.points(nodes)
    hinge = start + np.tile(moved, (len(start) // len(moved), 1))
    return Loads(mmhg_to_mpa(pressure_mmHg), tips, hinge, tie_lengths=lengths)


def _interpolate(phases: FloatArray, frames: FloatArray, phase: float) -> FloatArray:
    """Piecewise monotone cubic between key frames (linear for two)."""
    if len(phases) == 2:
        return (1 - phase) * frames[0] + phase * frames[1]
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(phases, frames, axis=0)(phase))
