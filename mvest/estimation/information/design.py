"""Which observation would determine a parameter, from the Jacobians of one run of the model.

Information of independent observations adds up and grows with the inverse square of the noise, so
that designs of any size are compared without running the model again. Each is a p × p triangle T
with Tᵀ T = (W H D)ᵀ (W H D) for noise of unit standard deviation, D = diag(values)
(Kay, Fundamentals of Statistical Signal Processing I, 1993, sections 3.7 and 3.8). All standard
deviations are relative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.information.identifiability import Identifiability, identifiability
from mvest.estimation.noise import NoiseCovariance, observation_noise
from mvest.estimation.prediction import require_positive
from mvest.typing import FloatArray

NOISE_RANGE = (1e-6, 1e6)
"""Range of a needed noise, in units of the observation."""


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Information of an observation about p parameters, for noise of unit standard deviation."""

    names: tuple[str, ...]  #: tuple of str, (p,)
    #: (p,) in the units of the parameters, positive; where the Jacobian was computed
    values: FloatArray
    triangle: FloatArray  #: (p, p), T

    @classmethod
    def of(
        cls, H: FloatArray, R: NoiseCovariance, values: FloatArray, names: Sequence[str]
    ) -> Design:
        """The design of Jacobian H (n, p) and noise covariance R at unit standard deviation."""
        require_positive(values, "a value of a design")
        return cls(tuple(names), values, _triangle(observation_noise(R, len(H)).whiten(H) * values))

    def at(self, noise: float, knowledge: Mapping[str, float] | None = None) -> Identifiability:
        """Identifiability with noise of a standard deviation, in units of the observation.

        ``knowledge`` are prior relative standard deviations: 0 for known parameters, which are left
        out, and infinite if not named. InputError if noise or knowledge are not admissible.
        """
        knowledge = dict(knowledge or {})
        strange = sorted(set(knowledge) - set(self.names))
        if strange or not all(std >= 0.0 for std in knowledge.values()):
            raise InputError(f"knowledge {knowledge}, expected deviations of {self.names}")
        if not (np.isfinite(noise) and noise > 0.0):
            raise InputError(f"noise = {noise}, expected > 0")
        free = [k for k, name in enumerate(self.names) if knowledge.get(name) != 0.0]
        if not free:
            raise InputError("every parameter is known; expected an unknown one")
        before = [1.0 / knowledge.get(self.names[k], np.inf) for k in free]
        rows = np.concatenate([self.triangle[:, free] / noise, np.diag(before)])
        names = tuple(self.names[k] for k in free)
        # The rows are already scaled by the values.
        return identifiability(rows, 1.0, np.ones(len(free)), names=names)

    def std(self, name: str, noise: float, knowledge: Mapping[str, float] | None = None) -> float:
        """Relative standard deviation of one parameter; infinite if it is not determined."""
        bound = self.at(noise, knowledge)
        if name not in bound.names:
            raise InputError(f"{name!r} is not unknown; expected one of {bound.names}")
        return float(bound.std[bound.names.index(name)])

    def needed_noise(
        self, name: str, target: float, knowledge: Mapping[str, float] | None = None
    ) -> float:
        """Noise with which a parameter has the relative standard deviation `target`.

        Zero if no noise is small enough, infinite if no data are needed. The mean of N independent
        observations has their noise / √N.
        """
        return needed(lambda noise: self.std(name, noise, knowledge) / target, NOISE_RANGE)


def needed(relative: Callable[[float], float], within: tuple[float, float]) -> float:
    """Argument at which an increasing function is 1; 0 if it is above 1, infinite if below."""

    def excess(log: float) -> float:
        # The logarithm is nearly linear; infinite values stay comparable.
        return min(float(np.log(relative(float(np.exp(log))))), 1e3)

    low, high = np.log(within)
    if excess(low) > 0.0:
        return 0.0
    if excess(high) < 0.0:
        return np.inf
    return float(np.exp(scipy.optimize.brentq(excess, low, high, xtol=1e-12)))


def together(*designs: Design) -> Design:
    """Several observations with independent errors; InputError if names or values differ."""
    if len({(design.names, tuple(design.values)) for design in designs}) != 1:
        raise InputError("designs put together must be of the same parameters and values")
    stacked = np.concatenate([design.triangle for design in designs])
    return Design(designs[0].names, designs[0].values, _triangle(stacked))


def _triangle(rows: FloatArray) -> FloatArray:
    p = rows.shape[1]
    padded = rows if len(rows) >= p else np.concatenate([rows, np.zeros((p - len(rows), p))])
    return np.asarray(np.linalg.qr(padded, mode="r"))
