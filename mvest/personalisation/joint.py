"""The posterior of a case's parameters and of the errors of its geometry together."""

from __future__ import annotations

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
"""Of how far a step towards the geometry that is expected is gone."""

AS_PROMISED = 0.75
"""Part of the gain that a first order promises with which a step is good enough."""


@dataclass(frozen=True)
class JointPosterior:
    """Of parameters m and modes of the geometry's errors, with all other errors as learned.

    Attributes
    ----------
    prior : Gaussian
        Of the parameters in filter coordinates.
    transform : Transform
    observation : Observed
        As it was seen.
    errors : FrameErrors
        With what the geometry does.
    learned : LearnedNoise or None
        By which they are known; None: as they are stated.
    """

    prior: Gaussian
    transform: Transform
    observation: Observed
    errors: FrameErrors
    learned: LearnedNoise | None

    @cached_property
    def noise(self) -> ObservationNoise:
        """Of the observation of a valve with a known geometry."""
        geometry = [source.name for source in self.errors.geometry]
        return self.errors.noise(self.learned, without=geometry)

    @cached_property
    def marginal(self) -> ObservationNoise:
        """Of the observation, with what all modes of the geometry add to it."""
        return low_rank_noise(self.noise, np.concatenate(self._sized, axis=1))

    @cached_property
    def _sized(self) -> tuple[FloatArray, ...]:
        """The observation by modes of unit variance, of each kind ``(k, q)``."""
        sizes = self.errors.geometry_sizes(self.learned)
        return tuple(s * own.rows for s, own in zip(sizes, self.errors.geometry, strict=True))

    def expected(self, residual: FloatArray) -> tuple[FloatArray, ...]:
        """Most probable modes ``(q,)`` of each kind, where the parameters are as estimated.

        Parameters
        ----------
        residual : (k,)
            Of the estimate, from a geometry as it was seen.
        """
        white = self.marginal.whiten(residual)
        return tuple(
            s * (self.marginal.whiten(rows).T @ white)
            for s, rows in zip(self.errors.geometry_sizes(self.learned), self._sized, strict=True)
        )

    def improbability(
        self, z: FloatArray, residual: FloatArray, modes: tuple[FloatArray, ...]
    ) -> float:
        """Twice the negative logarithm of the density, up to a constant.

        Parameters
        ----------
        z : (p,)
            Parameters in filter coordinates.
        residual : (k,)
            Of the observation.
        modes : tuple of (q,)
            Of each kind; empty: the geometry is as it was seen.
        """
        moved, white = z - self.prior.mean, self.noise.whiten(residual)
        own = moved @ np.linalg.solve(self.prior.covariance, moved)
        sizes = self.errors.geometry_sizes(self.learned) if modes else ()
        beside = sum(np.sum((q / s) ** 2) for q, s in zip(modes, sizes, strict=True))
        return float(own + white @ white + beside)

    def improbability_of(
        self, m: FloatArray, prediction: Prediction, modes: tuple[FloatArray, ...]
    ) -> float:
        """The same of a valve that was closed with parameters ``m (p,)`` and such a geometry."""
        seen = predict(self.observation.of(lambda _: prediction), m)
        return self.improbability(self.transform.forward(m), self.observation.y - seen.y, modes)

    def stepped(
        self, z: FloatArray, residual: FloatArray, H: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Parameters ``(p,)`` after one more step to their mode, and the residual ``(k,)`` there.

        To first order, whatever the modes are: a filter that ends as soon as its next step is
        small has not gone it.

        Parameters
        ----------
        z : (p,)
            An estimate in filter coordinates.
        residual : (k,)
            Of the observation that it was made from.
        H : (k, p)
            Derivatives of what is predicted there.
        """
        innovation = residual + H @ (z - self.prior.mean)
        end = kalman_update(self.prior, innovation, H, self.marginal).posterior.mean
        return end, residual - H @ (end - z)

    def refitted(self, m: FloatArray, prediction: Prediction) -> FloatArray:
        """Parameters ``(p,)`` with which a valve of this geometry fits best, to first order.

        Parameters
        ----------
        m : (p,)
            With which it was closed.
        prediction : Prediction
            What was predicted there, with derivatives.
        """
        z = self.transform.forward(m)
        seen = predict(self.observation.of(lambda _: prediction), m, derivatives=True)
        H = self.noise.whiten(seen.jacobian * self.transform.derivative(z))
        precision = np.linalg.inv(self.prior.covariance)
        slope = H.T @ self.noise.whiten(self.observation.y - seen.y)
        slope -= precision @ (z - self.prior.mean)
        return self.transform.inverse(z + np.linalg.solve(H.T @ H + precision, slope))


def damped_step(
    trial: Callable[[float], tuple[float, T] | str], here: float, promised: float
) -> T | str:
    """What is most probable on the way of a step of Gauss and Newton, or why there is nothing.

    All of the way where the first order on which it rests reaches as far, otherwise as far as a
    parabola through what is found has it, so that steps across a curved valley do not go to and
    fro. Empty if all of it could be tried and nothing was more probable than where it begins.

    Parameters
    ----------
    trial : callable
        Share of the way -> twice the negative logarithm of the density there and what is there, or
        why there is nothing.
    here : float
        The same where it begins.
    promised : float
        By how much it falls on all of the way, to first order.
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
        if promised <= 0.0 or here - value > AS_PROMISED * share * (2.0 - share) * promised:
            break
        # Positive: the gain is at most three quarters of what is promised.
        curvature = (value - here + 2.0 * share * promised) / share**2
        share = float(np.clip(promised / curvature, 0.2 * share, 0.8 * share))
    return why if best is None else best
