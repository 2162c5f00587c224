"""The joint posterior of a case's parameters and the errors of its geometry."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

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

TRIALS = 4
"""Lengths of one damped step that are tried."""

AS_PREDICTED = 0.75
"""Share of a trial's predicted gain that ends the damping of a step."""


@dataclass(frozen=True)
class JointPosterior:
    """Posterior of parameters m and geometry modes, with all other errors marginalised."""

    prior: Gaussian  #: of the parameters in filter coordinates z
    transform: Transform
    observation: Observed  #: as measured, and with the expected error of law and mesh
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

    The full step is taken where the first order holds; otherwise a parabola through the last trial
    gives the next length, so that steps across a curved valley do not oscillate, until a trial
    gains what its parabola predicts. Empty if the full step was possible but nothing is better than
    the start.

    ``trial`` maps a share of the step to misfit and point there, or to the reason why there is
    none. The misfit is ``here`` at the start, and ``predicted`` lower after the full step to first
    order.
    """
    best: T | None = None
    lowest, share, why = here, 1.0, ""
    curvature = predicted
    for _ in range(TRIALS):
        found = trial(share)
        if isinstance(found, str):
            why, share = found, 0.5 * share
            continue
        value, there = found
        if value < lowest:
            best, lowest = there, value
        promised = share * (2.0 * predicted - curvature * share)
        if predicted <= 0.0 or here - value > max(0.0, AS_PREDICTED * promised):
            break
        # Positive, because the gain is at most three quarters of the predicted one.
        curvature = (value - here + 2.0 * share * predicted) / share**2
        share = float(np.clip(predicted / curvature, 0.2 * share, 0.8 * share))
    return why if best is None else best
