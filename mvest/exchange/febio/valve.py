"""A valve and its closure as input of FEBio, and what in it is not as it is here."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.errors import InputError, require_numbers
from mvest.exchange.febio.document import (
    Averages,
    Control,
    FebDocument,
    PotentialContact,
    Prescribed,
    Pressure,
    SlidingContact,
    Springs,
    Support,
)
from mvest.exchange.febio.mesh import FebLaw, FebMesh, febio_law, febio_mesh, opposite_faces
from mvest.mechanics.forces.cables import Cables, Hinge, cable_force
from mvest.mechanics.settings import MechanicsSettings
from mvest.mechanics.system import System
from mvest.mechanics.valve_system import boundary_loading, build_system
from mvest.typing import FloatArray, IntArray

CONTACTS = ("potential", "sliding", "none")
SAMPLES = 61
"""Points of the curves of pressure and motion over the ramp."""
TOE_POINTS = 41
"""Points of the force of a chord over its toe."""
EXPONENT = 4.0
"""p of the contact potential, FEBio's own choice."""


@dataclass(frozen=True, slots=True)
class FebSettings:
    """What is chosen in FEBio.

    Attributes
    ----------
    law : str
        Of the linear tissue: ``neo-hookean``, which is nearer where the tissue is compressed and
        keeps elements from turning over, or ``orthotropic`` (:mod:`mvest.exchange.febio.mesh`).
    contact : str
        ``potential``: FEBio's contact potential between the atrial faces; ``sliding``: its
        ``sliding-elastic`` between the leaflets; ``none``.
    contact_gap_mm : float
        Between the atrial faces of two flat leaflets that press on each other with the reference
        pressure of the contact (potential), or that touch (sliding).
    contact_reach_mm : float
        Gap at which contact begins (potential), or within which it is looked for (sliding).
    penalty : float
        Of sliding contact, on what FEBio works out.
    dynamic : bool
        With inertia and damping by mass, to the end of the protocol; otherwise static, to the end
        of its ramp.
    density_factor : float
        On the density of a dynamic run: heavier leaflets take larger steps of time, and come to
        rest where lighter ones do.
    steps : int
        Time steps over the ramp to begin with; FEBio changes them.
    quasi_newton : int
        BFGS updates between two tangents; FEBio's tangent of ``neo-hookean`` is not exact.
    tolerance : float
        Of displacements, relative; that of the energy is its square.
    """

    law: str = "neo-hookean"
    contact: str = "potential"
    contact_gap_mm: float = 1.0
    contact_reach_mm: float = 1.65
    penalty: float = 1.0
    dynamic: bool = True
    density_factor: float = 1000.0
    steps: int = 30
    quasi_newton: int = 10
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if self.contact not in CONTACTS:
            raise InputError(f"contact {self.contact!r}, expected one of {', '.join(CONTACTS)}")
        if not 0 <= self.contact_gap_mm < self.contact_reach_mm:
            raise InputError(
                f"contact_gap_mm = {self.contact_gap_mm}, contact_reach_mm = "
                f"{self.contact_reach_mm}; expected 0 <= gap < reach"
            )
        if self.contact == "potential" and self.contact_gap_mm == 0:
            raise InputError("contact_gap_mm = 0; expected a gap, which a potential keeps")
        if self.steps < 1 or self.quasi_newton < 0:
            raise InputError(
                f"steps = {self.steps}, quasi_newton = {self.quasi_newton}; expected >= 1 and >= 0"
            )
        require_numbers(self, "FEBio", "penalty", "tolerance", "density_factor")


