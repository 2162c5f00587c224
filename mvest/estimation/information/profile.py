"""Profile likelihoods: how far one parameter can move if all others may follow it.

A Cramér-Rao bound is a statement about one point. The profile of a parameter holds it at values on
a grid and minimises the misfit over all others; it follows a curved valley to wherever it leads, so
that an interval may be one-sided, or have no end (Raue et al., Bioinformatics 25 (2009) 1923-1929,
section 2.3; Murphy and van der Vaart, J. Am. Stat. Assoc. 95 (2000) 449-465).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseCovariance, ObservationNoise, observation_noise
from mvest.estimation.prediction import ObservationModel, predict, require_finite
from mvest.estimation.transform import Identity, Transform, to_filter
from mvest.typing import FloatArray, IntArray

__all__ = ["CROSSED", "GRID_ENDED", "Profile", "profile"]

CROSSED = "crossed the threshold"
GRID_ENDED = "the grid ended below the threshold"

PRECISION = 1e-6
"""Deviance that a further Gauss-Newton step would gain, below which a point is a minimum: the
threshold of a 95 % interval is 3.84."""

ROUND_OFF = 1e-12
"""Decrease of the deviance, as a part of it, that cannot be distinguished from rounding."""

MAX_STEPS = 20
MAX_HALVINGS = 8

BEYOND = 2.0
"""Standard deviations beyond the threshold up to which a profile is followed."""


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """The smallest misfit with one parameter held at each of g values.

    Attributes
    ----------
    names : tuple of str, (p,)
    index : int
        Which parameter is held.
    path : (g, p) in the units of the parameters
        All parameters where the misfit is smallest, the held one ascending: the valley's floor.
    deviance : (g,)
        D less its smallest value on the path, D = ``|W (y - h(m))|²`` plus the prior's part; -2 log
        of the profile likelihood ratio.
    threshold : float
        Quantile of chi-square with one degree of freedom.
    low, high : float
        Where the profile crosses the threshold, in the unit of the held parameter; -inf or inf
        where it does not as far as it was followed: the interval is open there.
    ends : (str, str)
        Why the path ends at its lower and at its upper end.
    """

    names: tuple[str, ...]
    index: int
    path: FloatArray
    deviance: FloatArray
    threshold: float
    low: float
    high: float
    ends: tuple[str, str]

    @property
    def name(self) -> str:
        """The parameter that is held."""
        return self.names[self.index]

    @property
    def values(self) -> FloatArray:
        """Values (g,) at which it is held."""
        return self.path[:, self.index]

    @property
    def identifiable(self) -> bool:
        """Whether the interval has two ends (practical identifiability of Raue et al.)."""
        return bool(np.isfinite(self.low) and np.isfinite(self.high))

    @property
    def flat(self) -> bool:
        """Whether the data give it no bound on either side, as far as it was followed."""
        return not (np.isfinite(self.low) or np.isfinite(self.high))


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """A point in filter coordinates with its whitened residual and that one's Jacobian."""

    z: FloatArray
    residual: FloatArray
    jacobian: FloatArray

    @property
    def deviance(self) -> float:
        return float(self.residual @ self.residual)


def profile(
    model: ObservationModel,
    y: FloatArray,
    R: NoiseCovariance,
    start: FloatArray,
    index: int,
    offsets: FloatArray,
    *,
    names: Sequence[str] | None = None,
    transform: Transform | None = None,
    prior: Gaussian | None = None,
    level: float = 0.95,
) -> Profile:
    """Follow the profile of one parameter to both sides of the best fit.

    Each point is found by Gauss-Newton from its neighbour, moved along the valley as the Jacobian J
    there says: if the held coordinate changes by d, the others change by the least-squares solution
    of J_others s = -J_held d. A side ends when the model fails there, when the grid does, or two
    standard deviations beyond the threshold.

    Parameters
    ----------
    model : ObservationModel
    y : (n,)
    R : covariance of y
    start : (p,)
        Parameters from which the best fit is looked for.
    index : int
        Which parameter is held.
    offsets : (g,)
        Where it is held, as distances from the best fit in filter coordinates: with `Log`, 0.1
        is a factor of 1.1.
    names : p names, optional
    transform : Transform, optional
        Filter coordinates; the parameters themselves if not given.
    prior : Gaussian, optional
        Of all parameters: the profile is then that of the posterior.
    level : float
        Confidence of the interval.

    Raises
    ------
    InputError
        If an argument is not admissible, or there is no fit to start from.
    """
    start = np.asarray(start, dtype=np.float64)
    offsets = np.unique(np.asarray(offsets, dtype=np.float64))
    require_finite(offsets, "the offsets of a profile")
    names = tuple(f"m[{i}]" for i in range(start.size)) if names is None else tuple(names)
    if not 0 <= index < start.size or len(names) != start.size:
        raise InputError(f"profile of parameter {index} of {start.size} with names {names}")
    if not (np.any(offsets < 0.0) and np.any(offsets > 0.0)):
        raise InputError("a profile needs offsets on both sides of zero")
    if not 0.0 < level < 1.0:
        raise InputError(f"level of an interval {level}, expected between 0 and 1")
    fit = _Fit(model, np.asarray(y, dtype=np.float64), R, transform or Identity(), prior)
    first = fit.point(fit.transform.forward(start))
    if isinstance(first, str):
        raise InputError(f"the model has no prediction to start a profile from: {first}")
    everything = np.arange(start.size)
    best = fit.minimise(first, everything)
    threshold = float(scipy.stats.chi2.ppf(level, 1))
    below, end_below = _side(fit, best, index, offsets[offsets < 0.0][::-1], threshold)
    above, end_above = _side(fit, best, index, offsets[offsets > 0.0], threshold)
    points = [*below[::-1], best, *above]
    z = np.array([point.z for point in points])
    deviance = np.array([point.deviance for point in points])
    deviance = deviance - deviance.min()
    at = len(below)
    low = _crossing(z[at::-1, index], deviance[at::-1], threshold)
    high = _crossing(z[at:, index], deviance[at:], threshold)

    def parameter(value: float | None, open_end: float) -> float:
        if value is None:
            return open_end
        whole = best.z.copy()
        whole[index] = value
        return float(fit.transform.inverse(whole)[index])

    return Profile(
        names,
        index,
        np.array([fit.transform.inverse(row) for row in z]),
        deviance,
        threshold,
        parameter(low, -np.inf),
        parameter(high, np.inf),
        (end_below, end_above),
    )


