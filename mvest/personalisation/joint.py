"""The joint posterior of a case's parameters and the errors of its geometry."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import scipy

from mvest.estimation.evidence import LearnedNoise
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import ObservationNoise, low_rank_noise
from mvest.estimation.prediction import Prediction, predict
from mvest.estimation.transform import Transform
from mvest.estimation.update import kalman_update
from mvest.personalisation.errors import FrameErrors
from mvest.problem.estimate import Observed
from mvest.typing import FloatArray

T = TypeVar("T")

COMPARISONS = 10
"""Most Gauss-Newton steps of a comparison with linearly predicted frames. In three draws from the
prior of a simulated valve, distances to a surface took 7 to 9 steps, corresponding vertices 1."""

NEAR = 0.25
"""Standard deviations; a smaller step is the last one."""

TRIALS = 4
"""Lengths of one damped step that are tried."""

AS_PREDICTED = 0.75
"""Share of the gain predicted to first order that ends the damping of a step."""


@dataclass(frozen=True, eq=False)
class LinearFrames:
    """All frames of a model, linear in filter coordinates and geometry modes about one point."""

    z: FloatArray  #: (p,), of the point
    modes: tuple[FloatArray, ...]  #: of the point, (q,) by kind
    y: FloatArray  #: stacked coordinates in mm at the point
    slopes: FloatArray  #: their derivatives by z and the modes


@dataclass(frozen=True)
class JointPosterior:
    """Posterior of parameters m and geometry modes, with all other errors marginalised."""

    prior: Gaussian  #: of the parameters in filter coordinates z
    transform: Transform
    observation: Observed  #: as measured
    errors: FrameErrors  #: with linearised effects of the geometry
    learned: LearnedNoise | None  #: None: errors as stated

    @cached_property
    def noise(self) -> ObservationNoise:
        """Of the observation of a valve with a known geometry."""
        geometry = [source.name for source in self.errors.geometry]
        return self.errors.noise(self.learned, without=geometry)

    @cached_property
    def marginal(self) -> ObservationNoise:
        """Of the observation with the geometry marginalised."""
        return low_rank_noise(self.noise, np.concatenate(self._rows, axis=1))

    @cached_property
    def _rows(self) -> tuple[FloatArray, ...]:
        """Effect ``(k, q)`` of modes of unit variance on the observation, by kind."""
        sizes = self.errors.geometry_sizes(self.learned)
        return tuple(s * own.rows for s, own in zip(sizes, self.errors.geometry, strict=True))

    def expected(self, residual: FloatArray) -> tuple[FloatArray, ...]:
        """Most probable amplitudes ``(q,)`` of the modes by kind, at the estimated parameters.

        ``residual (k,)`` is that of the estimate from the measured geometry.
        """
        white = self.marginal.whiten(residual)
        return tuple(
            s * (self.marginal.whiten(rows).T @ white)
            for s, rows in zip(self.errors.geometry_sizes(self.learned), self._rows, strict=True)
        )

    def misfit(self, z: FloatArray, residual: FloatArray, modes: tuple[FloatArray, ...]) -> float:
        """Twice the negative logarithm of the density, up to a constant.

        At parameters ``z (p,)`` with the residual ``(k,)`` of the observation. The modes are the
        amplitudes ``(q,)`` by kind; empty: the measured geometry.
        """
        moved, white = z - self.prior.mean, self.noise.whiten(residual)
        own = moved @ np.linalg.solve(self.prior.covariance, moved)
        sizes = self.errors.geometry_sizes(self.learned) if modes else ()
        geometry = sum(np.sum((q / s) ** 2) for q, s in zip(modes, sizes, strict=True))
        return float(own + white @ white + geometry)

    def misfit_at(
        self, m: FloatArray, prediction: Prediction, modes: tuple[FloatArray, ...]
    ) -> float:
        """The misfit of a valve closed with parameters ``m (p,)`` and this geometry."""
        seen = predict(self.observation.of(lambda _: prediction), m)
        return self.misfit(self.transform.forward(m), self.observation.y - seen.y, modes)

    def compared(
        self, at: LinearFrames, z: FloatArray, modes: tuple[FloatArray, ...]
    ) -> tuple[FloatArray, tuple[FloatArray, ...], FloatArray]:
        """Joint mode for linearly predicted frames, whose comparison need not be linear.

        The distance of a point to a surface changes with the surface's direction, but costs little
        beside a closure. Gauss-Newton steps from parameters ``z (p,)`` and amplitudes ``modes
        (q,)`` by kind; returned are those of the mode, and the residual ``(k,)`` there.
        """
        sizes = self.errors.geometry_sizes(self.learned)
        spread = np.concatenate([np.full(len(q), s) for s, q in zip(sizes, modes, strict=True)])
        F = scipy.linalg.block_diag(self.prior.factor, np.diag(spread))
        ends = np.cumsum([len(z), *(len(q) for q in modes)])[:-1]
        centre = np.concatenate([self.prior.mean, np.zeros(len(spread))])
        start = np.concatenate([at.z, *at.modes])
        u = np.concatenate([z, *modes])
        for _ in range(COMPARISONS):
            frames = Prediction(at.y + at.slopes @ (u - start), at.slopes)
            seen = predict(self.observation.of(lambda _, y=frames: y), u, derivatives=True)
            residual = self.observation.y - seen.y
            W = self.noise.whiten(seen.jacobian @ F)
            hessian = W.T @ W + np.eye(len(u))
            v = scipy.linalg.solve_triangular(F, u - centre, lower=True)
            step = np.linalg.solve(hessian, W.T @ self.noise.whiten(residual) - v)
            u, residual = u + F @ step, residual - seen.jacobian @ (F @ step)
            if step @ hessian @ step < NEAR**2:
                break
        z, *found = np.split(u, ends)
        return z, tuple(found), residual

    def step(self, z: FloatArray, residual: FloatArray, H: FloatArray) -> FloatArray:
        """Parameters ``(p,)`` after a Gauss-Newton step with the geometry marginalised.

        From ``z (p,)``, with the residual ``(k,)`` and the derivatives ``H (k, p)`` there.
        """
        innovation = residual + H @ (z - self.prior.mean)
        return kalman_update(self.prior, innovation, H, self.marginal).posterior.mean

    def refitted(self, m: FloatArray, prediction: Prediction) -> FloatArray:
        """Best parameters ``(p,)`` for a known geometry, one Gauss-Newton step from ``m (p,)``.

        ``prediction`` is that of the closed valve at ``m``, with derivatives.
        """
        z = self.transform.forward(m)
        seen = predict(self.observation.of(lambda _: prediction), m, derivatives=True)
        H = self.noise.whiten(seen.jacobian * self.transform.derivative(z))
        precision = np.linalg.inv(self.prior.covariance)
        slope = H.T @ self.noise.whiten(self.observation.y - seen.y)
        slope -= precision @ (z - self.prior.mean)
        return self.transform.inverse(z + np.linalg.solve(H.T @ H + precision, slope))


def damped_step(
    trial: Callable[[float], tuple[float, T] | str], here: float, predicted: float
) -> T | str:
    """The best point along a Gauss-Newton step, or why there is none.

    The full step is taken where the first order holds; otherwise a parabola through the trials
    gives the length, so that steps across a curved valley do not oscillate. Empty if the full step
    was possible but nothing is better than the start.

    ``trial`` maps a share of the step to misfit and point there, or to the reason why there is
    none. The misfit is ``here`` at the start, and ``predicted`` lower after the full step to first
    order.
    """
    best: T | None = None
    lowest, share, why = here, 1.0, ""
    for _ in range(TRIALS):
        found = trial(share)
        if isinstance(found, str):
            why, share = found, 0.5 * share
            continue
        value, there = found
        if value < lowest:
            best, lowest = there, value
        if predicted <= 0.0 or here - value > AS_PREDICTED * share * (2.0 - share) * predicted:
            break
        # Positive, because the gain is at most three quarters of the predicted one.
        curvature = (value - here + 2.0 * share * predicted) / share**2
        share = float(np.clip(predicted / curvature, 0.2 * share, 0.8 * share))
    return why if best is None else best
