"""Consistency of errors and innovations with their covariances.

The tests follow Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation (2001), section 5.4. Each takes plain arrays.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import require_finite
from mvest.typing import FloatArray


def chi_square_band(degrees_of_freedom: float, level: float = 0.95) -> tuple[float, float]:
    """Central band that holds a chi-square number with probability `level`.

    InputError without a degree of freedom, or if the level is not between 0 and 1.
    """
    if not degrees_of_freedom > 0 or not 0.0 < level < 1.0:
        raise InputError(
            f"a chi-square band needs at least one degree of freedom and a level between 0 and 1; "
            f"got {degrees_of_freedom:g} and {level:g}"
        )
    # A chi-square number with k degrees of freedom is twice a gamma number of shape k/2.
    shape = 0.5 * degrees_of_freedom
    tail = 0.5 * (1.0 - level)
    low, high = scipy.special.gammaincinv(shape, [tail, 1.0 - tail])
    return 2.0 * float(low), 2.0 * float(high)


def nees(error: FloatArray, covariance: FloatArray) -> float:
    """Normalised estimation error squared eᵀ P⁻¹ e of the error e (p,) of an estimate.

    Chi-square with p degrees of freedom if the estimate is unbiased and P (p, p), positive
    definite, is its covariance.
    """
    of = Gaussian(error, covariance)
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(of.covariance), of.mean)
    except np.linalg.LinAlgError as problem:
        raise InputError(
            f"NEES needs a positive definite covariance; got\n{covariance}"
        ) from problem
    return float(whitened @ whitened)


@dataclass(frozen=True, slots=True)
class ZTest:
    """A measured statistic, with its mean and standard deviation if the null hypothesis holds."""

    statistic: float
    expected: float
    std: float

    @property
    def z(self) -> float:
        """Distance from the expectation in standard deviations."""
        return (self.statistic - self.expected) / self.std

    @property
    def p_value(self) -> float:
        """Two-sided probability of a larger distance, from the normal limit."""
        return 2.0 * float(scipy.special.ndtr(-abs(self.z)))


def zero_mean(innovation: FloatArray) -> ZTest:
    """Test that uncorrelated innovations (n,) of equal variance have the mean zero.

    The variance is estimated from the data. The innovations need not be normal if there are some
    thirty of them, by the central limit theorem.
    """
    w = _series(innovation)
    return ZTest(float(w.mean()), 0.0, float(w.std(ddof=1) / np.sqrt(w.size)))


def moran(innovation: FloatArray, neighbours: "scipy.sparse.sparray[Any, Any]") -> ZTest:
    """Moran's I: test that innovations (n,) at neighbouring points are uncorrelated.

    ``neighbours``, sparse (n, n), has the weight of each pair of points, non-negative with a zero
    diagonal (for example a mesh's adjacency). The expectation of I is −1/(n − 1); its standard
    deviation is that of independent normal numbers (Cliff and Ord, Spatial Processes, 1981,
    eq. 2.28).
    """
    w = _series(innovation)
    n = w.size
    A = scipy.sparse.csc_array(cast(Any, neighbours), dtype=np.float64)
    if A.shape != (n, n):
        raise InputError(f"neighbours must have shape ({n}, {n}); got {A.shape}")
    if A.nnz == 0 or np.any(A.data < 0.0) or np.any(A.diagonal() != 0.0):
        raise InputError("neighbours need non-negative weights, a zero diagonal and one pair")
    w = w - w.mean()
    S0 = float(A.sum())
    S1 = 0.5 * float(((A + A.T).power(2)).sum())
    S2 = float(np.sum((A.sum(axis=0) + A.sum(axis=1)) ** 2))
    I = n / S0 * float(w @ (A @ w)) / float(w @ w)
    expected = -1.0 / (n - 1)
    variance = (n**2 * S1 - n * S2 + 3.0 * S0**2) / ((n**2 - 1.0) * S0**2) - expected**2
    return ZTest(I, expected, float(np.sqrt(variance)))


def _series(innovation: FloatArray) -> FloatArray:
    w = np.asarray(innovation, dtype=np.float64)
    if w.ndim != 1 or w.size < 3:
        raise InputError(f"innovations must have shape (n,) with n at least 3; got {w.shape}")
    require_finite(w, "the innovations")
    if np.ptp(w) == 0.0:
        raise InputError(f"all {w.size} innovations equal {w[0]:g}: nothing to test")
    return w
