"""Virtual patients: simulated cases, and the truth that no estimator is given.

A virtual patient is closed on another mesh than any estimator's. Its pressure, its chordae and its
errors differ from what its case states. The true values are returned separately from the case.
Nothing here knows how a case is estimated, so that a stored patient does not depend on it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

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
    Modulus,
    Place,
    PointsAlong,
    PointsAround,
    Pressure,
    PressureError,
    Share,
)
from mvest.simulation.misspecification import Misspecification
from mvest.simulation.motion import DrawnValve, held_states
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Valve
from mvest.valve.anatomy.variation import vary
from mvest.valve.mesh.structured import structured_mesh

T = TypeVar("T")

REFERENCE, CLOSED = "open", "closed"
"""Names of the first two frames of a virtual patient."""

FITTED, HELD = "fitted", "held"
"""Prefixes of the names of further frames, which are fitted or held out."""

FRAME_INTERVAL = 0.05
"""s between consecutive frames from the closed one on."""


# -- settings -------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Deviations:
    """Standard deviations of the true values about what a case states."""

    pressure: Logarithm = 0.10  #: relative, as the two below
    chord_rest_length: Factor = 0.02
    chord_stiffness: Factor = 0.20
    shift_mm: Length = 1.0  #: of each component of the displacement
    turn_degrees: Angle = 2.0
    pressure_offset_mmHg: PressureError = 5.0  #: of several fitted frames (`mvest.closure.frames`)
    pressure_each_mmHg: PressureError = 5.0


@dataclass(frozen=True, slots=True)
class PatientSimulation:
    """How virtual patients are closed and observed."""

    element: str = "hex18"
    columns: CellsAround = 72  #: cells of the mesh that is closed
    rows: CellsAlong = 8
    dt_factor: Factor = 0.5  #: on the time step of the mechanics
    contact_columns: PointsAround = 168
    contact_rows: PointsAlong = 38
    seen_columns: PointsAround = 80  #: vertices of the observed surface
    seen_rows: PointsAlong = 21
    std_mm: Length = 0.6  #: of each coordinate of each vertex in each frame but the first
    correlation_length_mm: Length = 10.0  #: of these errors; frames are independent
    rough_std_mm: Length = 0.0  #: further independent errors, not stated by the case
    rest_std_mm: Length = 0.0  #: error of the open shape, ends of the chordae included
    fitted_pressure_mmHg: tuple[Pressure, ...] = ()  #: frames fitted with the closed one
    fitted_relaxation: tuple[Share, ...] = ()  #: share of the way back to the open shape
    held_pressure_mmHg: tuple[Pressure, ...] = (100.0, 80.0, 60.0)  #: frames that are held out
    held_relaxation: tuple[Share, ...] = (0.15, 0.3, 0.45)
    held_tips: tuple[Place, Place, Place] = (0.0, 0.0, 2.0)  #: mm per unit of relaxation
    misspecification: Misspecification = field(default_factory=Misspecification)

    def __post_init__(self) -> None:
        for kind in (FITTED, HELD):
            pressures = getattr(self, f"{kind}_pressure_mmHg")
            relaxation = getattr(self, f"{kind}_relaxation")
            if len(pressures) != len(relaxation):
                raise InputError(
                    f"{kind}_pressure_mmHg has {len(pressures)} frames, {kind}_relaxation "
                    f"{len(relaxation)}; expected as many"
                )
            if len(set(pressures)) != len(pressures):
                raise InputError(
                    f"{kind}_pressure_mmHg = {pressures}, expected different pressures: they name "
                    "the frames"
                )

    @property
    def fitted_frames(self) -> tuple[str, ...]:
        """Names of the frames that are fitted, the closed one first."""
        return (CLOSED, *(f"{FITTED}_{mmhg:g}_mmHg" for mmhg in self.fitted_pressure_mmHg))

    def held_states(self, valve: Valve) -> dict[str, HeldState]:
        """The frames after the closed one, fitted with it or held out, on a valve's annulus."""
        states: dict[str, HeldState] = {}
        for kind in (FITTED, HELD):
            pressures = getattr(self, f"{kind}_pressure_mmHg")
            shares = getattr(self, f"{kind}_relaxation")
            names = [f"{kind}_{mmhg:g}_mmHg" for mmhg in pressures]
            held = held_states(valve, pressures, shares, self.held_tips)
            states |= dict(zip(names, held, strict=True))
        return states