def valve_document(model: ClosureModel, m: FloatArray, settings: FebSettings) -> FebDocument:
    """The closure of a valve with parameters ``m (p,)``, which are values in the file.

    Raises
    ------
    InputError
        If the mesh or the law has no counterpart, or the boundary goes another way than straight.
    MaterialError
        If a modulus is inadmissible.
    """
    values = {**model.fixed, **dict(zip(model.names, map(float, m), strict=True))}
    mechanics = model.settings
    if len(model.valve.motion.phase) != 2:
        raise InputError(
            f"the boundary has {len(model.valve.motion.phase)} key frames; expected two, between "
            "which it goes straight"
        )
    if mechanics.fields or mechanics.patches:
        raise InputError("the modulus varies within a leaflet; expected one of each leaflet")
    if model.ties is not None:
        raise InputError("leaflets are tied together, as by a clip; expected a valve without")
    mesh = febio_mesh(model.mesh)
    unhindered = replace(mechanics, contact=replace(mechanics.contact, active=False))
    system = build_system(model.valve, model.contact_valve, mesh.solid, unhindered, values)
    boundary = _Boundary.of(model, system, mechanics)
    assert system.cables is not None
    first = len(mesh.solid.nodes)
    tips, ends = boundary.tips[0], system.cables.patches(mesh.solid.nodes)
    at = np.cumsum([first, len(tips), len(ends), len(boundary.hinge[0])])
    tip_nodes, end_nodes, hinge_nodes = (np.arange(a, b) for a, b in itertools.pairwise(at))
    protocol, times = mechanics.protocol, boundary.times
    end = protocol.end if settings.dynamic else protocol.ramp
    step = protocol.ramp / settings.steps
    return FebDocument(
        mesh,
        tuple(_law(mechanics, values, name, settings) for name in mesh.solid.region_names),
        Control(
            end,
            step,
            1e-4 * step,
            step,
            settings.dynamic,
            settings.quasi_newton,
            settings.tolerance,
            settings.tolerance**2,
        ),
        Pressure(mesh.solid.pressure_faces, np.stack([times, boundary.pressure], axis=1)),
        (
            Prescribed("tips", tip_nodes, boundary.tips[1] - tips, boundary.curve),
            Prescribed("annulus", hinge_nodes, np.diff(boundary.hinge, axis=0)[0], boundary.curve),
        ),
        np.concatenate([tips, ends, boundary.hinge[0]]),
        Averages(end_nodes, system.cables.patches),
        Support(hinge_nodes, boundary.hinge_of.points, boundary.hinge_of.stiffness),
        Springs(
            np.stack([tip_nodes[system.cables.tip], end_nodes], axis=1),
            _chord_forces(system, tips, ends),
        ),
        _contact(mesh, model, settings),
        mechanics.density * settings.density_factor,
        mechanics.damping.alpha,
        tuple(f"{part}: here {ours}; in this file {theirs}." for part, ours, theirs in
              differences(model, settings)),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Boundary:
    """Times (s), pressure (MPa), and where tips and hinge are open and closed."""

    times: FloatArray
    pressure: FloatArray
    curve: FloatArray
    tips: FloatArray
    hinge: FloatArray
    hinge_of: Hinge

    @classmethod
    def of(cls, model: ClosureModel, system: System, mechanics: MechanicsSettings) -> _Boundary:
        protocol = mechanics.protocol
        assert system.hinge is not None
        loading = boundary_loading(system, model.valve, model.contact_valve, mechanics)
        times = np.linspace(0.0, protocol.ramp, SAMPLES)
        pressure = np.array([loading(t).pressure for t in times]) * system.factors.pressure
        phase = np.array([protocol.phase(t) for t in times])
        ends = [loading(0.0), loading(protocol.ramp)]
        return cls(
            times,
            pressure,
            np.stack([times, phase], axis=1),
            np.stack([load.tips for load in ends]),
            np.stack([load.hinge for load in ends]),
            system.hinge,
        )


def _law(
    mechanics: MechanicsSettings, values: dict[str, float], region: str, settings: FebSettings
) -> FebLaw:
    tissue = mechanics.tissue[region]
    own = {
        kind: values[f"{kind}.{region}"] for kind in tissue.kinds if f"{kind}.{region}" in values
    }
    if tissue.law == "stiffening" or own.pop("prestretch", tissue.prestretch) != 1.0:
        raise InputError(
            f"{region}: its tissue is between two laws or prestretched; the file has no such law"
        )
    if tissue.law == "exponential":
        return febio_law(tissue.coefficients(own), settings.law)
    moduli = tissue.moduli(own["E_f"], own.get("ratio"), own.get("G"))
    return febio_law(moduli.material, settings.law)


def _chord_forces(system: System, tips: FloatArray, ends: FloatArray) -> list[FloatArray]:
    """Elongation against the distance at rest (mm) and force (N) of each chord."""
    cables, factors = system.cables, system.factors
    assert isinstance(cables, Cables)
    n = len(cables.rest_length)
    length = np.broadcast_to(factors.chord_rest_length, n) * cables.rest_length
    stiffness = np.broadcast_to(factors.chord_stiffness, n) * cables.axial_stiffness
    toe = cables.toe_strain
    strain = np.concatenate([[-1.0], np.linspace(0.0, toe, TOE_POINTS), [toe + 1.0]])
    force = cable_force(strain, toe)[0]
    apart = np.linalg.norm(ends - tips[cables.tip], axis=1)
    return [
        np.stack([own * (1 + strain) - start, ea * force], axis=1)
        for own, start, ea in zip(length, apart, stiffness, strict=True)
    ]


def _contact(
    mesh: FebMesh, model: ClosureModel, settings: FebSettings
) -> PotentialContact | SlidingContact | None:
    if settings.contact == "none" or not model.settings.contact.active:
        return None
    faces = opposite_faces(mesh.solid)
    names = mesh.solid.region_names
    region = _region_of_faces(mesh, faces)
    surfaces = {f"{name}_atrial": faces[region == k] for k, name in enumerate(names)}
    gap, reach = settings.contact_gap_mm, settings.contact_reach_mm
    if settings.contact == "sliding":
        return SlidingContact(surfaces, settings.penalty, reach, gap)
    inner = 0.5 * (gap + reach)
    pressure = model.settings.contact.reference_pressure
    # Each pair of elements of one surface is counted twice.
    stiffness = 0.5 * pressure / _pressure_of_sheets(gap, EXPONENT, inner, reach)
    return PotentialContact(surfaces, stiffness, EXPONENT, inner, reach)


def _pressure_of_sheets(gap: float, p: float, inner: float, outer: float) -> float:
    r"""Pressure (MPa) between two flat sheets that are ``gap`` mm apart, for kc = 1.

    With the force f(r) between two points, :math:`2 \pi d \int_d^\infty f(r) dr`: the derivative of
    the energy :math:`2 \pi \int_d^\infty \varphi(r) r dr` by d.
    """
    c1 = 0.5 * p / ((outer - inner) * inner ** (p + 1))
    c2 = inner**-p - c1 * (inner - outer) ** 2
    parabola = c1 * (outer - max(gap, inner)) ** 3 / 3
    if gap >= inner:
        return 2 * np.pi * gap * parabola
    power = (gap ** (1 - p) - inner ** (1 - p)) / (p - 1) - c2 * (inner - gap)
    return 2 * np.pi * gap * (power + parabola)


def _region_of_faces(mesh: FebMesh, faces: IntArray) -> IntArray:
    """Region ``(f,)`` of the element that each face ``(f, k)`` is part of."""
    at: dict[int, set[int]] = {}
    for e, nodes in enumerate(mesh.solid.elements):
        for node in nodes:
            at.setdefault(int(node), set()).add(e)
    hosts = [min(set.intersection(*(at[int(node)] for node in face))) for face in faces]
    return np.asarray(mesh.solid.region[hosts])


def differences(model: ClosureModel, settings: FebSettings) -> list[tuple[str, str, str]]:
    """What is not the same in FEBio: what it is about, as it is here, and as it is there."""
    mesh, mechanics = model.mesh, model.settings
    kinds = {mechanics.tissue[name].law for name in mesh.region_names}
    rows = [("element", *ELEMENTS[mesh.element_type])]
    for kind in sorted(kinds):
        rows.append(("law", *(LAW_WORDS[settings.law] if kind != "exponential" else EXPONENTIAL)))
    rows.append(
        (
            "direction of the fibre",
            "at every node of an element, interpolated",
            "the same" if kinds == {"exponential"} else
            "one in each element, that at its centre",
        )
    )  # fmt: skip
    contact = mechanics.contact
    ours = (
        f"a potential between {len(model.contact_valve.surface.vertices)} points of the "
        f"midsurface, {contact.reference_distance:g} thicknesses apart under "
        f"{1e3 * contact.reference_pressure:g} kPa and beginning at "
        f"{contact.activation_distance:g}; no step takes leaflets through each other"
        if contact.active
        else "none"
    )
    theirs = {
        "potential": "contact potential between the integration points of the atrial faces, "
        f"{settings.contact_gap_mm:g} mm apart under the same pressure and beginning at "
        f"{settings.contact_reach_mm:g} mm; none between elements that share a node, nor anything "
        "that keeps leaflets from passing through",
        "sliding": "sliding-elastic by penalty between the atrial faces of different leaflets, "
        f"{settings.contact_gap_mm:g} mm apart; none of a leaflet with itself",
        "none": "none",
    }[settings.contact if contact.active else "none"]
    rows.append(("contact", ours, theirs))
    damping = mechanics.damping
    rows.append(
        (
            "time",
            f"implicit Euler with damping {damping.alpha:g} 1/s of mass and {damping.beta:g} s of "
            "the Biot strain's stiffness"
            + (", then an equilibrium" if mechanics.protocol.equilibrium else ""),
            f"the generalised alpha rule (rho 0), density times {settings.density_factor:g}, "
            f"damping {damping.alpha:g} 1/s of mass alone"
            if settings.dynamic
            else "a static equilibrium at each time",
        )
    )  # fmt: skip
    rows.append(
        (
            "chordae",
            "cables with a toe of the fourth power",
            f"springs whose force is linear between {TOE_POINTS} points of that toe",
        )
    )
    rows.append(
        (
            "annulus, chord patches",
            "weighted averages of nodes on elastic supports, and at the ends of cables",
            "the same, as a penalty on linear constraints and as linear constraints",
        )
    )
    return rows


ELEMENTS = {
    "tet4": ("tet4, one point of integration", "the same"),
    "tet10": ("tet10, four points of integration", "the same"),
    "hex27": ("hex27, 3 x 3 x 2 points of integration", "hex27, 3 x 3 x 3 points"),
    "hex18": (
        "hex18, linear through the thickness with enhanced thickness strain, 3 x 3 x 2 points",
        "hex27, quadratic through the thickness, 3 x 3 x 3 points",
    ),
    "hex18_thin": (
        "hex18_thin, as hex18 with assumed strains",
        "hex27, quadratic through the thickness, 3 x 3 x 3 points, locking where it is thin",
    ),
    "wedge12": ("wedge12, enhanced thickness strain", "penta15, without the sides' middles"),
    "wedge18": ("wedge18", "penta15, without the sides' middles"),
}
LAW_WORDS = {
    "orthotropic": (
        "linear in the Biot strain",
        "orthotropic elastic, the same stiffness of the Green-Lagrange strain",
    ),
    "neo-hookean": ("linear in the Biot strain", "neo-Hookean transiso with the same moduli"),
}
EXPONENTIAL = (
    "exponential, fibres by their full stretch",
    "the same exponential, uncoupled: fibres by their isochoric stretch",
)
