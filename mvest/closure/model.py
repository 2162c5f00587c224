"""The joint of valve and mechanics: moduli in, geometry of the leaflets and its derivative out.

``ClosureModel`` is what a filter sees: a function from parameters to predicted positions and their
Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import accumulate

import numpy as np

from mvest.cache import source_key
from mvest.closure.anchors import NOT_FOUND, Anchors, Coordinates, Kept, content_digest
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
    slopes : (p, n, 3) mm or None
        Derivatives of the positions by the parameters, if they are known.
    """

    at: FloatArray
    positions: FloatArray
    guide: ClosedState | None = None
    slopes: FloatArray | None = None


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
        Whether closures after the first start from the last closed state (where its derivatives
        expect the next one, if it has been differentiated) and go straight to the new equilibrium
        (where the protocol ends in one), instead of closing the open valve again. The
        closed state is the same as long as there is one only, which the gate
        (:mod:`mvest.closure.robustness`) examines.
    reach : float
        Largest change of any parameter's logarithm (of a field's coefficient: times its standard
        deviation of log E_f) over which a closure is continued; beyond it the valve is closed from
        the open state. A much softer valve may close in another way, and what is continued from
        there may keep to that way.
    guide : ClosureModel, optional
        The same valve with the same parameters on a coarser mesh. A closure that would start from
        the open valve is followed there, and its closed state is where the equilibrium on this
        mesh is looked for; a guide may have a guide itself. The same closed state comes out, for
        the same reason as with ``continuation``.
    repeat : bool
        Whether a continued closure that fails is repeated with the guide, and one that fails with
        the guide from the open valve, which takes long and seldom finds what the others did not.
    largest_change : float
        Of any parameter, measured as for ``reach``, from one continued equilibrium to the next: one
        farther away is reached through others between. Newton's method does not find an equilibrium
        that lies millimetres away.
    on_step : callable, optional
        Progress: called with (time, Newton iterations).
    ties : TiedPoints, optional
        Pairs of points that are held together while the valve closes, as by a clip.
    anchors : Anchors, optional
        Where closed states of this and other models are kept. With ``continuation``, a closure that
        would start from the open valve is continued from the one that belongs to its parameters.
    perturbation : (n, 3) mm, optional
        By how much the nodes of the open valve are displaced before they are let go.
    closures : int
        How many closed states have been looked for, those between others included, anchors not.
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
    anchors: Anchors | None = None
    perturbation: FloatArray | None = None

    closures: int = field(default=0, init=False)
    _closed: ClosedState | None = field(default=None, init=False, repr=False)
    _in_guide: Embedding | None = field(default=None, init=False, repr=False)
    _system: System | None = field(default=None, init=False, repr=False)
    _solver: LinearSolver | None = field(default=None, init=False, repr=False)

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
        """A model of the same that has not built or closed anything, and tells nobody of steps."""
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
        return self._closed is not None and self._within_reach(self._closed.at, m)

    def _within_reach(self, start: FloatArray, m: FloatArray) -> bool:
        if not self.continuation or np.isinf(self.reach):
            return self.continuation
        change = self._coordinates.change(start, m)
        return change is not None and bool(np.max(np.abs(change)) <= self.reach)

    @cached_property
    def _coordinates(self) -> Coordinates:
        return Coordinates.of(self.names, self.settings)

    def _expected_move(self, m: FloatArray) -> FloatArray | None:
        """By how much ``(n, 3)`` mm the last closed state is expected to move; None if unknown."""
        closed, coordinates = self._closed, self._coordinates
        if closed is None or closed.slopes is None:
            return None
        change = coordinates.change(closed.at, m)
        if change is None:
            return None
        return np.tensordot(coordinates.rates(closed.at) * change, closed.slopes, 1)

    def _way_to(self, m: FloatArray) -> list[FloatArray]:
        """Parameters between the last closed state and ``m``, where that is continued from."""
        if np.isinf(self.largest_change) or self._closed is None or not self._near(m):
            return []
        start, end = self._coordinates(self._closed.at), self._coordinates(m)
        if start is None or end is None:
            return []
        n = int(np.ceil(float(np.abs(end - start).max()) / self.largest_change))
        return [self._coordinates.parameters(start + (end - start) * k / n) for k in range(1, n)]

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
        """Go to the kept closed state that belongs to ``m``, if there is none to continue from."""
        anchors = self.anchors
        if anchors is None or not self.settings.protocol.equilibrium or self._near(m):
            return False
        self.tuned(m)  # refuses what is inadmissible before anything is closed
        at = self._coordinates(m)
        if at is None:
            return False
        place = np.round(at / anchors.spacing)
        anchor = self._coordinates.parameters(place * anchors.spacing)
        if not self._within_reach(anchor, m):
            return False
        kept = anchors.get_or_make(self._digest(), place, lambda: self._anchor(anchor))
        found = len(kept.positions) > 0
        # In any case as if it had been read: what follows does not depend on who has made it.
        self.restart(ClosedState(anchor, kept.positions, slopes=kept.slopes) if found else None)
        return found

    def _anchor(self, at: FloatArray) -> Kept:
        """The closed state at ``at (p,)``, from the open valve and with nothing remembered."""
        self.restart(None)
        try:
            simulation = self._close(at).simulation
        except MaterialError:
            return NOT_FOUND
        if not simulation.converged:
            return NOT_FOUND
        return Kept(simulation.frames[-1], simulation.sensitivities[-1])

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
            return self._counted(m, sensitivities, every_frame=True)
        anchored = self._begin_at_anchor(m)
        linear = self._unstiffened(m)
        if linear is not None:
            self._counted(linear)
        for between in self._way_to(m):
            result = self._counted(between)
            if not result.simulation.converged:
                break
        else:
            result = self._counted(m, sensitivities)
        if anchored and not result.simulation.converged:
            # As if nothing had been kept.
            self.restart(None)
            result = self._counted(m, sensitivities)
        return result

    def _counted(
        self, m: FloatArray, sensitivities: bool = True, *, every_frame: bool = False
    ) -> ClosureResult:
        self.closures += 1
        return self._close(m, sensitivities, every_frame=every_frame)

    def _close(
        self, m: FloatArray, sensitivities: bool = True, *, every_frame: bool = False
    ) -> ClosureResult:
        """One closure, from the last closed state or from the open valve."""
        system, parameters = self.tuned(m)
        newton, steps = self.settings.newton, self.settings.protocol.steps()
        run = partial(
            simulate,
            system,
            boundary_loading(system, self.valve, self.contact_valve, self.settings),
            damping=self.damping(m),
            parameters=parameters if sensitivities else [],
            final_only=not every_frame,
            solver=self._solver,
            on_step=self.on_step,
        )
        simulation, end = None, self.settings.protocol.end
        straight = steps[-1].static and not every_frame
        if straight and self._closed is not None and self._near(m):
            soon = newton
            if self.guide is not None and self.repeat:
                # Where that is not soon found, the guide finds it sooner.
                most = min(newton.max_iterations, CONTINUED)
                soon = replace(newton, max_iterations=most)
            expected = self._expected_move(m)
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
        if straight and self.guide is not None and self._unsettled(simulation):
            start = self._guided(self.guide, m)
            if start is not None:
                rest = _resting(end, steps[-1].time)
                simulation = run(rest, newton=newton, initial_positions=start, initial_time=end)
        if simulation is None or self._unsettled(simulation):
            # From the open valve.
            start = None if self.perturbation is None else self.mesh.nodes + self.perturbation
            simulation = run(steps, newton=newton, initial_positions=start)
        if simulation.converged:
            self._closed = ClosedState(
                np.array(m, dtype=np.float64),
                simulation.frames[-1],
                slopes=simulation.sensitivities[-1] if sensitivities else None,
            )
        return ClosureResult(system, simulation)

    def _unsettled(self, simulation: Simulation | None) -> bool:
        """Whether a closure is yet to be tried, or to be repeated in another way."""
        return simulation is None or (self.repeat and not simulation.converged)

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
        if self._system is None or self._solver is None:
            self._solver = linear_solver(self.settings.solver)
            self._system = build_system(
                self.valve, self.contact_valve, self.mesh, self.settings, values, ties=self.ties
            )
        system = self._system
        retune(system, self.settings, values)
        return system, tuple(Parameter(n, values[n]) for n in self.names)

    @property
    def solver(self) -> LinearSolver:
        """The solver that goes with the system, made with it."""
        if self._solver is None:
            self._solver = linear_solver(self.settings.solver)
        return self._solver

    def held(self, m: FloatArray, states: Sequence[HeldState]) -> list[FloatArray | None]:
        """Observed vertices ``(n, 3)`` mm of the closed valve in equilibria under other loads.

        The valve is closed with parameters ``m (p,)`` first, and goes from one state to the next;
        None from the first one on for which no equilibrium is found.

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
        """The observed vertices of the closed valve, and of equilibria under other loads.

        As `held`, with derivatives. The last prediction is the first that fails, if one does.
        """
        try:
            ends = self.rests(m, states, sensitivities=True)
        except MaterialError as error:
            return [Prediction.failed(str(error))]
        return [self._seen(end) for end in ends]

    def _seen(self, simulation: Simulation) -> Prediction:
        if not simulation.converged:
            return Prediction.failed(
                f"{simulation.reason.value} (t = {simulation.times[-1]:.3f} s)"
            )
        moved = [self.observed(dx).ravel() for dx in simulation.sensitivities[-1]]
        return Prediction(self.observed(simulation.frames[-1]).ravel(), np.stack(moved, axis=1))

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
            first = self._rest(system, loading, start, parameters, damped=True)
        ends = [first]
        for state in states:
            if not ends[-1].converged:
                break
            loading = held_loading(system, self.contact_valve, state)
            ends.append(self._rest(system, loading, ends[-1].frames[-1], parameters))
        return ends

    def _rest(
        self,
        system: System,
        loading: Callable[[float], Loads],
        start: FloatArray,
        parameters: Sequence[Parameter] = (),
        *,
        damped: bool = False,
    ) -> Simulation:
        """Equilibrium under constant loads from nodal positions ``start (n, 3)``.

        It is looked for at once, or, where that fails or ``damped``, after some steps of time.
        """
        end = self.settings.protocol.end
        run = partial(
            simulate,
            system,
            loading,
            damping=self.settings.damping,
            newton=self.settings.newton,
            parameters=parameters,
            final_only=True,
            solver=self._solver,
            initial_positions=start,
            initial_time=end,
        )
        if not damped:
            simulation = run([Step(end + 1.0, static=True)])
            if simulation.converged:
                return simulation
        # Damping by stiffness helps leaflets to slide over each other to where they are held.
        return run(_resting(end, end + 1.0))

    def _guided(self, guide: ClosureModel, m: FloatArray) -> FloatArray | None:
        """The guide's closed state at this mesh's nodes ``(n, 3)``.

        None if it does not close, or if its cells are so coarse that they do not hold this mesh.
        """
        if self._in_guide is None:
            try:
                self._in_guide = embed(guide.mesh, self.mesh.nodes)
            except GeometryError:
                return None
        simulation = guide.close(m, sensitivities=False).simulation
        return self._in_guide(simulation.frames[-1]) if simulation.converged else None

    @cached_property
    def observed(self) -> Embedding:
        """The observed vertices embedded in the mesh."""
        return embed(self.mesh, self.valve.surface.vertices)

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
