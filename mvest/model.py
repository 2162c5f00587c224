"""The joint of valve and mechanics: moduli in, geometry of the leaflets and its derivative out.

``build_system`` hangs everything that acts on a valve into a solid mesh. All of it is defined in
the reference frame and embedded, so the same valve gives the same loads, contact and observations
in every mesh. ``ClosureModel`` is what a filter sees: a function from parameters to predicted
positions and their Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from mvest.errors import InputError, MaterialError
from mvest.estimation.prediction import Prediction
from mvest.mechanics.cables import Cables, Hinge
from mvest.mechanics.contact import Contact, ContactSettings
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law import BiotLaw, PoissonReading, TransverselyIsotropic
from mvest.mechanics.pressure import PressureLoad
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import LinearSolver, linear_solver
from mvest.mechanics.steps import Damping, NewtonSettings, Simulation, Step
from mvest.mechanics.system import Factors, Loads, Parameter, System
from mvest.typing import FloatArray
from mvest.units import mmhg_to_mpa
from mvest.valve.anatomy import Valve
from mvest.valve.embedding import Embedding, embed
from mvest.valve.mesh import SolidMesh

__all__ = [
    "ClosedState",
    "ClosureModel",
    "ClosureProtocol",
    "ClosureResult",
    "MechanicsSettings",
    "TissueSettings",
    "build_system",
]


REST = (0.05, 0.15)
"""s, steps of time in which a state taken over from another mesh comes to rest under the final
loads. Damping by stiffness holds what the coarser mesh could not tell; without it the equilibrium
of large meshes (160 x 19 cells) is not found from there."""


@dataclass(frozen=True, slots=True)
class TissueSettings:
    """Material of one region apart from E_f, which is estimated.

    Attributes
    ----------
    ratio : float
        E_f over E_perp.
    nu : float
        Poisson ratio of the paper.
    reading : str
        ``A`` or ``C`` (see :class:`mvest.mechanics.law.PoissonReading`).
    """

    ratio: float
    nu: float = 0.488
    reading: str = "A"

    def __post_init__(self) -> None:
        known = [reading.value for reading in PoissonReading]
        if self.reading not in known:
            raise InputError(
                f"Poisson reading = {self.reading!r}, expected one of {', '.join(known)}"
            )

    def material(self, E_f: float) -> TransverselyIsotropic:
        """The material with Young's modulus ``E_f`` (MPa) along the fibre."""
        return TransverselyIsotropic.from_ratio(
            E_f, self.ratio, self.nu, PoissonReading(self.reading)
        )


@dataclass(frozen=True, slots=True)
class ClosureProtocol:
    """How the valve is closed, and when it is looked at.

    Attributes
    ----------
    pressure_mmHg : float
        Peak transmitral pressure.
    ramp : float
        s over which pressure and boundary motion rise (smooth step).
    dt : float
        s, time step during the ramp. The closed state does not depend on it where it is the only
        one (the gate divides it by up to 16), so that a closure that is wanted for this state alone
        takes the ramp in one step.
    growth : float
        Factor by which steps grow after the ramp, towards equilibrium.
    end : float
        s at which the dynamic phase ends.
    equilibrium : bool
        Whether a static step to exact equilibrium follows.
    """

    pressure_mmHg: float = 120.0
    ramp: float = 0.3
    dt: float = 0.3
    growth: float = 1.5
    end: float = 0.5
    equilibrium: bool = True

    def __post_init__(self) -> None:
        if not self.dt > 0:
            raise InputError(f"time step dt = {self.dt} s, expected > 0")
        if not np.isfinite(self.pressure_mmHg):
            raise InputError(f"pressure {self.pressure_mmHg} mmHg, expected a finite number")
        if not (self.ramp > 0 and self.end >= self.ramp and self.growth >= 1):
            raise InputError(f"closure protocol {self}: expected 0 < ramp <= end and growth >= 1")

    def steps(self) -> tuple[Step, ...]:
        """The time steps."""
        n = max(1, round(self.ramp / self.dt))
        times = [self.ramp * (k + 1) / n for k in range(n)]
        dt = self.ramp / n
        while times[-1] < self.end * (1 - 1e-9):
            dt *= self.growth
            times.append(min(times[-1] + dt, self.end))
        steps = [Step(t) for t in times]
        if self.equilibrium:
            steps.append(Step(times[-1] + 1.0, static=True))
        return tuple(steps)

    def phase(self, t: float) -> float:
        """Share of the closure at time ``t``: quintic smooth step over the ramp."""
        u = min(max(t / self.ramp, 0.0), 1.0)
        return u**3 * (10 - 15 * u + 6 * u * u)


