"""The smoother of parameters that drift from frame to frame."""

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from mvest.errors import InputError
from mvest.estimation.estimate import Reason
from mvest.estimation.filters.iterated import ROUND_OFF
from mvest.estimation.filters.sequential import HALVINGS
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseCovariance, ObservationNoise
from mvest.estimation.prediction import Predicted, predict
from mvest.estimation.run import require_settings
from mvest.estimation.trajectory import (
    FrameState,
    LinearFrame,
    Trajectory,
    filter_frames,
    frame_noises,
    random_walk,
    smooth_frames,
    split_frames,
)
from mvest.estimation.transform import Identity, Transform, to_filter
from mvest.typing import FloatArray

__all__ = ["DriftEstimate", "DriftSmoother", "FrameModel"]


class FrameModel(Protocol):
    """A model whose frames depend on the parameters of that frame only."""

    def frame(self, k: int, m: FloatArray, /) -> Predicted:
        """Predict frame k of parameters m (p,); fails as `ObservationModel` does."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class DriftEstimate:
    """Parameters that drift over f frames, filtered and smoothed.

    Attributes
    ----------
    transform : Transform
    states : tuple of FrameState, (f,)
        The filter's, in filter coordinates, linearised at the last trajectory at which the model
        was run; empty if it failed before there was one.
    extended : tuple of FrameState, (f,)
        The first pass, linearised at what was predicted of each frame when it came; fewer if the
        model failed in it.
    smoothed : Trajectory or None
        In filter coordinates. Where the smoother has not converged, its mean is the last
        trajectory that lowered the objective; None if the model failed before there was one.
    reason : Reason
    detail : str
    forward_solves : int
    objectives : tuple of float
        Of the trajectory at which each pass was linearised; decreasing.
    """

    transform: Transform
    states: tuple[FrameState, ...]
    extended: tuple[FrameState, ...]
    smoothed: Trajectory | None
    reason: Reason
    detail: str
    forward_solves: int
    objectives: tuple[float, ...] = ()

    @property
    def converged(self) -> bool:
        """Whether the smoother stopped because its passes agree."""
        return self.reason.converged


@dataclass(frozen=True, slots=True)
class DriftSmoother:
    """Fixed-interval smoother of parameters that walk at random from frame to frame.

    Finds the most probable trajectory Z = (z_1, ..., z_f), the smallest of::

        J(Z) = ½ Σ (y_k − h_k(z_k))ᵀ R_k⁻¹ (y_k − h_k(z_k)) + ½ (z_1 − m)ᵀ P⁻¹ (z_1 − m)
             + ½ Σ (z_k − z_{k−1})ᵀ Q⁻¹ (z_k − z_{k−1})

    A pass filters the linearised frames and smooths backwards (see `smooth_frames`). The first one
    linearises each frame at its prediction (the extended Kalman smoother), further ones at the
    last trajectory: Gauss-Newton on J (Bell 1994, SIAM J. Optim. 4:626). A pass that does not lower
    J, or ends where the model cannot follow, is halved. Where the model cannot follow to the end of
    the first one, the search begins at the prior's mean in all frames.

    Attributes
    ----------
    sizes : tuple of int, (f,)
        Number of observations in each frame.
    Q : one variance or p variances
        Of one step of the walk, in filter coordinates.
    tolerance : float
        Stop when a pass moves no parameter of any frame by more than this part of its smoothed
        standard deviation.
    max_iterations : int
        Largest number of passes after the first.
    """

    sizes: tuple[int, ...]
    Q: float | tuple[float, ...] = 0.0
    tolerance: float = 0.02
    max_iterations: int = 10

    def __post_init__(self) -> None:
        require_settings(tolerance=self.tolerance, max_iterations=self.max_iterations)
        if not self.sizes or min(self.sizes) < 1:
            raise InputError(f"frames of {self.sizes} observations, expected at least one in each")

    def __call__(
        self,
        model: FrameModel,
        initial: Gaussian,
        y: FloatArray,
        R: NoiseCovariance,
        *,
        transform: Transform | None = None,
    ) -> DriftEstimate:
        """Smooth; ``initial`` is N(m, P) of the parameters themselves at the first frame."""
        run = _DriftRun(self, model, initial, y, R, Identity() if transform is None else transform)
        failure = run.extend()
        if failure is not None:
            return run.finish(Reason.MODEL_FAILED, failure)
        point = run.linearise(smooth_frames(run.extended).mean)
        if isinstance(point, str):
            point = run.linearise(np.tile(run.prior.mean, (len(self.sizes), 1)))
        if isinstance(point, str):
            return run.finish(Reason.MODEL_FAILED, point)
        objectives = [point.objective]
        for passes in range(1, self.max_iterations + 2):
            states = filter_frames(run.prior, point.frames, run.Q)
            smoothed = smooth_frames(states)
            detail = f"{passes} passes over {len(self.sizes)} frames"
            step = smoothed.mean - point.mean
            # The linearised objective is smallest at the end of the step.
            decrease = point.objective - run.linear_objective(point.frames, smoothed.mean)
            if np.all(np.abs(step) <= self.tolerance * smoothed.std) or (
                decrease <= ROUND_OFF * point.objective
            ):
                reason = Reason.CONVERGED
                break
            if passes > self.max_iterations:
                reason = Reason.MAX_ITERATIONS
                break
            descent = run.descend(point, step)
            if not isinstance(descent, _Path):
                reason = Reason.NO_DECREASE if descent is None else Reason.MODEL_FAILED
                detail += "" if descent is None else f"; {descent}"
                break
            point = descent
            objectives.append(point.objective)
        if not reason.converged:
            # Its step has not been tried, or was refused.
            smoothed = Trajectory(point.mean, smoothed.covariance)
        return run.finish(reason, detail, states, smoothed, tuple(objectives))


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """A trajectory (f, p) in filter coordinates, the frames linearised there, and J."""

    mean: FloatArray
    frames: list[LinearFrame]
    objective: float


class _DriftRun:
    """One smoothing: its problem in filter coordinates and its count of solves."""

    def __init__(
        self,
        smoother: DriftSmoother,
        model: FrameModel,
        initial: Gaussian,
        y: FloatArray,
        R: NoiseCovariance,
        transform: Transform,
    ) -> None:
        self.model, self.transform = model, transform
        self.prior = to_filter(transform, initial)
        self.Q = np.asarray(smoother.Q, dtype=np.float64)
        self.walk = random_walk(self.prior, self.Q, len(smoother.sizes))
        self.y = split_frames(np.asarray(y, dtype=np.float64), smoother.sizes)
        self.noises: list[ObservationNoise] = frame_noises(R, smoother.sizes)
        self.forward_solves = 0
        self.extended: tuple[FrameState, ...] = ()

    def frame(self, k: int, z: FloatArray) -> tuple[LinearFrame, float] | str:
        """Frame k linearised at z (p,) and its share of J, or why the model failed."""
        self.forward_solves += 1
        m = self.transform.inverse(z)
        prediction = predict(partial(self.model.frame, k), m, len(self.y[k]), derivatives=True)
        if not prediction.converged:
            return f"frame {k} at {m}: {prediction.reason}"
        H = prediction.jacobian * self.transform.derivative(z)
        misfit = self.noises[k].whiten(self.y[k] - prediction.y)
        return LinearFrame(self.y[k] - prediction.y + H @ z, H, self.noises[k]), _half(misfit)

    def extend(self) -> str | None:
        """The first pass, or why the model failed in it."""
        frames: list[LinearFrame] = []
        for k in range(len(self.y)):
            # The prediction of frame k depends on no observation of it.
            linear = self.frame(k, self.extended[-1].filtered.mean if k else self.prior.mean)
            if isinstance(linear, str):
                return linear
            frames.append(linear[0])
            self.extended = filter_frames(self.prior, frames, self.Q)
        return None

    def linearise(self, mean: FloatArray) -> "_Path | str":
        """All frames linearised at the trajectory ``mean (f, p)``."""
        frames, objective = [], self._prior_objective(mean)
        for k, z in enumerate(mean):
            linear = self.frame(k, z)
            if isinstance(linear, str):
                return linear
            frames.append(linear[0])
            objective += linear[1]
        return _Path(mean, frames, objective)

    def descend(self, path: _Path, step: FloatArray) -> "_Path | str | None":
        """The first path on the way back from the whole step that lowers J.

        None if there is none, the model's words if it failed at the last that was tried.
        """
        failure: str | None = None
        for k in range(HALVINGS + 1):
            trial = self.linearise(path.mean + 0.5**k * step)
            if isinstance(trial, str):
                failure = trial
            elif trial.objective < path.objective:
                return trial
            else:
                failure = None
        return failure

    def linear_objective(self, frames: list[LinearFrame], mean: FloatArray) -> float:
        """J of the linearised frames at the trajectory ``mean (f, p)``."""
        misfits = [f.noise.whiten(f.y - f.H @ z) for f, z in zip(frames, mean, strict=True)]
        return self._prior_objective(mean) + sum(map(_half, misfits))

    def _prior_objective(self, mean: FloatArray) -> float:
        offset = mean.ravel() - self.walk.mean
        return _half(np.asarray(np.linalg.lstsq(self.walk.factor, offset, rcond=None)[0]))

    def finish(
        self,
        reason: Reason,
        detail: str,
        states: tuple[FrameState, ...] = (),
        smoothed: Trajectory | None = None,
        objectives: tuple[float, ...] = (),
    ) -> DriftEstimate:
        """The result."""
        return DriftEstimate(
            self.transform,
            states,
            self.extended,
            smoothed,
            reason,
            detail,
            self.forward_solves,
            objectives,
        )


def _half(x: FloatArray) -> float:
    """Half of the squared length."""
    return 0.5 * float(x @ x)
