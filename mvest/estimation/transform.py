"""Coordinates z in which a filter works: the parameters m themselves, or their logarithms.

``forward`` is z = T(m), ``inverse`` is m (infinite if it overflows), ``derivative`` is dm/dz; all
are (p,).
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.typing import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Identity:
    """z = m."""

    def forward(self, m: FloatArray, /) -> FloatArray:
        """Return m."""
        return m

    def inverse(self, z: FloatArray, /) -> FloatArray:
        """Return z."""
        return z

    def derivative(self, z: FloatArray, /) -> FloatArray:
        """Return ones."""
        return np.ones_like(z)


@dataclass(frozen=True, slots=True)
class Log:
    """z = log m for positive parameters; every iterate and interval stays positive."""

    #: tuple of bool, one for each parameter, or None, which parameters are taken in logarithms;
    #: None takes all
    positive: tuple[bool, ...] | None = None

    def forward(self, m: FloatArray, /) -> FloatArray:
        """Logarithms of the positive parameters; InputError if one is not positive."""
        mask = self._mask(m)
        if np.any(m[mask] <= 0.0):
            i = int(np.flatnonzero(mask & (m <= 0.0))[0])
            raise InputError(
                f"a parameter estimated by its logarithm must be positive; "
                f"parameter {i} is {m[i]:g}"
            )
        return np.log(m, out=np.array(m, dtype=np.float64), where=mask)

    def inverse(self, z: FloatArray, /) -> FloatArray:
        """Exponentials of the logarithms."""
        with np.errstate(over="ignore", under="ignore"):
            return np.exp(z, out=np.array(z, dtype=np.float64), where=self._mask(z))

    def derivative(self, z: FloatArray, /) -> FloatArray:
        """dm/dz = m where the logarithm is taken, else 1."""
        with np.errstate(over="ignore", under="ignore"):
            return np.exp(z, out=np.ones_like(z, dtype=np.float64), where=self._mask(z))

    def _mask(self, m: FloatArray) -> BoolArray:
        if self.positive is None:
            return np.ones(m.shape, dtype=np.bool_)
        if len(self.positive) != m.size:
            raise InputError(
                f"Log(positive) names {len(self.positive)} parameters, but there are {m.size}"
            )
        return np.array(self.positive, dtype=np.bool_)


Transform: TypeAlias = Identity | Log


def to_filter(transform: Transform, physical: Gaussian) -> Gaussian:
    """N(m, P) in filter coordinates to first order: N(T(m), D⁻¹ P D⁻¹) with D = dm/dz at T(m)."""
    z = transform.forward(physical.mean)
    D = transform.derivative(z)
    return Gaussian(z, physical.covariance / np.outer(D, D))


def covariance_to_physical(transform: Transform, z: FloatArray, P: FloatArray) -> FloatArray:
    """D P D with D = dm/dz at z: a covariance (p, p) of filter coordinates in parameters."""
    D = transform.derivative(z)
    return P * np.outer(D, D)
