"""Covariance R of the observation noise, used only through W with Wᵀ W = R⁻¹.

An n × n matrix is never formed densely: R is one variance, n variances, or a sparse matrix. Noise
with a structure of its own (see `kronecker_noise`) is given factorised.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, cast, runtime_checkable

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.gaussian import SYMMETRY_TOLERANCE
from mvest.estimation.prediction import require_finite
from mvest.typing import FloatArray

SparseMatrix: TypeAlias = "scipy.sparse.sparray[Any, Any] | scipy.sparse.spmatrix[Any]"
"""A sparse matrix of SciPy in any of its formats."""

CscMatrix: TypeAlias = "scipy.sparse.csc_array[np.float64]"
"""A sparse matrix by columns in double precision."""


@dataclass(frozen=True, slots=True)
class ObservationNoise:
    """Noise of n observations with covariance R.

    Attributes
    ----------
    size : int
        Number n of observations.
    log_determinant : float
        log det R.
    whiten : function from (n,) or (n, p) to the same shape
        Multiplies with W, where Wᵀ W = R⁻¹; whitened noise has the covariance I. Row i of the
        result belongs to observation i.
    """

    size: int
    log_determinant: float
    whiten: Callable[[FloatArray], FloatArray]


@runtime_checkable
class UncertainNoise(Protocol):
    """Noise that is not quite known: what is stated of it stands where nobody learns more."""

    @property
    def size(self) -> int:
        """Number n of observations."""
        ...

    def stated(self) -> ObservationNoise:
        """The noise as it is stated."""
        ...


NoiseCovariance: TypeAlias = "float | FloatArray | SparseMatrix | ObservationNoise | UncertainNoise"
"""R as one variance, n variances (n,), a sparse symmetric positive definite (n, n) matrix,
factorised already, or not quite known (see `mvest.estimation.noise_family`)."""


def observation_noise(R: NoiseCovariance, size: int) -> ObservationNoise:
    """Check a noise covariance and factorise it once.

    Parameters
    ----------
    R : NoiseCovariance, in squared units of the observation
    size : int
        Number n of observations.

    Raises
    ------
    InputError
        If R is dense, has the wrong size, or is not symmetric positive definite.
    """
    if isinstance(R, ObservationNoise | UncertainNoise):
        if R.size != size:
            raise InputError(f"R is of {R.size} observations, expected {size}")
        return R if isinstance(R, ObservationNoise) else R.stated()
    if isinstance(R, scipy.sparse.sparray | scipy.sparse.spmatrix):
        return _sparse_noise(csc(R), size)
    variance = np.asarray(R, dtype=np.float64)
    if variance.ndim != 0 and variance.shape != (size,):
        raise InputError(
            f"R must be one variance, the {size} variances of the observations, or a scipy.sparse "
            f"matrix of shape ({size}, {size}); got a dense array of shape {variance.shape}"
        )
    require_finite(np.atleast_1d(variance), "R")
    if np.any(variance <= 0.0):
        i = int(np.argmin(variance))
        raise InputError(f"R must be positive; variance {i} is {variance.flat[i]:g}")
    weight = 1.0 / np.sqrt(variance)

    def whiten(values: FloatArray) -> FloatArray:
        return (weight * values.T).T

    log_determinant = float(np.sum(np.log(np.broadcast_to(variance, (size,)))))
    return ObservationNoise(size, log_determinant, whiten)


def kronecker_noise(variance: float, root: FloatArray, copies: int) -> ObservationNoise:
    """Noise of points, each observed in several coordinates, R = variance · (L Lᵀ ⊗ I).

    Parameters
    ----------
    variance : float
        In squared units of the observation.
    root : (k, k)
        Lower triangular L with a positive diagonal.
    copies : int
        Coordinates of each point; they are independent and follow one another in the observation.
    """
    k = len(root)
    scale = 1.0 / np.sqrt(variance)

    def whiten(values: FloatArray) -> FloatArray:
        by_point = np.reshape(values, (k, -1))
        solved = scipy.linalg.solve_triangular(root, by_point, lower=True, check_finite=False)
        return scale * np.reshape(np.asarray(solved, dtype=np.float64), np.shape(values))

    log_determinant = copies * (k * np.log(variance) + 2.0 * np.sum(np.log(np.diagonal(root))))
    return ObservationNoise(copies * k, float(log_determinant), whiten)


def stacked_noise(parts: Sequence[ObservationNoise]) -> ObservationNoise:
    """Noise of observations one after another that are independent of each other."""
    ends = np.cumsum([part.size for part in parts])

    def whiten(values: FloatArray) -> FloatArray:
        pieces = np.split(values, ends[:-1])
        return np.concatenate([p.whiten(v) for p, v in zip(parts, pieces, strict=True)])

    return ObservationNoise(
        int(ends[-1]), float(sum(part.log_determinant for part in parts)), whiten
    )


def scaled_noise(base: ObservationNoise, scale: FloatArray) -> ObservationNoise:
    """Noise of which every observation is multiplied by a factor of its own, D R D.

    Parameters
    ----------
    base : ObservationNoise
        R of n observations.
    scale : (n,)
        The positive diagonal of D.

    Raises
    ------
    InputError
        If the factors are not of n observations, or not positive.
    """
    factor = np.asarray(scale, dtype=np.float64)
    if factor.shape != (base.size,):
        raise InputError(f"scale of noise has shape {factor.shape}, expected ({base.size},)")
    require_finite(factor, "scale of noise")
    if np.any(factor <= 0.0):
        raise InputError(f"scale of noise is {factor.min():g}, expected > 0")

    def whiten(values: FloatArray) -> FloatArray:
        return base.whiten((np.asarray(values).T / factor).T)

    return ObservationNoise(
        base.size, base.log_determinant + 2.0 * float(np.sum(np.log(factor))), whiten
    )


def low_rank_noise(base: ObservationNoise, columns: FloatArray) -> ObservationNoise:
    """Noise with what q unknown quantities add to it, R + C Cᵀ.

    With W of ``base`` and the thin singular value decomposition W C = U diag(s) Vᵀ::

        W (R + C Cᵀ) Wᵀ = I + U diag(s²) Uᵀ
        log det (R + C Cᵀ) = log det R + Σ log(1 + s²)

    so that (I − U diag(1 − 1 / √(1 + s²)) Uᵀ) W whitens the sum.

    Parameters
    ----------
    base : ObservationNoise
        R of n observations.
    columns : (n, q) in units of the observation
        C, one column for each independent quantity of unit variance.

    Raises
    ------
    InputError
        If C is not of n observations, or not finite.
    """
    C = np.asarray(columns, dtype=np.float64)
    if C.ndim != 2 or len(C) != base.size:
        raise InputError(f"added noise has shape {C.shape}, expected ({base.size}, q)")
    require_finite(C, "added noise")
    U, s, _ = np.linalg.svd(base.whiten(C), full_matrices=False)
    shrink = 1.0 - 1.0 / np.sqrt(1.0 + s**2)

    def whiten(values: FloatArray) -> FloatArray:
        white = base.whiten(values)
        return np.asarray(white - (U * shrink) @ (U.T @ white))

    return ObservationNoise(base.size, base.log_determinant + float(np.sum(np.log1p(s**2))), whiten)


def csc(matrix: SparseMatrix) -> CscMatrix:
    """A sparse matrix of any format and number type as columns in double precision."""
    # SciPy's stubs know no common constructor for all formats.
    return scipy.sparse.csc_array(cast(Any, matrix), dtype=np.float64)


def _sparse_noise(R: CscMatrix, size: int) -> ObservationNoise:
    from scipy.sparse.linalg import splu, spsolve_triangular

    if R.shape != (size, size):
        raise InputError(f"R must have shape ({size}, {size}); got {R.shape}")
    require_finite(R.data, "R")
    asymmetry = float(np.max(np.abs((R - R.T).data), initial=0.0))
    scale = float(np.max(np.abs(R.data), initial=0.0))
    if asymmetry > SYMMETRY_TOLERANCE * scale:
        raise InputError(f"R must be symmetric; it differs from its transpose by {asymmetry:g}")
    # Without pivoting off the diagonal the LU factors of a symmetric matrix are L and D Lᵀ in one
    # fill-reducing order; R is positive definite exactly if every pivot in D is positive.
    try:
        lu = splu(
            R,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise InputError(f"R must be positive definite; it is singular ({error})") from error
    pivots = lu.U.diagonal()
    if np.any(pivots <= 0.0) or np.any(lu.perm_r != lu.perm_c):
        raise InputError(f"R must be positive definite; its smallest pivot is {pivots.min():g}")
    position = lu.perm_c
    lower = scipy.sparse.csr_array(lu.L)
    weight = 1.0 / np.sqrt(pivots)

    def whiten(values: FloatArray) -> FloatArray:
        ordered = np.empty_like(values, dtype=np.float64)
        ordered[position] = values
        solved = np.asarray(spsolve_triangular(lower, ordered, lower=True, unit_diagonal=True))
        return (weight * solved.T).T[position]

    return ObservationNoise(size, float(np.sum(np.log(pivots))), whiten)
