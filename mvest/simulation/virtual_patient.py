"""Virtual patients: cases that a simulation wrote, with everything that no estimator is given.

A virtual patient is closed on another mesh than any estimator's, under a pressure, with chordae and
seen with errors that its case does not state. What was hidden is returned beside the case and
belongs in another place than it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Frame, Role, Uncertainty, ValveCase
from mvest.closure.frames import ERROR, OFFSET, FramesModel, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.errors import GeometryError, InputError
from mvest.mechanics.settings import MechanicsSettings
from mvest.mechanics.valve_system import HeldState
from mvest.observation.errors import WhiteNoise
from mvest.problem.registration import REGISTRATION, displace
from mvest.quantities import (
    Angle,
    CellsAlong,
    CellsAround,
    Factor,
    Length,
    Logarithm,
    Place,
    PointsAlong,
    PointsAround,
    Pressure,
    PressureError,
    Share,
)
from mvest.simulation.world import World
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.structured import structured_mesh

REFERENCE, CLOSED = "open", "closed"
"""Names of the first two frames of a virtual patient."""

FITTED, HELD = "fitted", "held"
"""What the names of further frames begin with, which are fitted or held out."""

GUIDES = (("hex18", 24, 3), ("hex18", 36, 4))
"""Element, columns and rows of the coarser meshes on which a closure is followed."""

FRAME_INTERVAL = 0.05
"""s between the closed frame and those that follow."""


@dataclass(frozen=True, slots=True)
class Deviations:
    """How far what is hidden may lie from what a case states: standard deviations.

    Attributes
    ----------
    pressure, chord_rest_length, chord_stiffness : float
        Relative.
    pressure_offset_mmHg, pressure_each_mmHg : float
        Of the pressures of several fitted frames, see `mvest.closure.frames`; not drawn for one.
    shift_mm, turn_degrees : float
        Of each component.
    """

    pressure: Logarithm = 0.10
    chord_rest_length: Factor = 0.02
    chord_stiffness: Factor = 0.20
    shift_mm: Length = 1.0
    turn_degrees: Angle = 2.0
    pressure_offset_mmHg: PressureError = 5.0
    pressure_each_mmHg: PressureError = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class VirtualPatient:
    """A simulated case, and what it does not say.

    Attributes
    ----------
    case : ValveCase
    values : mapping
        Parameter -> true value: the moduli in MPa, factors on what the case states, and the
        displacement of the leaflets as they were seen.
    positions : mapping
        Frame -> ``(n, 3)`` mm, where the vertices of the case would have been seen without errors,
        the displacement included.
    """

    case: ValveCase
    values: Mapping[str, float]
    positions: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True)
class PatientSimulation:
    """How virtual patients are made.

    Attributes
    ----------
    element : str
    columns, rows : int
        Cells of the mesh that is closed.
    dt_factor : float
        On the time step of the mechanics.
    contact_columns, contact_rows : int
    seen_columns, seen_rows : int
        Vertices of the surface that is seen.
    std_mm, correlation_length_mm : float
        Error of each coordinate of each vertex in each frame but the first, and over which distance
        it is alike. Frames are independent.
    rough_std_mm : float
        Of further errors in these frames that are independent, and that the case does not state.
    rest_std_mm : float
        Error of the open shape from which an estimator takes its model, the ends of the chordae on
        it included; 0: it is seen exactly.
    fitted_pressure_mmHg : tuple of float
        In further frames that an estimator is to fit with the closed one.
    fitted_relaxation : tuple of float
        Share of its way back to the open shape that the annulus has gone in each.
    held_pressure_mmHg, held_relaxation : tuple of float
        The same of the frames that are held out, one after another.
    held_tips : (float, float, float)
        mm, displacement of the papillary tips per unit of relaxation.
    world : World
        In what else the valve and how it is seen differ from what the case says.
    """

    element: str = "hex18"
    columns: CellsAround = 72
    rows: CellsAlong = 8
    dt_factor: Factor = 0.5
    contact_columns: PointsAround = 168
    contact_rows: PointsAlong = 38
    seen_columns: PointsAround = 80
    seen_rows: PointsAlong = 21
    std_mm: Length = 0.6
    correlation_length_mm: Length = 10.0
    rough_std_mm: Length = 0.0
    rest_std_mm: Length = 0.0
    fitted_pressure_mmHg: tuple[Pressure, ...] = ()
    fitted_relaxation: tuple[Share, ...] = ()
    held_pressure_mmHg: tuple[Pressure, ...] = (100.0, 80.0, 60.0)
    held_relaxation: tuple[Share, ...] = (0.15, 0.3, 0.45)
    held_tips: tuple[Place, Place, Place] = (0.0, 0.0, 2.0)
    world: World = field(default_factory=World)

    def __post_init__(self) -> None:
        for kind in ("fitted", "held"):
            pressures = getattr(self, f"{kind}_pressure_mmHg")
            relaxation = getattr(self, f"{kind}_relaxation")
            if len(pressures) != len(relaxation):
                raise InputError(
                    f"{kind}_pressure_mmHg has {len(pressures)} frames, {kind}_relaxation "
                    f"{len(relaxation)}; expected as many"
                )
            if len(set(pressures)) != len(pressures):
                raise InputError(
                    f"{kind}_pressure_mmHg = {pressures}, expected different ones: they name the "
                    "frames"
                )

    @property
    def fitted_frames(self) -> tuple[str, ...]:
        """Names of the frames that are fitted, the closed one first."""
        return (CLOSED, *(_name(FITTED, pressure) for pressure in self.fitted_pressure_mmHg))


def draw_hidden(
    moduli: Mapping[str, float],
    deviations: Deviations,
    rng: np.random.Generator,
    fitted: tuple[str, ...] = (CLOSED,),
) -> dict[str, float]:
    """True values of all parameters: the moduli as given, everything else drawn.

    Factors are log-normal, so that they are positive; displacements are normal, and so are errors
    of the pressures of several ``fitted`` frames.
    """
    factors = {
        "pressure_scale": deviations.pressure,
        "chord_stiffness": deviations.chord_stiffness,
        "chord_rest_length": deviations.chord_rest_length,
    }
    drawn = {name: float(np.exp(std * rng.standard_normal())) for name, std in factors.items()}
    for name in REGISTRATION:
        std = deviations.shift_mm if name.startswith("shift") else deviations.turn_degrees
        drawn[name] = float(std * rng.standard_normal())
    if len(fitted) > 1:
        errors = {OFFSET: deviations.pressure_offset_mmHg}
        errors |= {f"{ERROR}.{frame}": deviations.pressure_each_mmHg for frame in fitted}
        drawn |= {name: float(std * rng.standard_normal()) for name, std in errors.items()}
    return {**{name: float(value) for name, value in moduli.items()}, **drawn}


def simulate_patient(
    name: str,
    description: str,
    template: Template,
    values: Mapping[str, float],
    simulation: PatientSimulation,
    mechanics: MechanicsSettings,
    rng: np.random.Generator,
) -> VirtualPatient:
    """Close a template and see it.

    Parameters
    ----------
    name, description : str
        Of the case.
    template : Template
    values : mapping
        As from :func:`draw_hidden`.
    simulation : PatientSimulation
    mechanics : MechanicsSettings
        Its pressure is what the case states.
    rng : numpy.random.Generator
        For the errors.

    Raises
    ------
    GeometryError
        If the valve does not close, or has no equilibrium in a frame that is held out.
    """
    world, other = simulation.world, rng.spawn(1)[0]
    values = world.values(values, other)
    seen = template.valve(simulation.seen_columns, simulation.seen_rows)
    real = Template(world.anatomy(template.parameters, other))
    contact = real.valve(simulation.contact_columns, simulation.contact_rows)
    own = world.mechanics(mechanics, values)
    there = real.valve(simulation.seen_columns, simulation.seen_rows)
    centre = seen.motion.annulus[-1].mean(axis=0)
    registration = np.array([values[parameter] for parameter in REGISTRATION])
    shapes = close_patient(name, real, there, contact, values, simulation, own)
    true = {frame: displace(vertices, registration, centre) for frame, vertices in shapes.items()}
    case = _case(name, description, seen, true, simulation, mechanics, rng)
    return VirtualPatient(case, dict(values), {REFERENCE: seen.surface.vertices, **true})


def close_patient(
    name: str,
    template: Template,
    seen: Valve,
    contact: Valve,
    values: Mapping[str, float],
    simulation: PatientSimulation,
    mechanics: MechanicsSettings,
) -> dict[str, FloatArray]:
    """Close a virtual patient: frame -> ``(n, 3)`` mm of the vertices that are seen.

    The first frame is the closed one; those that are fitted with it and held out follow.

    Parameters
    ----------
    name : str
    template : Template
    seen, contact : Valve
        Of that template, where it is seen and where contact is sampled.
    values : mapping
        The model's parameters are its names, without those of a displacement.
    simulation : PatientSimulation
    mechanics : MechanicsSettings

    Raises
    ------
    GeometryError
        If the valve does not close, or has no equilibrium in one of these.
    """
    model = _model(template, seen, contact, values, simulation, mechanics)
    states = held_states(simulation, contact)
    errors = tuple(name for name in values if is_frame_pressure(name))
    frames = FramesModel(
        model,
        CLOSED,
        {frame: states[frame] for frame in simulation.fitted_frames[1:]},
        mechanics.protocol.pressure_mmHg,
        errors,
    )
    m = np.array([values[parameter] for parameter in frames.names])
    at = frames.of_closure(m)
    prediction = model(at)
    if not prediction.converged:
        raise GeometryError(f"virtual patient {name} does not close: {prediction.reason}")
    true = {CLOSED: prediction.y.reshape(2, -1, 3)[1]}
    for frame, vertices in zip(states, model.held(at, frames.under(m, states)), strict=True):
        if vertices is None:
            raise GeometryError(f"virtual patient {name} has no equilibrium in the frame {frame}")
        true[frame] = vertices
    return true


def _model(
    template: Template,
    seen: Valve,
    contact: Valve,
    values: Mapping[str, float],
    simulation: PatientSimulation,
    mechanics: MechanicsSettings,
) -> ClosureModel:
    """The model that closes a virtual patient, with the guides that it follows."""
    # An exponential tissue has its coefficients, which follow from a modulus, and no modulus.
    exponential = simulation.world.exponential
    names = tuple(
        name
        for name in values
        if not (
            name in REGISTRATION
            or is_frame_pressure(name)
            or (exponential and name.startswith("E_f."))
        )
    )
    protocol = replace(mechanics.protocol, dt=mechanics.protocol.dt * simulation.dt_factor)
    guide = None
    own = (simulation.element, simulation.columns, simulation.rows)
    # Closures are followed on coarser meshes only.
    guides = [cells for cells in GUIDES if cells[1] * cells[2] < own[1] * own[2]]
    for element, columns, rows in (*guides, own):
        guide = ClosureModel(
            seen,
            contact,
            structured_mesh(template, element, columns, rows),
            replace(mechanics, protocol=protocol),
            names,
            continuation=True,
            guide=guide,
            # A valve that does not follow its guide has more than one way to close.
            repeat=False,
        )
    assert guide is not None
    return guide


def _name(kind: str, pressure_mmHg: float) -> str:
    return f"{kind}_{pressure_mmHg:g}_mmHg"


def held_states(simulation: PatientSimulation, valve: Valve) -> dict[str, HeldState]:
    """The frames after the closed one, fitted with it or held out, on the annulus of a valve.

    Tips that move while the valve closes return with the annulus.
    """
    start, end = valve.motion.annulus[0], valve.motion.annulus[-1]
    tips = valve.motion.papillary_tips[-1]
    back = valve.motion.papillary_tips[0] - tips
    return {
        _name(kind, pressure): HeldState(
            pressure,
            end + relaxation * (start - end),
            tips + relaxation * (np.array(simulation.held_tips) + back),
        )
        for kind, pressures, relaxations in (
            (FITTED, simulation.fitted_pressure_mmHg, simulation.fitted_relaxation),
            (HELD, simulation.held_pressure_mmHg, simulation.held_relaxation),
        )
        for pressure, relaxation in zip(pressures, relaxations, strict=True)
    }


def _case(
    name: str,
    description: str,
    seen: Valve,
    true: Mapping[str, FloatArray],
    simulation: PatientSimulation,
    mechanics: MechanicsSettings,
    rng: np.random.Generator,
) -> ValveCase:
    other = rng.spawn(1)[0]
    surface, chordae = seen.surface, seen.chordae
    world, length = simulation.world, simulation.correlation_length_mm
    moved = np.stack(list(true.values()))
    seen_later = world.noise(simulation.std_mm, surface.vertices, length)(moved, moved, rng)
    if simulation.rough_std_mm:
        seen_later = WhiteNoise(simulation.rough_std_mm)(seen_later, moved, rng)
    exact = surface.vertices
    open_shape = exact + world.open_moves(seen, other)
    if simulation.rest_std_mm:
        rest_error = world.noise(simulation.rest_std_mm, exact, length)
        open_shape = rest_error(open_shape[None], exact[None], rng)[0]
    if np.any(open_shape != exact):
        surface = replace(surface, vertices=open_shape)
        # Where a chord ends is seen on the leaflet, and in error as it is.
        nearest = cKDTree(exact).query(chordae.insertion)[1]
        moved_ends = (open_shape - exact)[nearest]
        chordae = replace(chordae, insertion=chordae.insertion + moved_ends)
    motion = seen.motion
    at_annulus, at_tips = world.boundary(motion.annulus[-1], motion.papillary_tips[-1], other)
    seen_later[0] = world.seen(seen_later[0], seen.surface, other)
    states = {
        REFERENCE: HeldState(0.0, surface.vertices[seen.annulus], seen.papillary_tips + at_tips),
        CLOSED: HeldState(
            mechanics.protocol.pressure_mmHg,
            motion.annulus[-1] + at_annulus,
            motion.papillary_tips[-1] + at_tips,
        ),
        **held_states(simulation, seen),
    }
    end = mechanics.protocol.ramp
    times = (0.0, *(end + k * FRAME_INTERVAL for k in range(len(true))))
    roles = dict.fromkeys(simulation.fitted_frames, Role.FITTED)
    roles |= {REFERENCE: Role.REFERENCE, CLOSED: Role.CLOSED}
    frames = tuple(
        Frame(
            which,
            time,
            roles.get(which, Role.HELD_OUT),
            states[which].pressure_mmHg,
            vertices,
            surface.triangles,
            surface.region,
            states[which].annulus,
            vertices[seen.free_edge],
            states[which].papillary_tips,
            True,
        )
        for which, time, vertices in zip(
            (REFERENCE, *true), times, (surface.vertices, *seen_later), strict=True
        )
    )
    return ValveCase(
        name=name,
        description=description,
        source="simulated with mvest",
        licence="MIT",
        simulated=True,
        surface=surface,
        annulus=seen.annulus,
        free_edge=seen.free_edge,
        frames=frames,
        chordae=chordae,
        uncertainty=Uncertainty(simulation.std_mm, simulation.correlation_length_mm),
    )
