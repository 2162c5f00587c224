"""The joint of valve and mechanics: moduli in, geometry of the leaflets and its derivative out.

``ClosureModel`` is what a filter sees: a function from parameters to predicted positions and their
Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from mvest.cache import source_key
from mvest.closure.anchors import SPACING, ClosedState, Coordinates, cached_state, content_digest
from mvest.errors import GeometryError, InputError, MaterialError
from mvest.estimation.prediction import Prediction
from mvest.mechanics.forces.cables import TiedPoints
from mvest.mechanics.integrate import simulate
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import MechanicsSettings
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
"""Newton iterations within which a closed valve finds its next equilibrium, or is closed anew by
its guide: with moduli that change by 30 % they are 4 to 11 of ``hex18`` and up to 32 of linear
tetrahedra, a third of what the guide takes; where they run away (160 x 19 cells) they never end."""

REST = (0.05, 0.15)
"""s, steps of time in which a state taken over from another mesh comes to rest under the final
loads. Damping by stiffness holds what the coarser mesh could not tell; without it the equilibrium
of large meshes (160 x 19 cells) is not found from there."""


def _resting(start: float, end: float) -> list[Step]:
    """Steps of a rest from ``start`` s, and to an equilibrium as long after it as ``end`` is."""
    return [*(Step(start + t) for t in accumulate(REST)), Step(end + sum(REST), static=True)]


def failure_of(simulation: Simulation) -> str:
    """Why and when a simulation failed."""
    return f"{simulation.reason.value} (t = {simulation.times[-1]:.3f} s)"


@dataclass(frozen=True, slots=True, eq=False)
class ClosureResult:
    """A closure with the system it was computed on."""

    system: System
    simulation: Simulation


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
        Whether closures after the first start from the last closed state, or where its derivatives
        expect the next one, and go straight to the new equilibrium. Otherwise each starts from the
        open valve. Both give the same closed state if there is only one, which the gate
        (:mod:`mvest.closure.robustness`) examines.
    reach : float
        Largest change of a coordinate (:class:`mvest.closure.anchors.Coordinates`) over which a
        closure is continued; beyond it the valve is closed anew. A much softer valve may close in
        another way, and a continuation from there may keep to that way.
    guide : ClosureModel, optional
        The same valve and parameters on a coarser mesh. A closure that would start from the open
        valve is computed there first, and its closed state is where the equilibrium on this mesh is
        sought. A guide may have a guide.
    repeat : bool
        Whether a continued closure that fails is repeated with the guide, and one that fails with
        the guide from the open valve, which takes long and seldom succeeds.
    largest_change : float
        Largest change of a coordinate from one continued equilibrium to the next; a state farther
        away is reached through others. Newton's method does not find equilibria millimetres away.
    on_step : callable, optional
        Progress: called with (time, Newton iterations).
    ties : TiedPoints, optional
        Pairs of points that are held together while the valve closes, as by a clip.
    anchors : Path, optional
        Folder of cached closed states (:mod:`mvest.closure.anchors`). With ``continuation``, a
        closure that would start from the open valve is continued from one of them.
    perturbation : (n, 3) mm, optional
        Initial displacement of the nodes of the open valve.
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
    largest_change: float = np.inf
    on_step: Callable[[float, int], None] | None = None
    ties: TiedPoints | None = None
    anchors: Path | None = None
    perturbation: FloatArray | None = None

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
        """The same model before it has built or closed anything, without a progress callback."""
        guide = None if self.guide is None else self.guide.fresh()
        return replace(self, guide=guide, on_step=None)

    @property
    def closed(self) -> ClosedState | None:
        """The last closed state."""
        if self._closed is None or self.guide is None:
            return self._closed
        return replace(self._closed, guide=self.guide.closed)

    @property
    def contact_reach_mm(self) -> float:
        """Distance of midsurfaces at the free edge within which contact acts."""
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

    def restart(self, closed: ClosedState | None) -> None:
        """Forget everything but ``closed``, from which the next closure may be continued.

        Later results depend on ``closed`` and on nothing before, to the last bit: the sparsity
        pattern and the order of elimination, which follow the contact that was met, begin anew.
        """
        self._closed = None if closed is None else replace(closed, guide=None)
        if self._system is not None:
            self._system.forget_contact()
            self.__dict__.pop("solver", None)
        if self.guide is not None:
            self.guide.restart(None if closed is None else closed.guide)

    def _near(self, m: FloatArray) -> bool:
        """Whether the last closed state is one to continue from to ``m``."""
        return self._closed is not None and self._within_reach(self._closed.at, m)

    def _within_reach(self, start: FloatArray, m: FloatArray) -> bool:
        everywhere = np.isinf(self.reach)
        return self.continuation and (
            everywhere or self._coordinates.distance(start, m) <= self.reach
        )

    def _way_to(self, m: FloatArray) -> list[FloatArray]:
        """Parameters between the last closed state and ``m``, if it is continued from."""
        if np.isinf(self.largest_change) or self._closed is None or not self._near(m):
            return []
        return self._coordinates.between(self._closed.at, m, self.largest_change)

    def _unstiffened(self, m: FloatArray) -> FloatArray | None:
        """Parameters ``(p,)`` of linear tissue, from which ``m`` is gone to; None if not needed.

        Tissue that stiffens takes six times as long to close from the open valve, and leads to the
        same equilibrium.
        """
        stiffens = np.array([name.startswith("stiffening.") for name in self.names], dtype=bool)
        if not (self.continuation and self.settings.protocol.equilibrium) or self._near(m):
            return None
        return np.where(stiffens, 0.0, m) if np.any(m[stiffens] > 0.0) else None

    def _begin_at_anchor(self, m: FloatArray) -> bool:
        """Go to the cached closed state that belongs to ``m`` if there is none to continue from."""
        if self.anchors is None or not self.settings.protocol.equilibrium or self._near(m):
            return False
        self.tuned(m)  # refuses inadmissible parameters before anything is closed
        own = self._coordinates(m)
        if own is None:
            return False
        point = np.round(own / SPACING)
        at = self._coordinates.parameters(point * SPACING)
        if not self._within_reach(at, m):
            return False
        found = cached_state(self.anchors, self._digest(), point, at, lambda: self._anchor(at))
        # In any case as if it had been read: the result does not depend on which process made it.
        self.restart(found)
        return found is not None

    def _anchor(self, at: FloatArray) -> ClosedState | None:
        """The closed state at ``at (p,)``, from the open valve and with nothing remembered."""
        self.restart(None)
        try:
            closes = self._close(at).simulation.converged
        except MaterialError:
            return None
        return self._closed if closes else None

    def _digest(self) -> str:
        """Of all that decides a closed state besides the parameters."""
        guide = "" if self.guide is None else self.guide._digest()
        return content_digest(
            self.valve, self.contact_valve, self.mesh, self.settings, self.names, self.fixed,
            self.ties, self.repeat, guide, self.perturbation, source_key(ClosureModel),
        )  # fmt: skip

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
        if every_frame:
            return self._close(m, sensitivities, every_frame=True)
        anchored = self._begin_at_anchor(m)
        linear = self._unstiffened(m)
        if linear is not None:
            self._close(linear)
        for between in self._way_to(m):
            result = self._close(between)
            if not result.simulation.converged:
                break
        else:
            result = self._close(m, sensitivities)
        if anchored and not result.simulation.converged:
            # As if nothing had been cached.
            self.restart(None)
            result = self._close(m, sensitivities)
        return result

    def _close(
        self, m: FloatArray, sensitivities: bool = True, *, every_frame: bool = False
    ) -> ClosureResult:
        """One closure, from the last closed state, from the guide's or from the open valve."""
        system, parameters = self.tuned(m)
        newton, steps = self.settings.newton, self.settings.protocol.steps()
        end = self.settings.protocol.end
        run = partial(
            self._run,
            loading=boundary_loading(system, self.valve, self.contact_valve, self.settings),
            damping=self.damping(m),
            parameters=parameters if sensitivities else [],
            final_only=not every_frame,
            on_step=self.on_step,
        )
        simulation = None
        straight = steps[-1].static and not every_frame
        if straight and self._closed is not None and self._near(m):
            soon = newton
            if self.guide is not None and self.repeat:
                # If the equilibrium is not found soon, the guide finds it sooner.
                soon = replace(newton, max_iterations=min(newton.max_iterations, CONTINUED))
            expected = self._coordinates.expected_move(self._closed, m)
            for move in (None,) if expected is None else (expected, None):
                simulation = run(
                    steps[-1:],
                    self._closed.positions,
                    newton=soon,
                    initial_move=move,
                    initial_time=end,
                )
                if simulation.converged:
                    break
        if straight and self.guide is not None and self._unsettled(simulation):
            guided = self._guided(self.guide, m)
            if guided is not None:
                simulation = run(_resting(end, steps[-1].time), guided, initial_time=end)
        if simulation is None or self._unsettled(simulation):
            # From the open valve.
            start = None if self.perturbation is None else self.mesh.nodes + self.perturbation
            simulation = run(steps, start)
        if simulation.converged:
            slopes = simulation.sensitivities[-1] if sensitivities else None
            at = np.array(m, dtype=np.float64)
            self._closed = ClosedState(at, simulation.frames[-1], slopes=slopes)
        return ClosureResult(system, simulation)

    def _run(
        self,
        steps: Sequence[Step],
        start: FloatArray | None,
        *,
        loading: Callable[[float], Loads],
        **options: Any,
    ) -> Simulation:
        """Time steps of the system from nodal positions ``start (n, 3)``; None: the open valve."""
        assert self._system is not None
        options = {"newton": self.settings.newton, **options, "initial_positions": start}
        return simulate(self._system, loading, steps, solver=self.solver, **options)

    def _unsettled(self, simulation: Simulation | None) -> bool:
        """Whether a closure is yet to be tried, or to be repeated in another way."""
        return simulation is None or (self.repeat and not simulation.converged)

    @cached_property
    def _in_guide(self) -> Embedding | None:
        """The mesh's nodes in the guide's mesh; None if its coarse cells do not hold them."""
        assert self.guide is not None
        try:
            return embed(self.guide.mesh, self.mesh.nodes)
        except GeometryError:
            return None

    def _guided(self, guide: ClosureModel, m: FloatArray) -> FloatArray | None:
        """The guide's closed state at this mesh's nodes ``(n, 3)``; None without one."""
        if self._in_guide is None:
            return None
        simulation = guide.close(m, sensitivities=False).simulation
        return self._in_guide(simulation.frames[-1]) if simulation.converged else None

    def _values(self, m: FloatArray) -> dict[str, float]:
        """All parameters that have a value, those that are not estimated included."""
        return {**self.fixed, **dict(zip(self.names, map(float, m), strict=True))}

    def damping(self, m: FloatArray) -> Damping:
        """The damping with parameters ``m (p,)``, of which it may be one."""
        own = self.settings.damping
        return replace(own, beta=self._values(m).get("damping", own.beta))

    def tuned(self, m: FloatArray) -> tuple[System, tuple[Parameter, ...]]:
        """The system, set to parameters ``m (p,)``, and the parameters to differentiate by.

        The system is built once and belongs to the model.

        Raises
        ------
        MaterialError
            If a modulus is inadmissible.
        """
        values = self._values(m)
        if self._system is None:
            self._system = build_system(
                self.valve, self.contact_valve, self.mesh, self.settings, values, ties=self.ties
            )
        retune(self._system, self.settings, values)
        return self._system, tuple(Parameter(n, values[n]) for n in self.names)

    def held(self, m: FloatArray, states: Sequence[HeldState]) -> list[FloatArray | None]:
        """Observed vertices ``(n, 3)`` mm of the closed valve in equilibria under other loads.

        The valve is closed with parameters ``m (p,)`` and goes from one state to the next. From the
        first state without an equilibrium on, the result is None.

        Raises
        ------
        InputError
            If a state's annulus or tips are not those of the valve.
        MaterialError
            If a modulus is inadmissible.
        """
        ends = [end for end in self.rests(m, states)[1:] if end.converged]
        frames: list[FloatArray | None] = [self.observed(end.frames[-1]) for end in ends]
        return frames + [None] * (len(states) - len(frames))

    def predict_held(self, m: FloatArray, states: Sequence[HeldState]) -> list[Prediction]:
        """The closed valve and its equilibria under other loads, as `held`, with derivatives.

        The last prediction is the first that fails, if one does.
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

    def rests(
        self,
        m: FloatArray,
        states: Sequence[HeldState],
        *,
        sensitivities: bool = False,
        start: FloatArray | None = None,
    ) -> list[Simulation]:
        """The closure and the ways from one state to the next, up to the first that fails.

        As `held`, not yet embedded. With nodal positions ``start (n, 3)``, as of a closed valve of
        other tissue, the closed state is where that comes to rest under the final loads.
        """
        parameters = self.tuned(m)[1] if sensitivities else ()
        if start is None:
            closure = self.close(m, sensitivities=sensitivities)
            system, first = closure.system, closure.simulation
        else:
            system = self.tuned(m)[0]
            loading = boundary_loading(system, self.valve, self.contact_valve, self.settings)
            first = self._rest(loading, start, parameters, damped=True)
        ends = [first]
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
        parameters: Sequence[Parameter] = (),
        *,
        damped: bool = False,
    ) -> Simulation:
        """Equilibrium under constant loads from nodal positions ``start (n, 3)``.

        It is sought at once, or, where that fails or ``damped``, after some steps of time.
        """
        end = self.settings.protocol.end
        run = partial(
            self._run,
            start=start,
            loading=loading,
            damping=self.settings.damping,
            parameters=parameters,
            final_only=True,
            initial_time=end,
        )
        if not damped:
            simulation = run([Step(end + 1.0, static=True)])
            if simulation.converged:
                return simulation
        # Damping by stiffness helps leaflets to slide over each other to where they are held.
        return run(_resting(end, end + 1.0))

    def __call__(self, m: FloatArray) -> Prediction:
        """Positions of the observed vertices in the open and the closed frame, and their Jacobian.

        Inadmissible moduli and closures that do not converge are failed predictions, not errors.
        """
        (closed,) = self.predict_held(m, ())
        if not closed.converged:
            return closed
        open_ = self.observed(self.mesh.nodes).ravel()
        still = np.zeros((len(open_), len(self.names)))
        return Prediction(
            np.concatenate([open_, closed.y]), np.concatenate([still, closed.jacobian])
        )