@dataclass(frozen=True, slots=True, kw_only=True)
class PatientSettings:
    """A virtual patient. The estimator sees only the case that is written."""

    name: str
    description: str
    misspecification: str = ""  #: the misspecification in words
    moduli: dict[str, Modulus] = field(default_factory=dict)  #: MPa
    moduli_spread: Factor = 0.0  #: SD of the logarithm by which they are drawn about these
    variation: Factor = 0.0  #: size of the random variation of the anatomy; 0: as configured
    simulation: PatientSimulation = field(default_factory=PatientSimulation)
    deviations: Deviations = field(default_factory=Deviations)
    paper_distance_mm: tuple[Length, ...] = ()  #: generic, personalised


# -- drawing --------------------------------------------------------------------------------------
def draw_patient_values(patient: PatientSettings, rng: np.random.Generator) -> dict[str, float]:
    """True value of each parameter: moduli in MPa, factors, displacement, errors of pressures.

    Moduli and factors are log-normal, so that they are positive. Displacements, and the errors of
    the pressures of several fitted frames, are normal.
    """
    own, fitted = patient.deviations, patient.simulation.fitted_frames
    moduli = {
        name: float(value * np.exp(patient.moduli_spread * rng.standard_normal()))
        for name, value in sorted(patient.moduli.items())
    }
    factors = {
        "pressure_scale": own.pressure,
        "chord_stiffness": own.chord_stiffness,
        "chord_rest_length": own.chord_rest_length,
    }
    drawn = {name: float(np.exp(std * rng.standard_normal())) for name, std in factors.items()}
    added = {
        name: own.shift_mm if name.startswith("shift") else own.turn_degrees
        for name in REGISTRATION
    }
    if len(fitted) > 1:
        added[OFFSET] = own.pressure_offset_mmHg
        added |= {f"{ERROR}.{frame}": own.pressure_each_mmHg for frame in fitted}
    drawn |= {name: float(std * rng.standard_normal()) for name, std in added.items()}
    return moduli | drawn


def first_that_closes(
    template: Template,
    variation: float,
    max_draws: int,
    rng: np.random.Generator,
    simulate: Callable[[Template], T],
) -> tuple[T, int]:
    """Simulate the first anatomy that closes, and return the number of anatomies drawn.

    Raises the last GeometryError if none of ``max_draws`` anatomies closes.
    """
    for draws in range(1, max_draws + 1):
        drawn = Template(vary(template.parameters, rng, variation)) if variation else template
        try:
            return simulate(drawn), draws
        except GeometryError as error:
            refused = error
    raise refused


# -- closing --------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True, eq=False)
class VirtualPatient:
    """A simulated case and its truth."""

    case: ValveCase
    #: Parameter -> true value: moduli in MPa, factors on what the case states, and the displacement
    #: of the observed leaflets.
    values: Mapping[str, float]
    #: Frame -> (n, 3) mm, vertices of the case without errors but with the displacement.
    positions: Mapping[str, FloatArray]


def simulate_patient(
    name: str,
    description: str,
    template: Template,
    values: Mapping[str, float],
    simulation: PatientSimulation,
    mechanics: MechanicsSettings,
    rng: np.random.Generator,
) -> VirtualPatient:
    """Close a template and observe it with errors.

    Name and description are those of the case, ``values`` those of :func:`draw_patient_values`. The
    pressure of the mechanics is what the case states; ``rng`` draws the errors. GeometryError if
    the valve does not close, or has no equilibrium in a further frame.
    """
    misspecification, other = simulation.misspecification, rng.spawn(1)[0]
    values = misspecification.values(values, other)
    seen = template.valve(simulation.seen_columns, simulation.seen_rows)
    real = Template(misspecification.anatomy(template.parameters, other))
    drawn = DrawnValve(name, real, values, misspecification.mechanics(mechanics))
    there = drawn.sampled(simulation.seen_columns, simulation.seen_rows)
    shapes = close_patient(drawn, there, simulation)
    centre = seen.motion.annulus[-1].mean(axis=0)
    registration = np.array([values[parameter] for parameter in REGISTRATION])
    true = {frame: displace(vertices, registration, centre) for frame, vertices in shapes.items()}
    case = _case(name, description, seen, true, simulation, mechanics, rng)
    return VirtualPatient(case, dict(values), {REFERENCE: seen.surface.vertices, **true})


