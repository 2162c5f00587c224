"""Coordinates in which a filter works: the parameters themselves, or their logarithms."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.typing import FloatArray


class Transform(Protocol):
    """Smooth increasing map z = T(m) of each parameter by itself."""

    def forward(self, m: FloatArray, /) -> FloatArray:
        """Filter coordinates z (p,) of parameters m (p,); InputError outside the domain."""
        ...

    def inverse(self, z: FloatArray, /) -> FloatArray:
        """Parameters m (p,) of filter coordinates z (p,); infinite where m overflows."""
        ...

    def derivative(self, z: FloatArray, /) -> FloatArray:
        """dm/dz of each parameter, (p,)."""
        ...


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
    """z = log m for positive parameters; every iterate and interval stays positive.

    Attributes
    ----------
    positive : tuple of bool, one for each parameter, or None
        Which parameters are taken in logarithms; None takes all.
    """

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

    def _mask(self, m: FloatArray) -> "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]":
        if self.positive is None:
            return np.ones(m.shape, dtype=np.bool_)
        if len(self.positive) != m.size:
            raise InputError(
                f"Log(positive) names {len(self.positive)} parameters, but there are {m.size}"
            )
        return np.array(self.positive, dtype=np.bool_)


def to_filter(transform: Transform, physical: Gaussian) -> Gaussian:
    """N(m, P) in filter coordinates to first order: N(T(m), D⁻¹ P D⁻¹) with D = dm/dz at T(m).

    For the logarithm m becomes the median, and a relative deviation becomes an absolute one.
    """
    z = transform.forward(physical.mean)
    D = transform.derivative(z)
    return Gaussian(z, physical.covariance / np.outer(D, D))


def covariance_to_physical(transform: Transform, z: FloatArray, P: FloatArray) -> FloatArray:
    """D P D with D = dm/dz at z: a covariance (p, p) of filter coordinates in parameters."""
    D = transform.derivative(z)
    return P * np.outer(D, D)
