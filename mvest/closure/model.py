"""Moduli in, closed valve and its derivative out: the model that a filter sees.

``ClosureModel`` predicts the observed vertices from the parameters of valve and mechanics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import accumulate

import numpy as np

from mvest.closure.continuation import SPACING, ClosedState, Coordinates
from mvest.errors import GeometryError, InputError, MaterialError
from mvest.estimation.prediction import Prediction
from mvest.mechanics.forces.cables import TiedPoints
from mvest.mechanics.integrate import simulate
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import MechanicsSettings, Relaxation, TissueSettings
from mvest.mechanics.solver import LinearSolver, linear_solver
from mvest.mechanics.steps import Damping, Simulation, Step
from mvest.mechanics.system import Loads, System
from mvest.mechanics.valve_system import (
    HeldState,
    boundary_loading,
    build_system,
    held_loading,
    retune,
)
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh, embed

CONTINUED = 40
"""Newton iterations after which a guided valve stops searching for its next equilibrium and is
closed by its guide. If moduli change by 30 %, ``hex18`` needs 4 to 11 and linear tetrahedra up to
32, a third of the guide's cost. Diverging iterations (160 x 19 cells) would never end."""

REST = (0.05, 0.15)
"""s, time steps in which a state from another mesh comes to rest under the final loads. Damping
restrains motions that the coarser mesh could not resolve. Without it, large meshes (160 x 19 cells)
find no equilibrium from there."""


def _resting(start: float, end: float) -> list[Step]:
    """Resting steps from ``start`` s, then an equilibrium equally long after ``end`` s."""
    return [*(Step(start + t) for t in accumulate(REST)), Step(end + sum(REST), static=True)]


def failure_of(simulation: Simulation) -> str:
    """Describe why and when a simulation failed."""
    return f"{simulation.reason.value} (t = {simulation.times[-1]:.3f} s)"


@dataclass(frozen=True, slots=True, eq=False)
class ClosureResult:
    """A closure, with the system on which it was computed."""

    system: System
    simulation: Simulation