@dataclass(frozen=True, slots=True)
class MechanicsSettings:
    """Everything about the mechanics that is not the valve, the mesh or an unknown.

    Attributes
    ----------
    tissue : dict
        Region name -> :class:`TissueSettings`.
    protocol, damping, newton, contact
        See their classes.
    density : float
        t/mm^3.
    support : str
        ``hinge`` (thickness-averaged annulus) or ``clamp`` (both faces).
    support_stiffness : float
        N/mm per mm of annulus.
    patch_radius : float
        mm over which a chord is spread at its insertion.
    solver : str
    """

    tissue: dict[str, TissueSettings]
    protocol: ClosureProtocol = field(default_factory=ClosureProtocol)
    damping: Damping = field(default_factory=Damping)
    newton: NewtonSettings = field(default_factory=NewtonSettings)
    contact: ContactSettings = field(default_factory=ContactSettings)
    density: float = 1.04e-9
    support: str = "hinge"
    support_stiffness: float = 50.0
    patch_radius: float = 2.0
    solver: str = "auto"

    def __post_init__(self) -> None:
        for name in ("density", "support_stiffness", "patch_radius"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"mechanics {name} = {getattr(self, name)}, expected > 0")
        if self.support not in ("hinge", "clamp"):
            raise InputError(f"annulus support {self.support!r}, expected hinge or clamp")


def build_system(
    valve: Valve,
    contact_valve: Valve,
    mesh: SolidMesh,
    settings: MechanicsSettings,
    moduli: dict[str, float],
    factors: Factors | None = None,
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
        )

    return loading


def _interpolate(phases: FloatArray, frames: FloatArray, phase: float) -> FloatArray:
    """Piecewise monotone cubic between key frames (linear for two)."""
    if len(phases) == 2:
        return (1 - phase) * frames[0] + phase * frames[1]
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(phases, frames, axis=0)(phase))


@dataclass(frozen=True, slots=True, eq=False)
class ClosureResult:
    """A closure with the system it was computed on."""

    system: System
    simulation: Simulation


@dataclass(frozen=True, slots=True, eq=False)
class ClosedState:
    """A closed valve from which further closures may be continued.

    Attributes
    ----------
    at : (p,)
        Its parameters.
    positions : (n, 3) mm
        Of the mesh's nodes.
    guide : ClosedState or None
        That of the model's guide.
    """

    at: FloatArray
    positions: FloatArray
    guide: ClosedState | None = None


