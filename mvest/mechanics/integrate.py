r"""Time integration with direct-differentiation sensitivities.

Backward Euler: with :math:`v_{n+1} = (x_{n+1} - x_n)/\Delta t` each step solves

.. math:: M (v_{n+1} - v_n)/\Delta t + \alpha M v_{n+1}
          + f_{int}(x_{n+1}; \epsilon_n) - f_{ext}(x_{n+1}, t_{n+1}) = 0

by Newton's method with the consistent tangent A. A static step drops inertia and damping. A step
that fails (no convergence, leaflets through each other) is halved; a static step with contact or
from a moving body is repeated after the body has had more time to come to rest. Only converged
steps are accepted, except in the single-solve mode: one exact linear solve per step, linearised at
the current state and without the load stiffness of the pressure. Its sensitivities are those of the
linearised step at fixed stiffness, with the same factor: cheap, but not exact.

Sensitivities differentiate these discrete equations (Michaleris, Tortorelli and Vidal 1994, Int. J.
Numer. Meth. Engng 37:2471): with the factorised A of the converged step, for each parameter m,

.. math:: A \, dx_{n+1} = -\partial_m r + M (dx_n/\Delta t + dv_n)/\Delta t + \alpha M dx_n/\Delta t
          - \partial_{\epsilon_n} f_{int} \, d\epsilon_n .
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.assembly import add_forces
from mvest.mechanics.forces.contact import Contact
from mvest.mechanics.forces.pair_search import HARMLESS, ContactPairs
from mvest.mechanics.law import Points
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.solid import SolidState
from mvest.mechanics.solver import EXACT, LinearSolver, linear_solver
from mvest.mechanics.steps import Damping, NewtonSettings, Simulation, Step, StepReason, StepRecord
from mvest.mechanics.system import Evaluation, Loads, System
from mvest.typing import FloatArray

RUNAWAY = 1.5
"""Largest displacement within a step over the size of the body. Iterates beyond it have diverged,
and collision detection there could need any amount of memory."""

NEAR = 1e-3
"""Relative residual below which the last factor also serves for the new tangent: GMRES then needs
at most one more iteration."""

DERIVATIVES = 1e-11
"""Estimated relative error of derivatives."""

STALLED = 5
"""Line searches in a row without sufficient decrease that end Newton's method, which would be stuck
until its last iteration. Golden runs are the same without this limit."""

SETTLINGS = 2
"""Largest number of rests before an equilibrium that is not found at once."""
SETTLING_STEPS = 3
"""Time steps of one rest."""


@dataclass(slots=True, eq=False)
class _State:
    x: FloatArray
    v: FloatArray
    strain: FloatArray
    dx: FloatArray  # (p, n, 3)
    dv: FloatArray
    d_strain: FloatArray  # (p, e, q, 6)
    dt: float = 0.0  # of the last dynamic step, 0 at rest
    move: FloatArray | None = None  # expected in the next step, if not given by the velocity


@dataclass(slots=True, eq=False)
class _Solved:
    x: FloatArray
    evaluation: Evaluation
    residuals: list[float] = field(default_factory=list)
    pairs: ContactPairs | None = None
    linearised: SolidState | None = None  # state predicted by a single solve


class _Stride(NamedTuple):
    """Loads of a step, its length (s), and the damping over it."""

    loads: Loads
    dt: float
    static: bool
    rate: float


class _StepError(Exception):
    def __init__(self, reason: StepReason) -> None:
        self.reason = reason


def simulate(
    system: System,
    loading: Callable[[float], Loads],
    steps: Sequence[Step],
    *,
    damping: Damping | None = None,
    newton: NewtonSettings | None = None,
    parameters: Sequence[Parameter] = (),
    final_only: bool = False,
    solver: LinearSolver | None = None,
    initial_velocity: FloatArray | None = None,
    initial_positions: FloatArray | None = None,
    initial_move: FloatArray | None = None,
    initial_time: float = 0.0,
    on_step: Callable[[float, int], None] | None = None,
) -> Simulation:
    """Integrate ``system`` over ``steps``.

    Returns the completed frames, and the reason for the end. InputError if the steps are not
    increasing.

    Parameters
    ----------
    system : System
    loading : callable
        Time (s) -> :class:`Loads`.
    steps : sequence of Step
        With strictly increasing times > ``initial_time``.
    damping, newton, solver : optional
        Defaults: the paper's damping, converged Newton, the fastest available solver.
    parameters : sequence of Parameter
        Parameters of the derivatives.
    final_only : bool
        Only the last frame is needed. If its step is static, the frames before it are solved to the
        path tolerance only, without derivatives: an equilibrium has no history.
    initial_velocity : ndarray, optional
        ``(n, 3)`` mm/s.
    initial_positions : ndarray, optional
        ``(n, 3)`` mm; default the reference positions.
    initial_move : ndarray, optional
        ``(n, 3)`` mm, expected displacement in the first step, as its initial guess. It is
        shortened as contact requires.
    initial_time : float
        s.
    on_step : callable, optional
        Called with (time, Newton iterations so far) after each step, for progress.
    """
    damping = damping or Damping()
    newton = newton or NewtonSettings()
    solver = solver or linear_solver()
    times = np.array([s.time for s in steps], dtype=float)
    if (
        len(times) == 0
        or not np.all(np.isfinite(times))
        or np.any(np.diff(times, prepend=initial_time) <= 0)
    ):
        raise InputError(
            f"time steps must increase strictly from {initial_time:g}; a step of size 0 is none"
        )
    n, n_p = system.n, len(parameters)
    x0, strain0 = np.array(system.solid.mesh.nodes), system.solid.initial_strain()
    if initial_positions is not None:
        x0 = np.array(initial_positions, dtype=float)
        strain0 = system.solid.law.strain(system.solid.evaluate(x0, strain0, 0.0).green)
    state = _State(
        x0,
        np.zeros((n, 3)) if initial_velocity is None else np.array(initial_velocity, dtype=float),
        strain0,
        np.zeros((n_p, n, 3)),
        np.zeros((n_p, n, 3)),
        np.zeros((n_p, *strain0.shape)),
        move=initial_move,
    )
    stepper = _Stepper(system, loading, damping, newton, tuple(parameters), solver)
    stepper.last_only = final_only and steps[-1].static
    frames, sensitivities, done = [x0], [state.dx], [initial_time]
    reason = StepReason.COMPLETED
    for step in steps:
        stepper.passing = stepper.last_only and step is not steps[-1]
        try:
            state = stepper.advance(state, done[-1], step)
        except _StepError as failure:
            reason = failure.reason
            break
        frames.append(state.x)
        sensitivities.append(state.dx)
        done.append(step.time)
        if on_step is not None:
            on_step(step.time, sum(len(r.residuals) - 1 for r in stepper.records))
    return Simulation(
        np.array(done),
        np.array(frames),
        np.array(sensitivities),
        reason,
        tuple(stepper.records),
        solver.name,
    )


class _Stepper:
    """Advances a state; holds the quantities common to all steps."""

    def __init__(
        self,
        system: System,
        loading: Callable[[float], Loads],
        damping: Damping,
        newton: NewtonSettings,
        parameters: tuple[Parameter, ...],
        solver: LinearSolver,
    ) -> None:
        self.system = system
        self._far = RUNAWAY * float(np.ptp(system.solid.mesh.nodes, axis=0).max())
        self.loading = loading
        self.damping = damping
        self.newton = newton
        self.parameters = parameters
        self.solver = solver
        self.records: list[StepRecord] = []
        self.last_only = False
        self.passing = False  # whether only later steps are of interest
        self._pairs: ContactPairs | None = None
        self._detect = False  # whether collision detection always runs

    def advance(self, state: _State, start: float, step: Step) -> _State:
        """State at ``step.time``; halves the step where it fails."""
        if step.static and (state.dt or self.system.contact is not None):
            return self._settle(state, start, step.time)
        pending = [(step.time, 0)]
        time = start
        while pending:
            end, level = pending[-1]
            try:
                state = self._try(state, end, end - time, step.static, level)
            except _StepError:
                if level >= self.newton.max_halvings:
                    raise
                pending.append((0.5 * (time + end), level + 1))
                pending[-2] = (end, level + 1)
                continue
            pending.pop()
            time = end
        return state

    def _settle(self, state: _State, start: float, time: float) -> _State:
        """Equilibrium at ``time``; if it is not found from a moving body, the body rests first.

        A rest consists of time steps under the final loads, each twice as long as the last.
        """
        for level in range(SETTLINGS + 1):
            try:
                return self._try(state, time, time - start, True, level)
            except _StepError:
                if level == SETTLINGS or not state.dt:
                    raise
            self.passing = self.last_only
            for _ in range(SETTLING_STEPS):
                state = self._try(state, time, 2 * state.dt, False, level + 1)
            self.passing = False
        raise AssertionError("unreachable")

    def _try(self, state: _State, time: float, dt: float, static: bool, level: int) -> _State:
        """State after one step, which is recorded; a failed step leaves no trace."""
        enhanced = self.system.solid.enhanced_parameters
        try:
            new, solved = self._step(state, time, dt, static)
        except _StepError:
            self.system.solid.enhanced_parameters = enhanced
            raise
        contact = self.system.contact
        active = 0
        if contact is not None and solved.pairs is not None:
            active = contact.active(solved.pairs, contact.points(new.x))
        self.records.append(StepRecord(time, dt, tuple(solved.residuals), active, level))
        return new

    def _step(self, state: _State, end: float, dt: float, static: bool) -> tuple[_State, _Solved]:
        stride = _Stride(self.loading(end), dt, static, 0.0 if static else self.damping.beta / dt)
        solved = self._newton(state, stride)
        contact = self.system.contact
        if contact is not None and contact.intersects(contact.points(solved.x)):
            if self._detect:
                raise _StepError(StepReason.INTERSECTION)
            # Neighbours have folded through each other, which only detection prevents.
            self._detect = True
            try:
                return self._step(state, end, dt, static)
            finally:
                self._detect = False
        new_v = (solved.x - state.x) / dt if not static else np.zeros_like(state.v)
        strain = self.system.solid.law.strain(solved.evaluation.solid.green)
        advanced = 0.0 if static else dt
        new = _State(solved.x, new_v, strain, state.dx, state.dv, state.d_strain, advanced)
        if self.parameters and not self.passing:
            self._differentiate(state, new, solved, stride)
        return new, solved

    def _newton(self, state: _State, stride: _Stride) -> _Solved:
        system, newton, loads, dt = self.system, self.newton, stride.loads, stride.dt
        tolerance = max(newton.path_tolerance if self.passing else 0.0, newton.tolerance)
        mass = system.solid.lumped_mass[:, None]
        inertia = 0.0 if stride.static else 1.0
        # dv/dx of backward Euler is 1/dt: M v' and alpha M v together weigh M by this factor.
        mass_factor = inertia * (1 / dt**2 + self.damping.alpha / dt)
        push = inertia * mass * (state.x / dt + state.v) / dt + (
            inertia * self.damping.alpha * mass * state.x / dt
        )
        move = state.move
        if move is None and not stride.static and state.dt and not newton.single_solve:
            # The first guess continues the motion, but no farther than the last step went.
            move = min(dt, state.dt) * state.v
        fixed = system.fixed_nodes
        x = state.x.copy()
        pairs = self._candidates(x)
        if move is not None:
            factor = min(1.0, newton.largest_move / max(float(np.abs(move).max()), 1e-300))
            if system.contact is not None and pairs is not None:
                y, dy = system.contact.points(x), system.contact.points(factor * move)
                factor *= _largest_step(system.contact, pairs, y, dy, detect=self._detect)
            x += factor * move
        if fixed.size:
            x[fixed] = loads.fixed

        def evaluate(at: FloatArray) -> Evaluation:
            nonlocal pairs
            pairs = self._candidates(at)
            result = system.evaluate(at, loads, pairs, state.strain, stride.rate, tangent=False)
            inertial = mass_factor * mass * at - push
            result.residual += inertial
            result.scale = max(result.scale, float(np.linalg.norm(inertial)), 1e-12)
            result.residual[system.held] = 0.0
            return result

        def factorize() -> None:
            nonlocal pairs
            pairs = self._candidates(x)  # the line search may have moved on since
            single = newton.single_solve
            blocks = system.tangent(x, loads, pairs, current.solid, load_stiffness=not single)
            near = residuals[-1] <= NEAR and len(residuals) > 1
            self.solver.factorize(system.matrix(blocks, mass_factor), near=near)

        current = evaluate(x)
        residuals, stalled = [float(np.linalg.norm(current.residual)) / current.scale], 0
        for iteration in range(newton.max_iterations + 1):
            if not np.isfinite(residuals[-1]):
                raise _StepError(StepReason.NO_CONVERGENCE)
            converged = residuals[-1] <= tolerance
            if converged and self.passing:
                return _Solved(x, current, residuals, pairs)
            if iteration == newton.max_iterations and not converged:
                break
            try:
                # A converged state keeps the last factor, unless derivatives need a new one.
                if not converged or self.parameters or iteration == 0:
                    factorize()
                # A forcing term of the size of the residual keeps the convergence quadratic
                # (Dembo, Eisenstat and Steihaug 1982, SIAM J. Numer. Anal. 19:400).
                forcing = 1e-3 if converged else min(1e-3, max(1e-9, residuals[-1]))
                if newton.single_solve:
                    forcing = EXACT
                d = -self.solver.solve(current.residual.ravel(), forcing).reshape(-1, 3)
            except (RuntimeError, ValueError) as error:
                raise _StepError(StepReason.SINGULAR) from error
            if not np.isfinite(d).all():
                raise _StepError(StepReason.SINGULAR)
            size = float(np.abs(d).max())
            if converged or size <= newton.smallest_move:
                # The last correction makes the state independent of its start within tolerance.
                return _Solved(x + d if size <= HARMLESS else x, current, residuals, pairs)
            before = x, current.solid
            x, current, lower = self._line_search(x, d, current, pairs, evaluate)
            stalled = 0 if lower else stalled + 1
            if stalled == STALLED or float(np.abs(x - state.x).max()) > self._far:
                raise _StepError(StepReason.NO_CONVERGENCE)
            residuals.append(float(np.linalg.norm(current.residual)) / current.scale)
            if newton.single_solve:
                linearised = system.solid.extrapolated(before[1], x - before[0])
                return _Solved(x, current, residuals, pairs, linearised)
        raise _StepError(StepReason.NO_CONVERGENCE)

    def _candidates(self, x: FloatArray) -> ContactPairs | None:
        """Pairs that may touch at ``x``, from the last search unless points moved too far."""
        contact = self.system.contact
        if contact is None:
            return None
        y = contact.points(x)
        if self._pairs is None or contact.stale(self._pairs, y):
            self._pairs = contact.search(y)
        return self._pairs

    def _line_search(
        self,
        x: FloatArray,
        d: FloatArray,
        current: Evaluation,
        pairs: ContactPairs | None,
        evaluate: Callable[[FloatArray], Evaluation],
    ) -> tuple[FloatArray, Evaluation, bool]:
        """Step along ``d``, admissible for contact, with backtracking on the slope r . d.

        Also whether residual or slope decreased enough.
        """
        contact = self.system.contact
        factor = min(1.0, self.newton.largest_move / max(float(np.abs(d).max()), 1e-300))
        if contact is not None and pairs is not None:
            y, dy = contact.points(x), contact.points(d)
            factor *= _largest_step(contact, pairs, y, factor * dy, detect=self._detect)
        if self.newton.single_solve:
            return x + factor * d, evaluate(x + factor * d), True
        norm = float(np.linalg.norm(current.residual))
        slope = abs(float(np.sum(current.residual * d)))
        best: tuple[float, FloatArray, Evaluation] | None = None
        for _ in range(8):
            trial = x + factor * d
            result = evaluate(trial)
            new_norm = float(np.linalg.norm(result.residual))
            new_slope = abs(float(np.sum(result.residual * d)))
            if np.isfinite(new_norm):
                if new_norm <= (1 - 1e-3 * factor) * norm or new_slope <= 0.9 * slope:
                    return trial, result, True
                if best is None or new_slope < best[0]:
                    best = (new_slope, trial, result)
            factor *= 0.5
        if best is None:
            raise _StepError(StepReason.NO_CONVERGENCE)
        return *best[1:], False

    def _differentiate(self, old: _State, new: _State, solved: _Solved, stride: _Stride) -> None:
        """Fill the derivatives of ``new``; the solver holds the factor of the converged tangent."""
        system, (loads, dt, static, rate) = self.system, stride
        solid, state = system.solid, solved.linearised or solved.evaluation.solid
        mass = solid.lumped_mass[:, None]
        region = solid.mesh.region
        right = np.empty((3 * system.n, len(self.parameters)))
        stresses = []
        for k, parameter in enumerate(self.parameters):
            d_stress = system.partial_stress(parameter, state, old.strain, rate)
            if parameter.kind == "damping" and not static:
                # Damping acts with ``rate = beta / dt`` on the change of the strain.
                at = Points(state.green, region, old.strain, 1 / dt)
                d_stress = d_stress + solid.law.history_stress(at, old.strain - new.strain)
            if rate:
                at = Points(state.green, region, old.strain, rate)
                d_stress = d_stress + solid.law.history_stress(at, old.d_strain[k])
            stresses.append(d_stress)
            r = system.partial_load(parameter, solved.x, loads)
            add_forces(r, solid.mesh.elements, solid.condensed_forces(state, d_stress))
            if not static:
                r -= mass * (old.dx[k] / dt + old.dv[k]) / dt
                r -= self.damping.alpha * mass * old.dx[k] / dt
            r[system.held] = 0.0
            right[:, k] = -r.ravel()
        dx = self.solver.solve(right, DERIVATIVES).T.reshape(-1, system.n, 3)
        new.dx = dx
        new.dv = np.zeros_like(dx) if static else (dx - old.dx) / dt
        new.d_strain = np.stack(
            [
                solid.law.strain_change(state.green, solid.green_change(state, dx[k], stresses[k]))
                for k in range(len(self.parameters))
            ]
        )


def _largest_step(
    contact: Contact, pairs: ContactPairs, y: FloatArray, dy: FloatArray, *, detect: bool
) -> float:
    """Share of the displacement ``dy`` without collisions; the step fails if there is none."""
    try:
        factor = contact.largest_step(pairs, y, dy, detect=detect)
    except MemoryError as error:
        # Diverged iterates sweep over too large a volume.
        raise _StepError(StepReason.NO_CONVERGENCE) from error
    if factor == 0.0:
        raise _StepError(StepReason.NO_CONVERGENCE)
    return factor
