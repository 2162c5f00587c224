"""Errors of an observation that are known by samples, and the intervals that follow.

Errors of a model's geometry are correlated over the whole observation, and known by few samples d₁
... d_K of the error of the innovation y − h. The noise R + 1/K Σ d dᵀ includes them, but a filter
that assumes it avoids just these K directions and is too certain: with twelve samples its 95 %
intervals held the truth in 70 % (simulated). So this noise only weights the observations. The
covariance of the estimate is computed from the samples, each with a gain computed without it::

    P⁺ = (I − K H) P (I − K H)ᵀ + c / K Σ (K₋ₖ dₖ)(K₋ₖ dₖ)ᵀ + (K C)(K C)ᵀ

Joseph's form, which holds for any gain (Bucy and Joseph, Filtering for Stochastic Processes with
Applications to Guidance, 1968), with K₋ₖ the gain without the k-th sample and those of the same
source. Second derivatives S of a curved model are part of the Hessian of the objective, and so
of the gain, by the implicit function theorem (Nocedal and Wright, Numerical Optimization, 2006,
appendix A.2)::

    K = (P⁻¹ + Hᵀ R⁻¹ H + S)⁻¹ Hᵀ R⁻¹,    (P⁻¹ + Hᵀ R⁻¹ H + S)⁻¹ P⁻¹ in the place of I − K H

The variance of K samples is uncertain itself: c = (t / 1.96)² with t the 97.5 % point of Student's
distribution with K degrees of freedom, so that ± 1.96 standard deviations are a 95 % interval.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import ObservationNoise, low_rank_noise
from mvest.estimation.prediction import require_finite
from mvest.typing import BoolArray, FloatArray, IntArray

LEVEL = 0.95
"""Of the intervals that should be exact."""

SEEN = 1e-5
"""Standard deviations of the base noise below which a direction of the samples is left out."""


@dataclass(frozen=True, slots=True, eq=False)
class SampledPosterior:
    """Covariance of an estimate, and the samples' part of it."""

    #: (p, p)
    covariance: FloatArray
    from_samples: FloatArray
    #: (p, K), shift of the estimate by each sample, with a gain computed without it; scaled so that
    #: ``moved @ moved.T`` is ``from_samples``
    moved: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class SampledErrors:
    """Samples of the error of an innovation, in addition to other noise."""

    base: ObservationNoise  #: R of n observations
    samples: FloatArray  #: (n, K) in units of the observation
    #: (K,) or None, samples with the same number are not independent; K₋ₖ leaves all of them out,
    #: and Student's distribution has one degree of freedom for each source. None: all are
    #: independent.
    source: IntArray | None = None
    #: (n, q) or None, C: one standard deviation of each error that is part of the base but not of
    #: the samples
    beside: FloatArray | None = None

    def __post_init__(self) -> None:
        samples = np.array(self.samples, dtype=np.float64)
        if samples.ndim != 2 or len(samples) != self.base.size or samples.shape[1] < 2:
            raise InputError(
                f"samples of errors have shape {samples.shape}, expected ({self.base.size}, K) "
                "with K at least 2"
            )
        require_finite(samples, "samples of errors")
        if self.source is not None and np.shape(self.source) != (samples.shape[1],):
            raise InputError(
                f"sources of shape {np.shape(self.source)}, expected one for each of "
                f"{samples.shape[1]} samples"
            )
        samples.setflags(write=False)
        object.__setattr__(self, "samples", samples)

    @property
    def columns(self) -> FloatArray:
        """C ``(n, q)``: the filter adds C Cᵀ to its noise."""
        return self.samples / np.sqrt(self.samples.shape[1])

    @property
    def noise(self) -> ObservationNoise:
        """R + C Cᵀ = R + 1/K Σ d dᵀ."""
        return low_rank_noise(self.base, self.columns)

    def posterior(
        self, jacobian: FloatArray, prior: FloatArray, curvature: FloatArray | None = None
    ) -> SampledPosterior:
        """Covariance of an estimate with H ``(n, p)`` and the prior's covariance P ``(p, p)``.

        ``curvature (p, p)`` is S, see `Estimate.curvature`; default: that of a linear model, 0.
        """
        H = self.base.whiten(np.asarray(jacobian, dtype=np.float64))
        D = self.base.whiten(self.samples)
        P = Gaussian(np.zeros(len(prior)), prior).covariance
        S = np.zeros_like(P) if curvature is None else curvature
        count = self.samples.shape[1]
        # Orthonormal directions (n, r) of the whitened samples, and their coordinates (r, K).
        U, s, Vt = np.linalg.svd(self.base.whiten(self.columns), full_matrices=False)
        U, parts = np.ascontiguousarray(U[:, s > SEEN]), np.sqrt(count) * s[:, None] * Vt
        UH, parts = U.T @ H, parts[s > SEEN]

        def gain(used: BoolArray) -> tuple[FloatArray, FloatArray]:
            """Gain ``(p, n)`` from some samples, and the factor M on an error of the prior.

            For whitened observations with noise I + U B Uᵀ, U orthonormal, the gain is M P Hᵀ R⁻¹
            with M = (I + P (Hᵀ R⁻¹ H + S))⁻¹ and R⁻¹ = I − U (I − (I + B)⁻¹) Uᵀ.
            """
            B = parts[:, used] @ parts[:, used].T / max(int(used.sum()), 1)
            weighted = H - U @ (UH - scipy.linalg.solve(np.eye(len(B)) + B, UH, assume_a="pos"))
            M = np.asarray(np.linalg.inv(np.eye(len(P)) + P @ (weighted.T @ H + S)), np.float64)
            return M @ P @ weighted.T, M

        K, rest = gain(np.ones(count, dtype=np.bool_))
        moved = np.empty((len(P), count))
        source = np.arange(count) if self.source is None else self.source
        sources = np.unique(source)
        for one in sources:
            own = source == one
            moved[:, own] = gain(~own)[0] @ D[:, own]
        widened = (
            scipy.stats.t.ppf(0.5 + 0.5 * LEVEL, len(sources))
            / scipy.special.ndtri(0.5 + 0.5 * LEVEL)
        ) ** 2
        moved *= np.sqrt(widened / count)
        part = moved @ moved.T
        covariance = rest @ P @ rest.T + part
        if self.beside is not None:
            beside = K @ self.base.whiten(self.beside)
            covariance = covariance + beside @ beside.T
        return SampledPosterior(covariance, part, moved)
