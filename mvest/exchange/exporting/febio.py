"""Exports a case as FEBio input (file format 4)."""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.closure.model import ClosureModel
from mvest.errors import InputError, require_numbers
from mvest.exchange.febio.document import LAWS, FebDocument, febio_law, opposite_faces
from mvest.mechanics.forces.cables import cable_force
from mvest.mechanics.forces.trees import SUPPORT
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.mechanics.system import System
from mvest.mechanics.valve_system import boundary_loading, build_system
from mvest.typing import FloatArray
from mvest.valve.mesh.given import GivenValve
from mvest.valve.mesh.solid_mesh import Embedding

GENERIC = {
    "E_f": {"anterior": 6.23, "posterior": 2.09},
    "ratio": {"anterior": 6.23 / 2.35, "posterior": 2.09 / 1.89},
}
"""E_f (MPa) and E_f / E_perp from the method paper (ISBI 2013)."""
CONTACT_COLUMNS, CONTACT_ROWS = 144, 32
"""Samples of the valve for chordal patches and the annulus."""
CONTACTS = ("potential", "none")
SAMPLES, TOE_POINTS = 61, 41
"""Points of the pressure and motion curves over the ramp, and of a chord's force over its toe.
"""
STEPS = 30
"""Initial number of time steps over the ramp; FEBio adapts it."""
EXPONENT = 4.0
"""Exponent p of the contact potential, FEBio's default."""


@dataclass(frozen=True, slots=True)
class FebioOptions:
    """Values that the case does not state, and FEBio settings.

    Attributes
    ----------
    E_f, ratio : tuple of float, optional
        E_f (MPa) and E_f / E_perp of each leaflet, in the order of the case's regions; generic by
        default.
    pressure_mmHg : float, optional
        Defaults to that of the closed frame.
    columns, rows : int
        Bricks around the valve and along the leaflets.
    law : str
        ``neo-hookean``, which is closer to the linear law in compression and keeps elements from
        inverting, or ``orthotropic`` (:mod:`mvest.exchange.febio.document`).
    contact : str
        ``potential`` (FEBio's contact potential between the atrial faces) or ``none``.
    contact_gap_mm : float
        Gap between the atrial faces of two flat leaflets at the contact's reference pressure.
    contact_reach_mm : float
        Gap (mm) at which contact begins.
    dynamic : bool
        Run with inertia and mass-proportional damping to the end of the protocol; otherwise static,
        to the end of its ramp.
    density_factor : float
        Factor on the density of a dynamic run. Heavier leaflets allow larger time steps and reach
        the same rest state.
    """

    E_f: tuple[float, ...] | None = None
    ratio: tuple[float, ...] | None = None
    pressure_mmHg: float | None = None
    columns: int = 24
    rows: int = 4
    law: str = "neo-hookean"
    contact: str = "potential"
    contact_gap_mm: float = 1.0
    contact_reach_mm: float = 1.65
    dynamic: bool = True
    density_factor: float = 1000.0

    def __post_init__(self) -> None:
        for name, known in {"law": LAWS, "contact": CONTACTS}.items():
            if (given := getattr(self, name)) not in known:
                raise InputError(f"{name} {given!r}, expected one of {', '.join(known)}")
        if not 0 < self.contact_gap_mm < self.contact_reach_mm:
            raise InputError(
                f"contact_gap_mm = {self.contact_gap_mm}, contact_reach_mm = "
                f"{self.contact_reach_mm}; expected 0 < gap < reach"
            )
        require_numbers(self, "FEBio", "density_factor")


def export_febio(source: Path, target: Path, options: FebioOptions) -> Path:
    """Write the closure of a case folder for FEBio.

    Run it with ``febio4 -i TARGET``. FEBio writes the positions of all nodes at every step to
    ``TARGET_positions.csv``, and everything else to its plot file.

    InputError, GeometryError or MaterialError if the source is not a case, or FEBio has no
    counterpart for the valve.
    """
    if target.suffix.lower() != ".feb":
        raise InputError(f"{target}: expected a name that ends in .feb")
    model = model_of_case(read_case(source), options)
    document = valve_document(model, np.zeros(0), options)
    pressure, law = model.settings.protocol.pressure_mmHg, LAWS[options.law]
    head = f"Closure under {pressure:g} mmHg. The law here is {law} in place of one"
    return document.write(target, f"{head} linear in the Biot strain; contact: {options.contact}.")


def model_of_case(case: ValveCase, options: FebioOptions) -> ClosureModel:
    """The closure model of a case, without free parameters."""
    names = case.surface.region_names
    chosen: dict[str, list[float]] = {}
    for what, given in (("E_f", options.E_f), ("ratio", options.ratio)):
        values = given or [GENERIC[what][name] for name in names if name in GENERIC[what]]
        if len(values) != len(names):
            raise InputError(
                f"{what}: {len(values)} values, expected one of each of {', '.join(names)}"
            )
        chosen[what] = list(map(float, values))
    settings = {
        name: TissueSettings(ratio) for name, ratio in zip(names, chosen["ratio"], strict=True)
    }
    pressure = options.pressure_mmHg
    if pressure is None:
        if case.closed is None:
            raise InputError(f"case {case.name}: no closed frame; give pressure_mmHg=...")
        pressure = case.closed.pressure_mmHg
    valve = GivenValve(case.valve)
    mesh = valve.layers("hex27", options.columns, options.rows)
    contact = valve.valve(CONTACT_COLUMNS, CONTACT_ROWS)
    mechanics = MechanicsSettings(settings, ClosureProtocol(pressure_mmHg=pressure))
    fixed = {f"E_f.{name}": value for name, value in zip(names, chosen["E_f"], strict=True)}
    return ClosureModel(case.valve, contact, mesh, mechanics, (), fixed)