@dataclass(eq=False)
class ClosureModel:
    """Predicted positions of the observed vertices as a function of the parameters."""

    valve: Valve  #: its surface vertices are observed
    contact_valve: Valve  #: the same valve where contact is sampled
    mesh: SolidMesh
    settings: MechanicsSettings
    #: names of the parameters (see :class:`mvest.mechanics.parameters.Parameter`)
    names: tuple[str, ...]
    #: values of the parameters that are not estimated
    fixed: dict[str, float] = field(default_factory=dict)
    #: whether a closure starts from the last closed state, extrapolated with its derivatives if
    #: known, and goes straight to the new equilibrium. Otherwise each closure starts from the open
    #: valve. Both give the same closed state if it is unique; the gate
    #: (:mod:`mvest.closure.robustness`) tests this.
    continuation: bool = False
    #: largest change of a coordinate (:class:`mvest.closure.continuation.Coordinates`) over which a
    #: closure is continued. Beyond it the valve closes from the open state, because a much softer
    #: valve may fold differently.
    reach: float = np.inf
    #: the same valve and parameters on a coarser mesh. A closure that would start from the open
    #: valve is computed there first; its closed state is the starting point for the equilibrium on
    #: this mesh. A guide may have a guide. Without `repeat` it does not lead.
    guide: ClosureModel | None = None
    #: whether a failed continued closure is repeated with the guide, and then from the open valve,
    #: which takes long and seldom succeeds
    repeat: bool = True
    #: largest change of a coordinate between continued equilibria. A more distant state is reached
    #: in several steps, because Newton's method does not find equilibria millimetres away.
    largest_change: float = np.inf
    #: whether a continued valve without a nearby closed state first closes at rounded parameters
    #: (:meth:`mvest.closure.continuation.Coordinates.rounded`). All estimates of a valve with
    #: similar starting values then begin from the same closed state.
    rounded_start: bool = False
    #: progress: called with (time, Newton iterations)
    on_step: Callable[[float, int], None] | None = None
    #: pairs of points held together while the valve closes, as by a clip
    ties: TiedPoints | None = None
    #: (n, 3) mm, optional, initial displacement of the nodes of the open valve
    perturbation: FloatArray | None = None
    #: the strain of the relaxed shape, and what it was computed with
    relaxed: tuple[MechanicsSettings, SolidMesh, FloatArray] | None = field(
        default=None, repr=False
    )

    _closed: ClosedState | None = field(default=None, init=False, repr=False)
    _system: System | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.reach >= 0:
            raise InputError(f"reach of a continuation = {self.reach}, expected >= 0")
        if not self.largest_change > 0:
            raise InputError(f"largest_change = {self.largest_change}, expected > 0")
        if self.guide is not None and self.guide.names != self.names:
            raise InputError(
                f"the guide's parameters are {', '.join(self.guide.names)}, expected those of the "
                f"model: {', '.join(self.names)}"
            )

    def fresh(self) -> ClosureModel:
        """A copy that has built and closed nothing yet, without a progress callback."""
        guide = None if self.guide is None else self.guide.fresh()
        return replace(self, guide=guide, on_step=None)

    @property
    def contact_reach_mm(self) -> float:
        """Distance between midsurfaces at the free edge within which contact acts."""
        edge = float(self.valve.surface.thickness[self.valve.free_edge].mean())
        return self.settings.contact.activation_distance * edge

    @cached_property
    def observed(self) -> Embedding:
        """The observed vertices embedded in the mesh."""
        return embed(self.mesh, self.valve.surface.vertices)

    @cached_property
    def solver(self) -> LinearSolver:
        """The linear solver of the system."""
        return linear_solver(self.settings.solver)

    @cached_property
    def _coordinates(self) -> Coordinates:
        return Coordinates.of(self.names, self.settings)

    def _values(self, m: FloatArray) -> dict[str, float]:
        """Values of all parameters, fixed ones included."""
        return {**self.fixed, **dict(zip(self.names, map(float, m), strict=True))}

    def damping(self, m: FloatArray) -> Damping:
        """The damping at parameters ``m (p,)``; it may be one of them."""
        own = self.settings.damping
        return replace(own, beta=self._values(m).get("damping", own.beta))

    def tuned(self, m: FloatArray) -> tuple[System, tuple[Parameter, ...]]:
        """The system at parameters ``m (p,)``, and the parameters for derivatives.

        The system is built once and belongs to the model.

        MaterialError if a modulus is inadmissible, or a parameter not finite.
        """
        for name, value in zip(self.names, m, strict=True):
            if not np.isfinite(value):
                raise MaterialError(f"{name} = {value}, expected a finite number")
        values = self._values(m)
        if self._system is None:
            self._system = build_system(
                self.valve,
                self.contact_valve,
                self.mesh,
                self.settings,
                values,
                ties=self.ties,
                relaxed=self._relaxed(),
            )
        retune(self._system, self.settings, values)
        return self._system, tuple(Parameter(n, values[n]) for n in self.names)

    def _relaxed(self) -> FloatArray | None:
        """Strain ``(e, q, 6)`` of the valve of `Relaxation`; None if open leaflets have no stress.

        Raises a MaterialError if that valve does not close.
        """
        relaxation = self.settings.relaxation
        if relaxation is None:
            return None
        plain, end, known = self._linear(relaxation), self.contact_valve.motion, self.relaxed
        if known is not None and known[0] == plain.settings and known[1] is self.mesh:
            return known[2]
        at = np.array(list(relaxation.E_f.values()))
        state = HeldState(relaxation.pressure_mmHg, end.annulus[-1], end.papillary_tips[-1])
        last = plain.rests(at, [state])[-1]
        if not last.converged:
            raise MaterialError(f"relaxation: the valve does not close: {failure_of(last)}")
        solid = plain.tuned(at)[0].solid
        green = solid.evaluate(last.frames[-1], solid.initial_strain(), 0.0).green
        self.relaxed = plain.settings, self.mesh, green
        return green

    def _linear(self, relaxation: Relaxation) -> ClosureModel:
        """The same valve with linear tissue that is free of stress when open."""
        tissue = self.settings.tissue.items()
        settings = replace(
            self.settings,
            relaxation=None,
            protocol=replace(self.settings.protocol, equilibrium=True, curve=()),
            tissue={r: TissueSettings(t.ratio, t.nu, reading=t.reading) for r, t in tissue},
        )
        return replace(
            self.fresh(),
            settings=settings,
            names=tuple(f"E_f.{region}" for region in relaxation.E_f),
            fixed={},
            guide=None if self.guide is None else self.guide._linear(relaxation),
            ties=None,
        )

    @property
    def closed(self) -> ClosedState | None:
        """The last closed state."""
        if self._closed is None or self.guide is None:
            return self._closed
        return replace(self._closed, guide=self.guide.closed)

    def restart(self, closed: ClosedState | None) -> None:
        """Forget everything but ``closed``, from which the next closure may be continued.

        Later results then depend only on ``closed``, to the last bit: the sparsity pattern and the
        elimination order, which depend on earlier contact, are reset.
        """
        self._closed = None if closed is None else replace(closed, guide=None)
        if self._system is not None:
            self._system.forget_contact()
            self.__dict__.pop("solver", None)
        if self.guide is not None:
            self.guide.restart(None if closed is None else closed.guide)

    def _near(self, m: FloatArray) -> bool:
        """Whether a closure with ``m`` is continued from the last closed state."""
        return (
            self.continuation
            and self._closed is not None
            and self._coordinates.distance(self._closed.at, m) <= self.reach
        )

    def _way_to(self, m: FloatArray) -> list[FloatArray]:
        """Intermediate parameters from the last closed state to ``m``, if continued from there."""
        if self._closed is None or not self._near(m):
            return []
        return self._coordinates.between(self._closed.at, m, self.largest_change)

    def close(
        self, m: FloatArray, *, sensitivities: bool = True, every_frame: bool = False
    ) -> ClosureResult:
        """Run the closure with parameters ``m (p,)``.

        MaterialError if a modulus is inadmissible.

        Parameters
        ----------
        m : ndarray
        sensitivities : bool
            Whether the last frame is differentiated.
        every_frame : bool
            Whether all frames are needed, not only the last. They are then solved to the full
            tolerance, and the closure starts from the open valve.
        """
        if every_frame:
            return self._close(m, sensitivities, every_frame=True)
        rounded = self._close_rounded(m)
        stiffens = np.array([name.startswith("stiffening.") for name in self.names], dtype=bool)
        continued = self.continuation and self.settings.protocol.equilibrium
        if continued and np.any(m[stiffens] > 0.0) and not self._near(m):
            # Linear tissue reaches the same equilibrium six times as fast.
            self._close(np.where(stiffens, 0.0, m))
        for between in self._way_to(m):
            result = self._close(between)
            if not result.simulation.converged:
                break
        else:
            result = self._close(m, sensitivities)
        if rounded and not result.simulation.converged:
            self.restart(None)
            result = self._close(m, sensitivities)
        return result

    def _close_rounded(self, m: FloatArray) -> bool:
        """Close the valve at rounded parameters if no closed state is near; return success."""
        steady = self.continuation and self.settings.protocol.equilibrium
        if not (self.rounded_start and steady) or self._near(m):
            return False
        self.tuned(m)  # raises on inadmissible parameters before closing anything
        at = self._coordinates.rounded(m)
        if not self._coordinates.distance(at, m) <= min(self.reach, SPACING):
            return False
        self.restart(None)
        try:
            closes = self._close(at).simulation.converged
        except MaterialError:
            closes = False
        self.restart(self._closed if closes else None)
        return closes

    def _close(
        self, m: FloatArray, sensitivities: bool = True, *, every_frame: bool = False
    ) -> ClosureResult:
        """One closure, from the last closed state, from the guide's or from the open valve."""
        system, parameters = self.tuned(m)
        newton, steps = self.settings.newton, self.settings.protocol.steps()
        end = self.settings.protocol.end
        run = partial(
            simulate,
            system,
            boundary_loading(system, self.valve, self.contact_valve, self.settings),
            damping=self.damping(m),
            newton=newton,
            parameters=parameters if sensitivities else (),
            final_only=not every_frame,
            solver=self.solver,
            on_step=self.on_step,
        )

        def unsettled(simulation: Simulation | None) -> bool:
            return simulation is None or (self.repeat and not simulation.converged)

        simulation = None
        straight = steps[-1].static and not every_frame
        if straight and self._closed is not None and self._near(m):
            soon = newton
            if self.guide is not None and self.repeat:
                soon = replace(newton, max_iterations=min(newton.max_iterations, CONTINUED))
            expected = self._coordinates.expected_move(self._closed, m)
            for move in (None,) if expected is None else (expected, None):
                simulation = run(
                    steps[-1:],
                    newton=soon,
                    initial_positions=self._closed.positions,
                    initial_move=move,
                    initial_time=end,
                )
                if simulation.converged:
                    break
        guide = self.guide if straight and self.repeat and unsettled(simulation) else None
        if guide is not None and self._in_guide is not None:
            coarse = guide.close(m, sensitivities=False).simulation
            if coarse.converged:
                simulation = run(
                    _resting(end, steps[-1].time),
                    initial_positions=self._in_guide(coarse.frames[-1]),
                    initial_time=end,
                )
        if simulation is None or unsettled(simulation):
            start = None if self.perturbation is None else self.mesh.nodes + self.perturbation
            simulation = run(steps, initial_positions=start)
        if simulation.converged:
            slopes = simulation.sensitivities[-1] if sensitivities else None
            at = np.array(m, dtype=np.float64)
            self._closed = ClosedState(at, simulation.frames[-1], slopes=slopes)
        return ClosureResult(system, simulation)

    @cached_property
    def _in_guide(self) -> Embedding | None:
        """The mesh's nodes embedded in the guide's mesh; None if its cells do not contain them."""
        assert self.guide is not None
        try:
            return embed(self.guide.mesh, self.mesh.nodes)
        except GeometryError:
            return None

    def rests(
        self,
        m: FloatArray,
        states: Sequence[HeldState],
        *,
        sensitivities: bool = False,
        start: FloatArray | None = None,
    ) -> list[Simulation]:
        """Compute the closure, then one equilibrium after another until one fails.

        InputError if a state's annulus or tips are not those of the valve. MaterialError if a
        modulus is inadmissible.

        Parameters
        ----------
        m : (p,)
        states : sequence of HeldState
            Loads of the equilibria after the closed one.
        sensitivities : bool
            Whether all of them are differentiated.
        start : (n, 3) mm, optional
            Nodal positions, for example of a closed valve of other tissue, that are brought to rest
            under the final loads to find the closed state.
        """
        system, parameters = self.tuned(m)
        if not sensitivities:
            parameters = ()
        if start is None:
            ends = [self.close(m, sensitivities=sensitivities).simulation]
        else:
            loading = boundary_loading(system, self.valve, self.contact_valve, self.settings)
            ends = [self._rest(loading, start, parameters, damped=True)]
        for state in states:
            if not ends[-1].converged:
                break
            loading = held_loading(system, self.contact_valve, state)
            ends.append(self._rest(loading, ends[-1].frames[-1], parameters))
        return ends

    def _rest(
        self,
        loading: Callable[[float], Loads],
        start: FloatArray,
        parameters: Sequence[Parameter],
        *,
        damped: bool = False,
    ) -> Simulation:
        """Equilibrium under constant loads from nodal positions ``start (n, 3)``.

        Solved directly; if that fails, or if ``damped``, solved after some time steps, whose
        damping helps leaflets slide over each other.
        """
        assert self._system is not None
        end = self.settings.protocol.end
        run = partial(
            simulate,
            self._system,
            loading,
            damping=self.settings.damping,
            newton=self.settings.newton,
            parameters=parameters,
            final_only=True,
            solver=self.solver,
            initial_positions=start,
            initial_time=end,
        )
        if not damped:
            simulation = run([Step(end + 1.0, static=True)])
            if simulation.converged:
                return simulation
        return run(_resting(end, end + 1.0))

    def held(self, m: FloatArray, states: Sequence[HeldState]) -> list[FloatArray | None]:
        """Observed vertices ``(n, 3)`` mm in the equilibria under other loads; see `rests`.

        The first state without an equilibrium, and all after it, give None.
        """
        ends = [end for end in self.rests(m, states)[1:] if end.converged]
        frames: list[FloatArray | None] = [self.observed(end.frames[-1]) for end in ends]
        return frames + [None] * (len(states) - len(frames))

    def predict_held(self, m: FloatArray, states: Sequence[HeldState]) -> list[Prediction]:
        """Predictions of the closed valve and of its equilibria under other loads; see `rests`.

        The list ends with the first failed prediction, if any.
        """
        try:
            ends = self.rests(m, states, sensitivities=True)
        except MaterialError as error:
            return [Prediction.failed(str(error))]
        return [
            Prediction(
                self.observed(end.frames[-1]).ravel(),
                np.stack([self.observed(dx).ravel() for dx in end.sensitivities[-1]], axis=1),
            )
            if end.converged
            else Prediction.failed(failure_of(end))
            for end in ends
        ]

    def __call__(self, m: FloatArray) -> Prediction:
        """Positions of the observed vertices in the open and the closed frame, and their Jacobian.

        Inadmissible moduli and closures that do not converge give failed predictions, not errors.
        """
        (closed,) = self.predict_held(m, ())
        if not closed.converged:
            return closed
        open_ = self.observed(self.mesh.nodes).ravel()
        still = np.zeros((len(open_), len(self.names)))
        return Prediction(
            np.concatenate([open_, closed.y]), np.concatenate([still, closed.jacobian])
        )
