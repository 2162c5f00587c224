"""The filter that takes the frames of a run as they come; its parameters are constant."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.estimation.estimate import Estimate, OnIterate, Reason
from mvest.estimation.filters.iterated import ROUND_OFF
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseCovariance, ObservationNoise
from mvest.estimation.prediction import ObservationModel, Prediction
from mvest.estimation.run import FilterRun, require_settings
from mvest.estimation.trajectory import (
    FrameState,
    LinearFrame,
    filter_frames,
    frame_noises,
    split_frames,
)
from mvest.estimation.transform import Transform
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray

__all__ = ["SequentialEstimate", "SequentialFilter"]

OBJECTIVE_TOLERANCE = 1e-9
"""Decrease of the objective, the negative logarithm of a probability, that matters to nobody."""

HALVINGS = 6
"""How often a pass that does not lower the objective is shortened by half."""


@dataclass(frozen=True, slots=True, eq=False)
class SequentialEstimate:
    """A sequential estimate of constant parameters, and how it grew from frame to frame.

    Attributes
    ----------
    estimate : Estimate
        Its iterates are the prior and the end of each pass over the frames.
    extended : tuple of FrameState
        The first pass, linearised at what was known when a frame came: what the filter could have
        said at that moment. Empty if the model failed in it.
    final : tuple of FrameState
        The last pass, linearised at the estimate.
    """

    estimate: Estimate
    extended: tuple[FrameState, ...]
    final: tuple[FrameState, ...]


@dataclass(frozen=True, slots=True)
class SequentialFilter:
    """Kalman filter over the frames of one run of a model with constant parameters.

    The model predicts all frames, y = (y_1, ..., y_f), from the parameters alone: the state at a
    frame is that of the model run with the current estimate, so that parameters and state agree.

    The first pass is the extended Kalman filter: frame k updates what frames 1 to k − 1 have left,
    linearised there (the model is run again where the estimate has moved since the last run). Each
    further pass starts from the prior again, never from a posterior, with all frames linearised at
    the last pass's end z_i::

        e_k  = y_k − h_k(z_i) + H_k (z_i − m),    m, P = update of m, P with e_k, H_k, R_k

    A pass is one Gauss-Newton step on the batch's maximum-a-posteriori problem (Bell and Cathey,
    IEEE Trans. Autom. Control 38 (1993) 294-297), and its limit the estimate of `IteratedFilter`,
    whatever the order of the frames. A pass that does not lower the objective is halved.

    Attributes
    ----------
    sizes : tuple of int, (f,)
        Number of observations in each frame.
    tolerance : float
        Stop when a further pass changes no parameter by more than this, as for `IteratedFilter`.
    max_iterations : int
        Largest number of passes after the first.
    relinearise : float
        In the first pass the model is run again once a parameter has moved by more than this,
        relative to its size (or its standard deviation if that is larger); 0: after every frame.

    Raises
    ------
    InputError
        If a setting, a shape or a covariance is not admissible; never for a failing model.
    """

    sizes: tuple[int, ...]
    tolerance: float = 1e-4
    max_iterations: int = 20
    relinearise: float = 0.02

    def __post_init__(self) -> None:
        require_settings(tolerance=self.tolerance, max_iterations=self.max_iterations)
        if not self.sizes or min(self.sizes) < 1:
            raise InputError(f"frames of {self.sizes} observations, expected at least one in each")
        if not self.relinearise >= 0.0:
            raise InputError(f"relinearise = {self.relinearise}, expected >= 0")

    def __call__(
        self,
        model: ObservationModel,
        prior: Gaussian,
        y: FloatArray,
        R: NoiseCovariance,
        *,
        names: Sequence[str] | None = None,
        transform: Transform | None = None,
        on_iterate: OnIterate | None = None,
    ) -> Estimate:
        """Estimate; see `Filter` for the arguments."""
        result = self.run(
            model, prior, y, R, names=names, transform=transform, on_iterate=on_iterate
        )
        return result.estimate

    def run(
        self,
        model: ObservationModel,
        prior: Gaussian,
        y: FloatArray,
        R: NoiseCovariance,
        *,
        names: Sequence[str] | None = None,
        transform: Transform | None = None,
        on_iterate: OnIterate | None = None,
    ) -> SequentialEstimate:
        """The estimate with the states of its first and last pass; arguments as for `Filter`."""
        run = FilterRun(model, prior, y, R, names, transform, on_iterate)
        noises = frame_noises(R, self.sizes)
        start = run.predict(run.prior.mean)
        if not start.converged:
            failed = run.fail(run.prior.mean, run.prior.covariance, start)
            return SequentialEstimate(failed, (), ())
        extended, ends = self._extended(run, noises)
        if isinstance(ends, Prediction):
            z = extended[-1].filtered.mean if extended else run.prior.mean
            failed = run.fail(z, extended[-1].filtered.covariance, ends)
            return SequentialEstimate(failed, extended, ())
        first = _Point(run.prior.mean, start, _objective(run, run.prior.mean, start))
        return self._passes(run, noises, extended, first, ends)

    def _linear(
        self, run: FilterRun, noises: list[ObservationNoise], z: FloatArray, at: Prediction
    ) -> list[LinearFrame]:
        """All frames linearised at z (p,), where the model predicts ``at``."""
        H = run.jacobian(z, at)
        whole = run.y - at.y + H @ z
        parts = zip(
            split_frames(whole, self.sizes), split_frames(H, self.sizes), noises, strict=True
        )
        return [LinearFrame(y, H_k, noise) for y, H_k, noise in parts]

    def _extended(
        self, run: FilterRun, noises: list[ObservationNoise]
    ) -> tuple[tuple[FrameState, ...], FloatArray | Prediction]:
        """The first pass, and where it ends or the prediction that failed."""
        known, z = run.prior, run.prior.mean
        frames = self._linear(run, noises, z, run.predict(z))
        states: list[FrameState] = []
        for k in range(len(self.sizes)):
            moved = known.mean - z
            if not run.negligible(moved, z, known.covariance, self.relinearise):
                z = known.mean
                prediction = run.predict(z)
                if not prediction.converged:
                    return tuple(states), prediction
                frames = self._linear(run, noises, z, prediction)
            states += filter_frames(known, frames[k : k + 1])
            known = states[-1].filtered
        return tuple(states), known.mean

    def _passes(
        self,
        run: FilterRun,
        noises: list[ObservationNoise],
        extended: tuple[FrameState, ...],
        point: "_Point",
        target: FloatArray,
    ) -> SequentialEstimate:
        """Passes from the prior, linearised at the end of the last one, until they agree."""
        run.record(point.z, run.prior.covariance, point.objective, np.nan)
        reason: Reason | None = None
        passes = 0
        while reason is None:
            lower, failure = _descend(run, point, target)
            if lower is None:
                reason = Reason.NO_DECREASE if failure is None else Reason.MODEL_FAILED
            else:
                point, passes = lower, passes + 1
            states = filter_frames(run.prior, self._linear(run, noises, point.z, point.prediction))
            known = states[-1].filtered
            H = run.jacobian(point.z, point.prediction)
            innovation = run.y - point.prediction.y + H @ (point.z - run.prior.mean)
            update = kalman_update(run.prior, innovation, H, run.noise)
            if lower is None:
                break
            target = known.mean
            run.record(point.z, known.covariance, point.objective, update.log_likelihood)
            # The smallest value of the linearised objective is half of eᵀ S⁻¹ e.
            decrease = point.objective - 0.5 * update.nis
            if run.negligible(target - point.z, point.z, known.covariance, self.tolerance) or (
                decrease <= max(OBJECTIVE_TOLERANCE, ROUND_OFF * point.objective)
            ):
                reason = Reason.CONVERGED
            elif passes > self.max_iterations:
                reason = Reason.MAX_ITERATIONS
        assert reason is not None
        detail = f"{passes} passes over {len(self.sizes)} frames"
        if failure is not None:
            detail += f"; {failure}"
        estimate = run.finish(reason, detail, point.prediction, innovation, update)
        return SequentialEstimate(estimate, extended, states)


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """An iterate: filter coordinates, the prediction there, and the objective."""

    z: FloatArray
    prediction: Prediction
    objective: float


def _objective(run: FilterRun, z: FloatArray, prediction: Prediction) -> float:
    """½ (y − h)ᵀ R⁻¹ (y − h) + ½ (z − m)ᵀ P⁻¹ (z − m); z differs from m only where P allows."""
    x = np.linalg.lstsq(run.prior.factor, z - run.prior.mean, rcond=None)[0]
    return run.misfit(prediction) + 0.5 * float(x @ x)


def _descend(run: FilterRun, point: _Point, target: FloatArray) -> tuple[_Point | None, str | None]:
    """The first point on the way back from ``target`` that lowers the objective.

    None if there is none, with the model's words if it failed at the last that was tried.
    """
    failure: str | None = None
    for k in range(HALVINGS + 1):
        z = point.z + 0.5**k * (target - point.z)
        prediction = run.predict(z)
        failure = None if prediction.converged else prediction.reason
        if failure is None:
            objective = _objective(run, z, prediction)
            if objective < point.objective:
                return _Point(z, prediction, objective), None
    return None, failure
