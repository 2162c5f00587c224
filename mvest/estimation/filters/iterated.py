"""The extended Kalman filter, and iterated: Gauss-Newton on one maximum-a-posteriori problem."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mvest.errors import InputError, require_numbers
from mvest.estimation.estimate import Estimate, Reason
from mvest.estimation.evidence import Evidence
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseFamily
from mvest.estimation.prediction import Prediction
from mvest.estimation.run import Filter, FilterRun
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray

FIRST_DAMPING = 1.0
"""Damping after the first rejected step; the full Gauss-Newton step is about halved."""

DAMPING_FACTOR = 10.0
"""Growth of the damping with each further rejection, and its fall after a good step."""

NO_DAMPING = 1e-3
"""Damping below this counts as none, so that the next step is the full one."""

SUFFICIENT_DECREASE = 1e-4
"""Smallest decrease of an accepted step, as a share of the predicted one (Nocedal and Wright,
Numerical Optimization, 2nd ed. 2006, algorithm 4.1 and section 3.1)."""

ROUND_OFF = 4.0 * float(np.finfo(np.float64).eps)
"""Relative decrease of the objective that cannot be distinguished from rounding."""

GOOD_DECREASE = 0.5
"""Share of the predicted decrease above which the next step is less damped."""

POOR_DECREASE = 0.4
"""Share of the predicted decrease below which the next step is more damped (as in Nocedal and
Wright's algorithm 4.1, there 1/4): if the neglected second derivatives are large, full steps
overshoot again and again, and lower the objective by a third or less of the prediction."""

NEGLIGIBLE_DECREASE = 1e-3
"""Decrease of J by a Newton step of 0.045 standard deviations in any direction."""

LEAST_CURVATURE = 0.1
"""Curvature of J over that of its linearisation; intervals are at most three times as long."""

MAX_REJECTIONS = 8
"""Largest number of rejected steps in a row."""

MAX_HESSIANS, MAX_NEWTON_STEPS, MAX_HALVINGS = 4, 6, 5
"""Of J in search of its minimum, of steps with each, and of halvings of a step."""


@dataclass(frozen=True, slots=True)
class ExtendedFilter(Filter):
    """One Kalman update.

    With the prior N(m, P) in filter coordinates (Jazwinski, Stochastic Processes and Filtering
    Theory, 1970, theorem 8.1)::

        e = y − h(m),  H = dh/dz at m
        m⁺, P⁺ = update of m, P with e, H, R      see `kalman_update`

    It is the first step of `IteratedFilter`.
    """

    def estimate(self, run: FilterRun) -> Estimate:
        """Update once."""
        m, P = run.prior.mean, run.prior.covariance
        prediction = run.predict(m)
        if not prediction.converged:
            return run.fail(m, P, prediction)
        H = run.jacobian(m, prediction)
        update = kalman_update(run.prior, run.y - prediction.y, H, run.noise)
        run.record(m, P, run.misfit(prediction), update.log_likelihood)
        z, P = update.posterior.mean, update.posterior.covariance
        return run.finish_with_slope(z, P, H, Reason.COMPLETED, "one update")


@dataclass(frozen=True, slots=True)
class IteratedFilter(Filter):
    """Posterior mode and its covariance.

    Minimises in filter coordinates z with the prior N(m, P) the objective::

        J(z) = ½ (y − h(z))ᵀ R⁻¹ (y − h(z)) + ½ (z − m)ᵀ P⁻¹ (z − m)

    by the iterated extended Kalman filter, which is Gauss-Newton on J (Bell and Cathey, IEEE Trans.
    Autom. Control 38 (1993) 294-297). At each iterate zᵢ, with H = dh/dz there::

        e    = y − h(zᵢ) + H (zᵢ − m)             innovation of the prior, linearised at zᵢ
        z*, P* = update of m, P with e, H, R      see `kalman_update`
        zᵢ₊₁ = zᵢ + step

    The update always starts from the prior, so that each observation counts once. The step is
    z* − zᵢ if that lowers J enough; otherwise Levenberg and Marquardt's
    step = (B + λ diag B)⁻¹ B (z* − zᵢ), where B is the Hessian of the linearised J in coordinates
    in which the prior is N(0, I). λ grows until J decreases, and after a step that lowers it far
    less than predicted. A step at which the model fails is rejected in the same way. The covariance
    is P* at the last iterate, without the second derivatives of h.

    If R is a `NoiseFamily`, it is learned at each iterate from the model linearised there, without
    further runs. The uncertainty of the noise widens the covariance (see
    `mvest.estimation.evidence`). After ``max_learned`` iterates the noise is fixed, so that the
    filter can converge.

    The filter stops if the next full step is below the tolerance, without taking it: the reported
    prediction is that of the estimate. After ``max_iterations`` steps it has converged too if the
    next one would lower J by less than `NEGLIGIBLE_DECREASE`.
    """

    #: stop when the next full step changes no parameter by more than this, relative to its size (or
    #: to its standard deviation if that is larger)
    tolerance: float = 1e-4
    #: stop when the next full step would lower J, the negative logarithm of a probability, by less
    #: than this, or by less than its rounding error
    objective_tolerance: float = 1e-9
    max_iterations: int = 20  #: largest number of accepted steps
    #: (p,) parameters or None, first iterate; None starts at the prior's mean
    start: tuple[float, ...] | None = None
    max_learned: int = 12  #: iterates at which the noise of a `NoiseFamily` is learned
    #: whether mode and covariance are computed with second derivatives, from 2p further runs at up
    #: to `MAX_HESSIANS` points, if Gauss-Newton does not converge or the check of its posterior
    #: fails
    second_order: bool = False

    def __post_init__(self) -> None:
        require_numbers(self, "filter", "tolerance", "objective_tolerance")
        require_numbers(self, "filter", "max_iterations", least=1)

    def estimate(self, run: FilterRun) -> Estimate:
        """Find the posterior mode."""
        # In coordinates x the damping of the steps does not depend on the parameters' units.
        L, x = run.L, self._first(run)
        point = _evaluate(run, x)
        if isinstance(point, Prediction):
            return run.fail(run.z(x), run.prior.covariance, point)

        evidence: Evidence | None = None
        mode: FloatArray | None = None
        damping, iterations = 0.0, 0
        while True:
            innovation = run.y - point.prediction.y + point.H @ point.x
            if isinstance(run.R, NoiseFamily) and iterations < self.max_learned:
                evidence = Evidence(run.R, innovation, point.H)
                noise = evidence.posterior(mode)
                mode, run.noise = noise.mode, run.R.at(evidence.log(noise.mean))
                point = replace(point, objective=_objective(run, point.x, point.prediction))
            update = kalman_update(run.unit, innovation, point.H, run.noise)
            P = L @ update.posterior.covariance @ L.T
            run.record(point.z, P, point.objective, update.log_likelihood)

            step = update.posterior.mean - point.x
            A = run.noise.whiten(point.H)
            B = np.eye(run.prior.size) + A.T @ A
            decrease = 0.5 * float(step @ B @ step)
            reason: Reason | None = None
            detail = f"{iterations} iterations, the next full step would lower J by {decrease:.2e}"
            if run.negligible(L @ step, point.z, P, self.tolerance) or decrease <= max(
                self.objective_tolerance, ROUND_OFF * point.objective
            ):
                reason = Reason.CONVERGED
            elif iterations == self.max_iterations:
                near = decrease <= NEGLIGIBLE_DECREASE
                reason = Reason.CONVERGED if near else Reason.MAX_ITERATIONS
            else:
                accepted, damping, rejected = _search(run, point, B, step, damping)
                if accepted is not None:
                    point = accepted
                    iterations += 1
                elif rejected is not None:
                    reason, detail = Reason.MODEL_FAILED, f"{detail}; {rejected}"
                else:
                    reason = Reason.NO_DECREASE
            if reason is not None:
                more: dict[str, Any] = {"learned": evidence and evidence.learned(noise, L)}
                check = run.check(point.prediction) if self.second_order else None
                trusted = reason is Reason.CONVERGED and (check is None or check.holds)
                if self.second_order and not trusted and reason is not Reason.MODEL_FAILED:
                    better = _with_second_derivatives(run, point, update.posterior)
                    if better is not None:
                        point, covariance = better
                        innovation = run.y - point.prediction.y + point.H @ point.x
                        update = kalman_update(run.unit, innovation, point.H, run.noise)
                        P = L @ covariance @ L.T
                        run.record(point.z, P, point.objective, update.log_likelihood)
                        # In filter coordinates, what Gauss-Newton leaves out of the Hessian.
                        A, back = run.noise.whiten(point.H), np.linalg.pinv(L)
                        left = np.linalg.inv(covariance) - np.eye(len(A.T)) - A.T @ A
                        more["curvature"] = np.asarray(back.T @ left @ back)
                        reason = Reason.CONVERGED
                        detail = f"{iterations} iterations, then with second derivatives"
                return run.finish(reason, detail, point.prediction, innovation, update, **more)

    def _first(self, run: FilterRun) -> FloatArray:
        """Coordinates x of the first iterate."""
        if self.start is None:
            return np.zeros(run.prior.size)
        start = np.array(self.start, dtype=np.float64)
        if start.shape != run.prior.mean.shape or not np.all(np.isfinite(start)):
            raise InputError(f"start must be {run.prior.size} finite numbers; got {self.start}")
        offset = run.transform.forward(start) - run.prior.mean
        x = np.asarray(np.linalg.lstsq(run.L, offset, rcond=None)[0], dtype=np.float64)
        if not np.allclose(run.L @ x, offset, rtol=1e-9, atol=1e-12):
            raise InputError(
                f"start {self.start} differs from the prior's mean in a parameter (or combination) "
                f"that the prior holds fixed"
            )
        return x


def _search(
    run: FilterRun, point: "_Point", B: FloatArray, step: FloatArray, damping: float
) -> "tuple[_Point | None, float, str | None]":
    """The next iterate, which lowers the objective, and its damping.

    None if there is no such step, with the model's reason if it failed at the last one.
    """
    failure: str | None = None
    scale = np.diag(np.diagonal(B))
    for _ in range(MAX_REJECTIONS + 1):
        trial_step = np.linalg.solve(B + damping * scale, B @ step) if damping else step
        predicted = 0.5 * float(trial_step @ (B + 2.0 * damping * scale) @ trial_step)
        trial = _evaluate(run, point.x + trial_step)
        if isinstance(trial, Prediction):
            failure = trial.reason
        else:
            failure = None
            gain = (point.objective - trial.objective) / predicted
            if gain >= GOOD_DECREASE:
                relaxed = damping / DAMPING_FACTOR
                return trial, relaxed if relaxed >= NO_DAMPING else 0.0, None
            if gain >= POOR_DECREASE:
                return trial, damping, None
            if gain >= SUFFICIENT_DECREASE:
                return trial, max(FIRST_DAMPING, DAMPING_FACTOR * damping), None
        damping = max(FIRST_DAMPING, DAMPING_FACTOR * damping)
    return None, damping, failure


def _with_second_derivatives(
    run: FilterRun, point: "_Point", gaussian: Gaussian
) -> "tuple[_Point, FloatArray] | None":
    """The minimum of J and the covariance from its curvature, in coordinates x.

    Gauss-Newton's Hessian leaves out ``−Σ (R⁻¹ (y − h))ᵢ ∂²hᵢ/∂x²``. With thousands of observations
    this may be as large as the rest, though the model is nearly linear over a standard deviation.
    Here the Hessian comes from differences of J's exact gradients over ± one standard deviation
    along conjugate directions of a Gaussian, first of Gauss-Newton's (Nocedal and Wright 2006,
    section 8.1); its inverse is the covariance (Laplace). The directions are the columns of
    Cholesky's factor. Newton steps with the Hessian lead to the minimum. If that is more than a
    standard deviation away, the Hessian is computed again there; also if J is not convex at the
    start, as where Gauss-Newton creeps along a bent valley: the steps then take its eigenvalues to
    be at least `LEAST_CURVATURE` (section 3.4).

    Returns None if a run fails, or no minimum at which J is convex is reached.
    """
    covariance = gaussian.covariance
    for _ in range(MAX_HESSIANS):
        C = np.linalg.cholesky(covariance)
        rows = []
        for axis in C.T:
            ends = [_evaluate(run, point.x + sign * axis) for sign in (1.0, -1.0)]
            up, down = (None if isinstance(end, Prediction) else end.slope(run) for end in ends)
            if up is None or down is None:
                return None
            rows.append(0.5 * C.T @ (up - down))
        hessian = 0.5 * (np.array(rows) + np.array(rows).T)
        curvatures, axes = np.linalg.eigh(hessian)
        convex, axes = curvatures[0] >= LEAST_CURVATURE, C @ axes
        inverse = axes / np.maximum(curvatures, LEAST_CURVATURE) @ axes.T
        begun, (point, reached) = point, _descended(run, point, inverse)
        if point is begun and not (convex and reached):
            return None
        if convex:
            moved = np.linalg.solve(C, point.x - begun.x)
            if reached and float(moved @ hessian @ moved) <= 1.0:
                return point, inverse
            covariance = inverse
    return None


def _descended(run: FilterRun, point: "_Point", inverse: FloatArray) -> "tuple[_Point, bool]":
    """The point after Newton steps with one inverse Hessian, and whether J is lowest there."""
    for _ in range(MAX_NEWTON_STEPS):
        slope = point.slope(run)
        step = -inverse @ slope
        if -0.5 * float(step @ slope) <= NEGLIGIBLE_DECREASE:
            return point, True
        lower = _lower(run, point, step, slope)
        if lower is None:
            break
        point = lower
    return point, False


def _lower(run: FilterRun, point: "_Point", step: FloatArray, slope: FloatArray) -> "_Point | None":
    """The first point along halved steps at which J is sufficiently lower."""
    for _ in range(MAX_HALVINGS):
        trial = _evaluate(run, point.x + step)
        if not isinstance(trial, Prediction):
            decrease = point.objective - trial.objective
            if decrease >= -SUFFICIENT_DECREASE * float(step @ slope):
                return trial
        step = 0.5 * step
    return None


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """An iterate with its prediction.

    The prior of `x` (p,) is N(0, I); `z` (p,) are filter coordinates, `H` (n, p) is dh/dx, and
    `objective` is J.
    """

    x: FloatArray
    z: FloatArray
    prediction: Prediction
    H: FloatArray
    objective: float

    def slope(self, run: FilterRun) -> FloatArray:
        """Derivative of J by x (p,), exact for the current noise."""
        e = run.noise.whiten(run.y - self.prediction.y)
        return np.asarray(self.x - run.noise.whiten(self.H).T @ e)


def _evaluate(run: FilterRun, x: FloatArray) -> _Point | Prediction:
    """The iterate at x, or the failed prediction there."""
    z = run.z(x)
    prediction = run.predict(z)
    if not prediction.converged:
        return prediction
    H = run.jacobian(z, prediction) @ run.L
    return _Point(x, z, prediction, H, _objective(run, x, prediction))


def _objective(run: FilterRun, x: FloatArray, prediction: Prediction) -> float:
    """J with the current noise."""
    return run.misfit(prediction) + 0.5 * float(x @ x)
