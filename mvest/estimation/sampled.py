"""Errors of an observation that are known by samples: what they add to the noise and the intervals.

Errors of what a model is built from are alike all over an observation, and known by a few samples
only. K samples d₁ ... d_K of the error of the innovation y − h, which is all of it, could be added
to the noise as R + 1/K Σ d dᵀ. But a filter that assumes so avoids the K directions that it was
shown, and is as sure as if there were no other: with twelve samples its intervals of 95 % held the
truth in 70 % (simulated). So the noise is what the filter weighs with, and no more. The covariance
of its estimate is taken from the samples themselves, through a gain K that has not seen them::

    P⁺ = (I − K H) P (I − K H)ᵀ + c / K Σ (K₋ₖ dₖ)(K₋ₖ dₖ)ᵀ + (K C)(K C)ᵀ

the form of Joseph, which holds for any gain (Bucy and Joseph, Filtering for Stochastic Processes
with Applications to Guidance, 1968), with K₋ₖ the gain of all samples but the k-th and what was
made from the same. Where the model is bent, its second derivatives S are part of the Hessian of the
objective, and so of the gain, by the implicit function theorem (Nocedal and Wright, Numerical
Optimization, 2006, appendix A.2)::

    K = (P⁻¹ + Hᵀ R⁻¹ H + S)⁻¹ Hᵀ R⁻¹,    (P⁻¹ + Hᵀ R⁻¹ H + S)⁻¹ P⁻¹ in the place of I − K H

Of K samples the variance is uncertain itself; c = (t / 1.96)² with t the 97.5 % point of Student's
distribution with K degrees of freedom, so that an interval of ± 1.96 standard deviations is one of
95 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import ObservationNoise, low_rank_noise
from mvest.estimation.prediction import require_finite
from mvest.typing import BoolArray, FloatArray, IntArray

LEVEL = 0.95
"""Of the intervals that are to be right."""

SEEN = 1e-5
"""Standard deviations of the base noise below which a direction of the samples is left out.

Without one of them it is not independent of the others any more, and counts with their size.
"""


@dataclass(frozen=True, slots=True, eq=False)
class SampledPosterior:
    """Covariance of an estimate ``(p, p)``, and what the samples contribute.

    Attributes
    ----------
    covariance, from_samples : (p, p)
        In all, and of the samples.
    moved : (p, K)
        By what each sample moves the estimate, with a gain that has not seen it; scaled so that
        ``moved @ moved.T`` is ``from_samples``.
    """

    covariance: FloatArray
    from_samples: FloatArray
    moved: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class SampledErrors:
    """Samples of the error of an innovation, beside the noise that the filter weighs with.

    Attributes
    ----------
    base : ObservationNoise
        R of n observations: how errors of single observations are weighed.
    samples : (n, K)
        In units of the observation.
    source : (K,) or None
        Samples with the same number are not independent of each other: of one of them a gain that
        has not seen it has seen none of these. Student's distribution has a degree of freedom for
        each source. None: all are independent.
    beside : (n, q) or None
        C of the base: errors that no sample has, one standard deviation of each.
    """

    base: ObservationNoise
    samples: FloatArray
    source: IntArray | None = None
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
        """C ``(n, q)``: what the filter adds to its noise is C Cᵀ."""
        return self.samples / np.sqrt(self.samples.shape[1])

    @property
    def noise(self) -> ObservationNoise:
        """R + C Cᵀ = R + 1/K Σ d dᵀ."""
        return low_rank_noise(self.base, self.columns)

    def posterior(
        self,
        jacobian: FloatArray,
        prior: FloatArray,
        curvature: FloatArray | None = None,
    ) -> SampledPosterior:
        """Covariance of the estimate of a linear model.

        Parameters
        ----------
        jacobian : (n, p)
            H at the estimate.
        prior : (p, p)
            Covariance P.
        curvature : (p, p), optional
            S, see `Estimate.curvature`. Default: none, as of a model that is linear.
        """
        H = self.base.whiten(np.asarray(jacobian, dtype=np.float64))
        D = self.base.whiten(self.samples)
        P = Gaussian(np.zeros(len(prior)), prior).covariance
        S = np.zeros_like(P) if curvature is None else curvature
        U, parts = self._seen()
        UH, count = U.T @ H, self.samples.shape[1]

        def gain(used: BoolArray) -> tuple[FloatArray, FloatArray]:
            """Gain ``(p, n)`` by some samples, and what it leaves of an error of the prior.

            For whitened observations with noise I + U B Uᵀ, U orthonormal, the gain is M P Hᵀ R⁻¹
            with M = (I + P (Hᵀ R⁻¹ H + S))⁻¹ and R⁻¹ = I − U (I − (I + B)⁻¹) Uᵀ.
            """
            B = parts[:, used] @ parts[:, used].T / max(int(used.sum()), 1)
            weighed = H - U @ (UH - scipy.linalg.solve(np.eye(len(B)) + B, UH, assume_a="pos"))
            M = np.asarray(np.linalg.inv(np.eye(len(P)) + P @ (weighed.T @ H + S)), np.float64)
            return M @ P @ weighed.T, M

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

    def _seen(self) -> tuple[FloatArray, FloatArray]:
        """Orthonormal directions ``(n, r)`` of whitened columns, and their parts in them.

        Those are ``(r, K)``. Directions in which they are far below the noise are left out.
        """
        columns = self.base.whiten(self.columns)
        U, s, Vt = np.linalg.svd(columns, full_matrices=False)
        kept = s > SEEN
        own = np.sqrt(self.samples.shape[1]) * s[kept, None] * Vt[kept]
        return np.ascontiguousarray(U[:, kept]), own