@dataclass(eq=False)
class ClosureModel:
    """Predicted positions of the observed vertices as a function of the parameters.

    Attributes
    ----------
    valve : Valve
        Its surface vertices are what is observed.
    contact_valve : Valve
        The same valve where contact is sampled.
    mesh : SolidMesh
    settings : MechanicsSettings
    names : tuple of str
        Names of the parameters (see :class:`mvest.mechanics.system.Parameter`).
    fixed : dict
        Values of the parameters that are not estimated.
    continuation : bool
        Whether closures after the first start from the last closed state and go straight to the new
        equilibrium (where the protocol ends in one), instead of closing the open valve again. The
        closed state is the same as long as there is one only, which the gate (:mod:`mvest.gate`)
        examines.
    reach : float
        Largest change of any parameter's logarithm over which a closure is continued; beyond it
        the valve is closed from the open state. A much softer valve may close in another way, and
        what is continued from there may keep to that way.
    guide : ClosureModel, optional
        The same valve with the same parameters on a coarser mesh. A closure that would start from
        the open valve is followed there, and its closed state is where the equilibrium on this
        mesh is looked for; a guide may have a guide itself. The same closed state comes out, for
        the same reason as with ``continuation``.
    repeat : bool
        Whether a continued or guided closure that fails is repeated from the open valve.
    on_step : callable, optional
        Progress: called with (time, Newton iterations).
    """

    valve: Valve
    contact_valve: Valve
    mesh: SolidMesh
    settings: MechanicsSettings
    names: tuple[str, ...]
    fixed: dict[str, float] = field(default_factory=dict)
    continuation: bool = False
    reach: float = np.inf
    guide: ClosureModel | None = None
    repeat: bool = True
    on_step: Callable[[float, int], None] | None = None

    _closed: ClosedState | None = field(default=None, init=False, repr=False)
    _in_guide: Embedding | None = field(default=None, init=False, repr=False)
    _system: System | None = field(default=None, init=False, repr=False)
    _solver: LinearSolver | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.reach >= 0:
            raise InputError(f"reach of a continuation = {self.reach}, expected >= 0")
        if self.guide is not None and self.guide.names != self.names:
            raise InputError(
                f"the guide's parameters are {', '.join(self.guide.names)}, expected those of the "
                f"model: {', '.join(self.names)}"
            )

    def fresh(self) -> ClosureModel:
        """A model of the same that has not built or closed anything, and tells nobody of steps."""
        guide = None if self.guide is None else self.guide.fresh()
        return replace(self, guide=guide, on_step=None)

    @property
    def closed(self) -> ClosedState | None:
        """The last closed state."""
        if self._closed is None or self.guide is None:
            return self._closed
        return replace(self._closed, guide=self.guide.closed)

    def restart(self, closed: ClosedState | None) -> None:
        """Go on from a closed state of this model, or from the open valve, as if it had just begun.

        What the model computes afterwards depends on ``closed`` and on nothing before, to the last
        bit: also the sparsity pattern and the order of elimination, which follow the contact that
        was met, begin anew.
        """
        self._closed = None if closed is None else replace(closed, guide=None)
        if self._system is not None:
            self._system.forget_contact()
            self._solver = linear_solver(self.settings.solver)
        if self.guide is not None:
            self.guide.restart(None if closed is None else closed.guide)

    def _near(self, m: FloatArray) -> bool:
        """Whether the last closed state is one to continue from to ``m``."""
        if not self.continuation or self._closed is None:
            return False
        if np.isinf(self.reach):
            return True
        if np.any(m <= 0) or np.any(self._closed.at <= 0):
            return False
        return bool(np.max(np.abs(np.log(m / self._closed.at))) <= self.reach)

    def close(
        self, m: FloatArray, *, sensitivities: bool = True, every_frame: bool = False
    ) -> ClosureResult:
        """Run the closure with parameters ``m (p,)``.

        Parameters
        ----------
        m : ndarray
        sensitivities : bool
            Whether the last frame is differentiated.
        every_frame : bool
            Whether all frames are wanted, and not only the last one: they are then solved to the
            full tolerance, and the closure starts from the open valve.

        Raises
        ------
        MaterialError
            If a modulus is inadmissible.
        """
        values = {**self.fixed, **dict(zip(self.names, map(float, m), strict=True))}
        moduli = {k.partition(".")[2]: v for k, v in values.items() if k.startswith("E_f.")}
        factors = Factors(
            values.get("pressure_scale", 1.0),
            values.get("chord_stiffness", 1.0),
            values.get("chord_rest_length", 1.0),
        )
        if self._system is None or self._solver is None:
            self._solver = linear_solver(self.settings.solver)
            self._system = build_system(
                self.valve, self.contact_valve, self.mesh, self.settings, moduli
            )
        system = self._system
        system.retune(material_law(self.mesh, self.settings, moduli), factors)
        steps = self.settings.protocol.steps()
        loading = boundary_loading(system, self.valve, self.contact_valve, self.settings)

        def run(
            steps: Sequence[Step], start: FloatArray | None = None, time: float = 0.0
        ) -> Simulation:
            return simulate(
                system,
                loading,
                steps,
                damping=self.settings.damping,
                newton=self.settings.newton,
                parameters=[Parameter(n, values[n]) for n in self.names] if sensitivities else [],
                final_only=not every_frame,
                solver=self._solver,
                initial_positions=start,
                initial_time=time,
                on_step=self.on_step,
            )

        simulation = None
        if steps[-1].static and not every_frame:
            end, last = self.settings.protocol.end, steps[-1]
            if self._closed is not None and self._near(m):
                simulation = run([last], self._closed.positions, end)
            elif self.guide is not None:
                start = self._guided(self.guide, m)
                if start is not None:
                    rests = [Step(end + t) for t in accumulate(REST)]
                    simulation = run(
                        [*rests, replace(last, time=last.time + sum(REST))], start, end
                    )
        if simulation is None or (self.repeat and not simulation.converged):
            simulation = run(steps)
        if simulation.converged:
            self._closed = ClosedState(np.array(m, dtype=np.float64), simulation.frames[-1])
        return ClosureResult(system, simulation)

    def _guided(self, guide: ClosureModel, m: FloatArray) -> FloatArray | None:
        """The guide's closed state at this mesh's nodes ``(n, 3)``; None if it does not close."""
        simulation = guide.close(m, sensitivities=False).simulation
        if not simulation.converged:
            return None
        if self._in_guide is None:
            self._in_guide = embed(guide.mesh, self.mesh.nodes)
        return self._in_guide(simulation.frames[-1])

    @cached_property
    def observed(self) -> Embedding:
        """The observed vertices embedded in the mesh."""
        return embed(self.mesh, self.valve.surface.vertices)

    def __call__(self, m: FloatArray) -> Prediction:
        """Positions of the observed vertices in the open and the closed frame, and their Jacobian.

        Inadmissible moduli and closures that do not converge are failed predictions, not errors.
        """
        try:
            simulation = self.close(m).simulation
        except MaterialError as error:
            return Prediction.failed(str(error))
        if not simulation.converged:
            return Prediction.failed(
                f"{simulation.reason.value} (t = {simulation.times[-1]:.3f} s)"
            )
        open_, closed = self.observed(self.mesh.nodes), self.observed(simulation.frames[-1])
        derivative = np.stack([self.observed(dx) for dx in simulation.sensitivities[-1]], axis=-1)
        y = np.concatenate([open_.ravel(), closed.ravel()])
        jacobian = np.concatenate(
            [np.zeros((open_.size, len(self.names))), derivative.reshape(-1, len(self.names))]
        )
        return Prediction(y, jacobian)
