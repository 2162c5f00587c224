"""The Kalman update for many observations and few parameters."""

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import ObservationNoise
from mvest.estimation.prediction import read_only
from mvest.typing import FloatArray

BLOCK_ROWS, BLOCKS_AT_A_TIME = 300, 30
"""Rows of a block of the whitened Jacobian, and blocks decomposed in one call: with 20 parameters
both fit the second-level cache."""


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Outcome of one Kalman update."""

    posterior: Gaussian  #: N(m⁺, P⁺)
    log_likelihood: float  #: log N(e; 0, S) of the innovation, the evidence of the linear model
    nis: float  #: normalised innovation squared eᵀ S⁻¹ e
    #: (n,), S^(-1/2) e in the noise's whitened coordinates. If the model and its covariances are
    #: right, these are standard normal numbers, and ``nis`` is chi-square with n degrees of
    #: freedom.
    standardised_innovation: FloatArray


def kalman_update(
    prior: Gaussian, innovation: FloatArray, H: FloatArray, noise: ObservationNoise
) -> Update:
    r"""Condition N(m, P) on an innovation e = y − h(m) with the Jacobian H.

    The textbook's equations (Särkkä, Bayesian Filtering and Smoothing, 2013, eq. 4.21)::

        S  = H P Hᵀ + R                 innovation covariance
        K  = P Hᵀ S⁻¹                   gain
        m⁺ = m + K e
        P⁺ = (I − K H) P = (P⁻¹ + Hᵀ R⁻¹ H)⁻¹
        log p(e) = −½ (n log 2π + log det S + eᵀ S⁻¹ e)

    need an n × n matrix S. With P = L Lᵀ, Wᵀ W = R⁻¹, A = W H L and its thin singular value
    decomposition A = U diag(s) Vᵀ, of which there are only p values, they become::

        W S Wᵀ  = I + U diag(s²) Uᵀ
        log det S = log det R + Σ log(1 + s²)               matrix determinant lemma
        m⁺ = m + L V diag(1 / (1 + s²)) (A V)ᵀ W e
        P⁺ = X Xᵀ,  X = L V diag(1 / √(1 + s²))
        (W S Wᵀ)^(-1/2) = I + U diag(1 / √(1 + s²) − 1) Uᵀ
                        = I − A V diag(1 / (√(1 + s²) (1 + √(1 + s²)))) (A V)ᵀ

    at a cost of n p² and a memory of n p. U is not needed, so that s and V come from a triangular
    factor of A: that of W H times L. It is found block by block (Demmel, Grigori, Hoemmen and
    Langou 2012, SIAM J. Sci. Comput. 34:A206). The product X Xᵀ is symmetric positive semi-definite
    whatever the rounding, and Hᵀ R⁻¹ H, whose condition number is the square of that of W H, is
    never formed. P may be singular.

    InputError if shapes disagree.

    Parameters
    ----------
    prior : Gaussian
        N(m, P) of p parameters.
    innovation : (n,) in units of the observation
    H : (n, p) in units of the observation per unit of parameter
    noise : ObservationNoise
    """
    n, p = noise.size, prior.size
    if innovation.shape != (n,) or H.shape != (n, p):
        raise InputError(
            f"{n} observations of {p} parameters need an innovation of shape ({n},) and H of shape "
            f"({n}, {p}); got {innovation.shape} and {H.shape}"
        )
    m, L = prior.mean, prior.factor
    e = noise.whiten(innovation)
    WH = noise.whiten(H)
    # All p right singular vectors are needed, also with fewer observations than parameters.
    _, values, Vt = np.linalg.svd(_triangular_factor(WH) @ L, full_matrices=True)
    s = np.zeros(p)
    s[: values.size] = values
    root = np.sqrt(1.0 + s**2)

    AV = Vt @ (L.T @ (WH.T @ e))
    X = (L @ Vt.T) / root
    posterior = Gaussian(m + L @ (Vt.T @ (AV / root**2)), X @ X.T)

    standardised = e - WH @ (L @ (Vt.T @ (AV / (root * (1.0 + root)))))
    nis = float(standardised @ standardised)
    log_det_S = noise.log_determinant + float(np.sum(np.log1p(s**2)))
    log_likelihood = -0.5 * (n * np.log(2.0 * np.pi) + log_det_S + nis)
    return Update(posterior, float(log_likelihood), nis, read_only(standardised))


def _triangular_factor(A: FloatArray) -> FloatArray:
    """R of A = Q R for A (n, p), of shape (min(n, p), p), by blocks of rows that fit a cache."""
    n, p = A.shape
    rows = max(BLOCK_ROWS, 2 * p)
    whole = n // rows * rows
    if n <= rows:
        return np.asarray(np.linalg.qr(A, mode="r"))
    blocks = A[:whole].reshape(-1, rows, p)
    factors = [
        np.asarray(np.linalg.qr(blocks[k : k + BLOCKS_AT_A_TIME], mode="r")).reshape(-1, p)
        for k in range(0, len(blocks), BLOCKS_AT_A_TIME)
    ]
    return _triangular_factor(np.concatenate([*factors, A[whole:]]))
