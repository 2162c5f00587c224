"""Consistency of errors and innovations with their covariances.

Follows Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation
(2001), section 5.4.
"""

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
    tail = 0.5 * (1.0 - level)
    low, high = scipy.special.gammaincinv(0.5 * degrees_of_freedom, [tail, 1.0 - tail])
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


def moran(innovation: FloatArray, neighbours: "scipy.sparse.sparray[Any, Any]") -> float:
    """Moran's I, the correlation of innovations (n,) at neighbouring points.

    ``neighbours``, sparse (n, n), has the weight of each pair of points, non-negative with a zero
    diagonal (for example a mesh's adjacency). Independent innovations have the expectation
    −1/(n − 1) (Cliff and Ord, Spatial Processes, 1981, section 1.3).
    """
    w = np.asarray(innovation, dtype=np.float64)
    require_finite(w, "the innovations")
    if w.ndim != 1 or w.size < 3 or np.ptp(w) == 0.0:
        raise InputError(f"innovations of shape {w.shape}, expected (n,) different numbers, n >= 3")
    A = scipy.sparse.csc_array(cast(Any, neighbours), dtype=np.float64)
    if A.shape != (w.size, w.size):
        raise InputError(f"neighbours must have shape ({w.size}, {w.size}); got {A.shape}")
    if A.nnz == 0 or np.any(A.data < 0.0) or np.any(A.diagonal() != 0.0):
        raise InputError("neighbours need non-negative weights, a zero diagonal and one pair")
    w = w - w.mean()
    return w.size / float(A.sum()) * float(w @ (A @ w)) / float(w @ w)
