"""Normal distributions of parameters, checked on construction."""

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.estimation.prediction import read_only, require_finite
from mvest.typing import FloatArray

SYMMETRY_TOLERANCE = 1e-10
"""Asymmetry of a covariance below this is round-off, relative to the standard deviations."""

DEFINITENESS_TOLERANCE = 1e-12
"""Negative eigenvalues of a correlation matrix above minus this are round-off, per parameter."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """Normal distribution N(m, P) of p parameters.

    InputError if shapes disagree, a value is not finite, or the covariance is not symmetric
    positive semi-definite; the message gives the offending values.
    """

    mean: FloatArray  #: (p,) in units of each parameter
    #: (p, p) in products of these units, symmetric positive semi-definite. A zero variance holds a
    #: parameter fixed.
    covariance: FloatArray

    def __post_init__(self) -> None:
        mean = np.array(self.mean, dtype=np.float64)
        if mean.ndim != 1 or mean.size == 0:
            raise InputError(f"a mean must have shape (p,) with p at least 1; got {mean.shape}")
        require_finite(mean, "the mean")
        covariance = checked_covariance(self.covariance, mean.size, "the covariance")
        object.__setattr__(self, "mean", read_only(mean))
        object.__setattr__(self, "covariance", read_only(covariance))

    @classmethod
    def from_variance(cls, mean: FloatArray, variance: float | FloatArray) -> "Gaussian":
        """N(mean, P) with P = variance·I, diag(variance) or the full (p, p) matrix given."""
        mean = np.asarray(mean, dtype=np.float64)
        return cls(mean, as_covariance(variance, mean.size, "the variance"))

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return self.mean.size

    @property
    def std(self) -> FloatArray:
        """Standard deviations (p,)."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def factor(self) -> FloatArray:
        """A square root L (p, p) of the covariance, P = L Lᵀ.

        Triangular (Cholesky) if P is positive definite, otherwise from the eigenvectors; scaled by
        the standard deviations first, so that units do not matter.
        """
        correlation, std = _correlation(self.covariance)
        try:
            root = np.linalg.cholesky(correlation)
        except np.linalg.LinAlgError:
            values, vectors = np.linalg.eigh(correlation)
            # Negative values are round-off: the constructor refuses all others.
            root = vectors * np.sqrt(np.maximum(values, 0.0))
        return std[:, None] * root


def standard(prior: Gaussian, other: Gaussian) -> Gaussian:
    """Another Gaussian of the same parameters, in coordinates in which the prior is N(0, I)."""
    inverse = np.linalg.pinv(prior.factor)
    P = inverse @ other.covariance @ inverse.T
    # Fixed parameters have unit variance in these coordinates.
    fixed = np.eye(len(P)) - inverse @ prior.factor
    return Gaussian(inverse @ (other.mean - prior.mean), P + fixed @ fixed.T)


def as_covariance(variance: float | FloatArray, size: int, what: str) -> FloatArray:
    """Covariance (p, p) from one variance, p variances or a full matrix; InputError if none."""
    values = np.asarray(variance, dtype=np.float64)
    if values.ndim == 0:
        values = np.full(size, values)
    if values.shape == (size,):
        values = np.diag(values)
    return checked_covariance(values, size, what)


def checked_covariance(covariance: FloatArray, size: int, what: str) -> FloatArray:
    """A symmetrised copy (p, p) of a covariance; InputError if it is none."""
    P = np.array(covariance, dtype=np.float64)
    if P.shape != (size, size):
        raise InputError(f"{what} must have shape ({size}, {size}); got {P.shape}")
    require_finite(P, what)
    variances = np.diagonal(P)
    if np.any(variances < 0.0):
        worst = int(np.argmin(variances))
        raise InputError(f"{what} has a negative variance {variances[worst]:g} in row {worst}")
    std = np.sqrt(variances)
    bound = np.outer(std, std)
    asymmetry = np.abs(P - P.T)
    if np.any(asymmetry > SYMMETRY_TOLERANCE * bound):
        i, j = divmod(int(np.argmax(asymmetry)), size)
        raise InputError(
            f"{what} must be symmetric; entry ({i}, {j}) is {P[i, j]:g} "
            f"and entry ({j}, {i}) is {P[j, i]:g}"
        )
    P = 0.5 * (P + P.T)
    smallest = float(np.linalg.eigvalsh(_correlation(P)[0])[0])
    if smallest < -DEFINITENESS_TOLERANCE * size or np.any((bound == 0.0) & (P != 0.0)):
        raise InputError(
            f"{what} must be positive semi-definite; the smallest eigenvalue of its correlation "
            f"matrix is {smallest:g}:\n{P}"
        )
    return P


def _correlation(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Correlation matrix (rows of zero variance stay zero) and standard deviations."""
    std = np.sqrt(np.diagonal(P))
    inverse = np.divide(1.0, std, out=np.zeros_like(std), where=std > 0.0)
    return P * np.outer(inverse, inverse), std