def valve_document(model: ClosureModel, m: FloatArray, options: FebioOptions) -> FebDocument:
    """FEBio input for the closure of a valve at parameters ``m (p,)``.

    The mesh has elements in `NAMES`. MaterialError if a modulus is inadmissible.
    """
    values = {**model.fixed, **dict(zip(model.names, map(float, m), strict=True))}
    mechanics, protocol = model.settings, model.settings.protocol
    mesh = model.mesh
    unhindered = replace(mechanics, contact=replace(mechanics.contact, active=False))
    system = build_system(model.valve, model.contact_valve, mesh, unhindered, values)
    cables, hinge = system.cables, system.hinge
    assert cables is not None
    assert hinge is not None
    loading = boundary_loading(system, model.valve, model.contact_valve, mechanics)
    times = np.linspace(0.0, protocol.ramp, SAMPLES)
    pressure = np.array([loading(t).pressure for t in times]) * system.factors.pressure
    phase = np.stack([times, [protocol.phase(t) for t in times]], axis=1)
    opened, closed = loading(0.0), loading(protocol.ramp)
    # The leaflet ends and junctions of the chordae, and anchors that hold slack junctions.
    ends, c = (
        cables.state(mesh.nodes, opened.tips, *system.factors.chordae).end,
        len(cables.patches),
    )
    further = [opened.tips, ends, ends[c:], opened.hinge]
    at = np.cumsum([len(mesh.nodes), *map(len, further)])
    tip_nodes, end_nodes, anchors, hinge_nodes = (np.arange(*k) for k in itertools.pairwise(at))
    tissue = [mechanics.tissue[n].material(values[f"E_f.{n}"]) for n in mesh.region_names]
    document = FebDocument(
        mesh,
        [febio_law(material, options.law) for material in tissue],
        protocol.end if options.dynamic else protocol.ramp,
        protocol.ramp / STEPS,
        tolerance=1e-3 if options.dynamic else 1e-4,
        dynamic=options.dynamic,
        further=np.concatenate(further),
        density=mechanics.density * options.density_factor,
    )
    move = closed.tips - opened.tips
    moves = np.concatenate([move, move[cables.tip[c:]]])
    document.prescribe("tips", np.append(tip_nodes, anchors), moves, phase)
    document.prescribe("annulus", hinge_nodes, closed.hinge - opened.hinge, phase)
    document.average(end_nodes[:c], cables.patches)
    document.press(mesh.pressure_faces, np.stack([times, pressure], axis=1))
    if options.dynamic and mechanics.damping.alpha:
        document.damp(mechanics.damping.alpha)
    if options.contact != "none" and mechanics.contact.active:
        gap, reach = options.contact_gap_mm, options.contact_reach_mm
        inner = 0.5 * (gap + reach)
        # FEBio counts each pair of elements of one surface twice.
        kc = 0.5 * mechanics.contact.reference_pressure
        kc /= _pressure_of_sheets(gap, EXPONENT, inner, reach)
        document.touch(opposite_faces(mesh), kc=kc, p=EXPONENT, R_in=inner, R_out=reach)
    parent = cables.trees.parent
    start = np.where(parent < 0, tip_nodes[cables.tip], end_nodes[np.maximum(c + parent, 0)])
    pairs = np.stack([start, end_nodes], axis=1)
    document.pull(pairs, _chord_forces(system, document.nodes[pairs]))
    slack = Embedding(end_nodes[c:, None], np.ones((len(anchors), 1)), anchors)
    supports = (hinge_nodes, hinge.points, hinge.stiffness), (anchors, slack, SUPPORT)
    document.support(*supports[: 1 + bool(len(anchors))])
    return document


def _chord_forces(system: System, ends: FloatArray) -> list[FloatArray]:
    """Elongation relative to the initial length (mm) and force (N) of segments ``(k, 2, 3)``."""
    cables, factors = system.cables, system.factors
    assert cables is not None
    apart = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    length = np.broadcast_to(factors.chord_rest_length, apart.shape) * cables.rest_length
    stiffness = np.broadcast_to(factors.chord_stiffness, apart.shape) * cables.axial_stiffness
    toe = cables.toe_strain
    strain = np.concatenate([[-1.0], np.linspace(0.0, toe, TOE_POINTS), [toe + 1.0]])
    elongation = length[:, None] * (1 + strain) - apart[:, None]
    force = stiffness[:, None] * cable_force(strain, toe)[0]
    return list(np.stack([elongation, force], axis=2))


def _pressure_of_sheets(gap: float, p: float, inner: float, outer: float) -> float:
    r"""Pressure (MPa) between two flat sheets ``gap`` mm apart, for kc = 1.

    With the force f(r) between two points it is :math:`2 \pi d \int_d^\infty f(r) dr`, the
    derivative of :math:`2 \pi \int_d^\infty \varphi(r) r dr` with respect to d. FEBio's force is
    :math:`r^{-p}` minus a constant up to ``inner``, and falls to zero as a parabola at ``outer``.
    """
    c1 = 0.5 * p / ((outer - inner) * inner ** (p + 1))
    c2 = inner**-p - c1 * (inner - outer) ** 2
    parabola = c1 * (outer - max(gap, inner)) ** 3 / 3
    if gap >= inner:
        return 2 * np.pi * gap * parabola
    power = (gap ** (1 - p) - inner ** (1 - p)) / (p - 1) - c2 * (inner - gap)
    return 2 * np.pi * gap * (power + parabola)