def close_patient(
    drawn: DrawnValve, seen: Valve, simulation: PatientSimulation
) -> dict[str, FloatArray]:
    """Close a virtual patient: frame -> ``(n, 3)`` mm of the vertices of ``seen``.

    The first frame is the closed one; the fitted and the held-out ones follow. Raises GeometryError
    if the valve does not close, or has no equilibrium in one of these.
    """
    model, values = _model(drawn, seen, simulation), drawn.values
    states = simulation.held_states(model.contact_valve)
    frames = FramesModel(
        model,
        CLOSED,
        {frame: states[frame] for frame in simulation.fitted_frames[1:]},
        drawn.mechanics.protocol.pressure_mmHg,
        tuple(name for name in values if is_frame_pressure(name)),
    )
    m = np.array([values[parameter] for parameter in frames.names])
    at = frames.of_closure(m)
    prediction = model(at)
    patient = f"virtual patient {drawn.name}"
    if not prediction.converged:
        raise GeometryError(f"{patient} does not close: {prediction.reason}")
    true = {CLOSED: prediction.y.reshape(2, -1, 3)[1]}
    for frame, vertices in zip(states, model.held(at, frames.under(m, states)), strict=True):
        if vertices is None:
            raise GeometryError(f"{patient} has no equilibrium in the frame {frame}")
        true[frame] = vertices
    return true


def _model(drawn: DrawnValve, seen: Valve, simulation: PatientSimulation) -> ClosureModel:
    """The model that closes a virtual patient.

    No coarser mesh leads it: on 24 x 3 cells some valves close elsewhere, and the way back took
    nine times as long as closing alone.
    """
    not_modelled = {*REGISTRATION, *filter(is_frame_pressure, drawn.values)}
    protocol = drawn.mechanics.protocol
    finer = replace(protocol, dt=protocol.dt * simulation.dt_factor)
    own = simulation.element, simulation.columns, simulation.rows
    return ClosureModel(
        seen,
        drawn.sampled(simulation.contact_columns, simulation.contact_rows),
        structured_mesh(drawn.template, *own),
        replace(drawn.mechanics, protocol=finer),
        tuple(name for name in drawn.values if name not in not_modelled),
        continuation=True,
        # A valve that leaves its last closed state has more than one.
        repeat=False,
    )


# -- seeing ---------------------------------------------------------------------------------------
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
    surface, chordae, motion = seen.surface, seen.chordae, seen.motion
    misspecification, length = simulation.misspecification, simulation.correlation_length_mm
    exact, moved = surface.vertices, np.stack(list(true.values()))
    seen_later = misspecification.noise(simulation.std_mm, exact, length)(moved, moved, rng)
    if simulation.rough_std_mm:
        seen_later = WhiteNoise(simulation.rough_std_mm)(seen_later, moved, rng)
    open_shape = exact + misspecification.open_moves(seen, other)
    if simulation.rest_std_mm:
        rest_error = misspecification.noise(simulation.rest_std_mm, exact, length)
        open_shape = rest_error(open_shape[None], exact[None], rng)[0]
    if np.any(open_shape != exact):
        surface = replace(surface, vertices=open_shape)
        # The ends of chordae are seen on the leaflet, with its error.
        nearest = cKDTree(exact).query(chordae.insertion)[1]
        still = np.zeros_like(seen.papillary_tips)
        chordae = chordae.moved(still, (open_shape - exact)[nearest])
    at_annulus, at_tips = misspecification.boundary(
        motion.annulus[-1], motion.papillary_tips[-1], other
    )
    seen_later[0] = misspecification.seen(seen_later[0], seen.surface, other)
    states = {
        REFERENCE: HeldState(0.0, open_shape[seen.annulus], seen.papillary_tips + at_tips),
        CLOSED: HeldState(
            mechanics.protocol.pressure_mmHg,
            motion.annulus[-1] + at_annulus,
            motion.papillary_tips[-1] + at_tips,
        ),
        **simulation.held_states(seen),
    }
    end = mechanics.protocol.ramp
    times = (0.0, *(end + k * FRAME_INTERVAL for k in range(len(true))))
    roles = dict.fromkeys(simulation.fitted_frames, Role.FITTED)
    roles |= {REFERENCE: Role.REFERENCE, CLOSED: Role.CLOSED}
    frames = tuple(
        Frame(
            name=which,
            time=time,
            role=roles.get(which, Role.HELD_OUT),
            pressure_mmHg=states[which].pressure_mmHg,
            vertices=vertices,
            triangles=surface.triangles,
            region=surface.region,
            annulus=states[which].annulus,
            free_edge=vertices[seen.free_edge],
            papillary_tips=states[which].papillary_tips,
            corresponds=True,
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