class _Fit:
    """The misfit of a model in filter coordinates."""

    def __init__(
        self,
        model: ObservationModel,
        y: FloatArray,
        R: NoiseCovariance,
        transform: Transform,
        prior: Gaussian | None,
    ) -> None:
        self.model, self.y, self.transform = model, y, transform
        self.noise: ObservationNoise = observation_noise(R, y.size)
        self.prior = None if prior is None else to_filter(transform, prior)
        if self.prior is not None:
            try:
                self.root = np.linalg.inv(self.prior.factor)
            except np.linalg.LinAlgError as error:
                raise InputError("a profile's prior must be positive definite") from error

    def point(self, z: FloatArray) -> _Point | str:
        """Residual and Jacobian at z (p,), or why there is none."""
        m = self.transform.inverse(z)
        prediction = predict(self.model, m, self.y.size, derivatives=True)
        if not prediction.converged:
            return prediction.reason
        residual = self.noise.whiten(self.y - prediction.y)
        jacobian = -self.noise.whiten(prediction.jacobian * self.transform.derivative(z))
        if self.prior is not None:
            residual = np.concatenate([residual, self.root @ (z - self.prior.mean)])
            jacobian = np.concatenate([jacobian, self.root])
        return _Point(z, residual, jacobian)

    def minimise(self, point: _Point, free: IntArray) -> _Point:
        """The best fit over the free coordinates by Gauss-Newton, each step halved until it helps.

        Where no step helps any more, that is as good as the model can be evaluated.
        """
        for _ in range(MAX_STEPS):
            J = point.jacobian[:, free]
            # The smallest of all steps where the data leave a combination undetermined.
            step = np.linalg.lstsq(J, -point.residual, rcond=None)[0]
            left = point.residual + J @ step
            gain = point.deviance - float(left @ left)
            if gain <= max(PRECISION, ROUND_OFF * point.deviance):
                return point
            for halving in range(MAX_HALVINGS + 1):
                z = point.z.copy()
                z[free] += step * 0.5**halving
                trial = self.point(z)
                if not isinstance(trial, str) and trial.deviance < point.deviance:
                    point = trial
                    break
            else:
                return point
        return point


def _side(
    fit: _Fit, best: _Point, index: int, offsets: FloatArray, threshold: float
) -> tuple[list[_Point], str]:
    """Points of one side, outwards, and why they end."""
    free = np.delete(np.arange(best.z.size), index)
    point = best
    points: list[_Point] = []
    for offset in offsets:
        change = best.z[index] + offset - point.z[index]
        z = point.z.copy()
        z[index] += change
        if free.size:
            follow = np.linalg.lstsq(
                point.jacobian[:, free], -point.jacobian[:, index] * change, rcond=None
            )[0]
            z[free] += follow
        trial = fit.point(z)
        if isinstance(trial, str):
            return points, f"the model has no prediction: {trial}"
        point = fit.minimise(trial, free) if free.size else trial
        points.append(point)
        if np.sqrt(max(point.deviance - best.deviance, 0.0)) > np.sqrt(threshold) + BEYOND:
            break
    reached = any(point.deviance - best.deviance > threshold for point in points)
    return points, CROSSED if reached else GRID_ENDED


def _crossing(z: FloatArray, deviance: FloatArray, threshold: float) -> float | None:
    """First crossing of the threshold outwards from the best fit; None if there is none.

    The root of the deviance is interpolated, which is linear where the model is.
    """
    root, level = np.sqrt(deviance), np.sqrt(threshold)
    above = np.flatnonzero(root > level)
    if not above.size or above[0] == 0:
        return None
    k = int(above[0])
    share = (level - root[k - 1]) / (root[k] - root[k - 1])
    return float(z[k - 1] + share * (z[k] - z[k - 1]))
