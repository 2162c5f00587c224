"""The noise of an observation: covariance R, used only through W with Wᵀ W = R⁻¹.

R is known, or known up to a few quantities. Errors of neighbouring points are partly correlated.
For a block of k points, each observed in several independent coordinates::

    R = f² D (Σ s_b² U_b diag(w_b) U_bᵀ + τ² I + δ² I) D

U_b and w_b belong to the bands of `mvest.estimation.spectrum`. s_b is the standard deviation of the
smooth part in one band, τ that of the rough part, δ the resolution, which is the smallest standard
deviation of a point, f the factor of a frame and D the scales of single points. The logarithms of
the quantities have a normal prior; `mvest.estimation.evidence` learns them. Other unknown
quantities, which change the observation by columns C, add C Cᵀ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.gaussian import SYMMETRY_TOLERANCE, Gaussian
from mvest.estimation.prediction import require_finite, require_positive
from mvest.estimation.spectrum import BANDS, Basis, LogNormal, bands_of
from mvest.typing import FloatArray, IntArray

LARGEST = 300.0
"""Bound on the logarithm of a standard deviation; a search may try any value."""


@dataclass(frozen=True, slots=True)
class ObservationNoise:
    """Noise of n observations with covariance R."""

    size: int  #: number n of observations
    log_determinant: float  #: log det R
    #: function from (n,) or (n, p) to the same shape, multiplies with W, where Wᵀ W = R⁻¹; whitened
    #: noise has the covariance I. Row i of the result belongs to observation i.
    whiten: Callable[[FloatArray], FloatArray]


def observation_noise(R: NoiseCovariance, size: int) -> ObservationNoise:
    """Check the noise covariance of ``size`` observations and factorise it once.

    InputError if R has the wrong size, or is not symmetric positive definite.
    """
    if isinstance(R, ObservationNoise | NoiseFamily):
        if R.size != size:
            raise InputError(f"R is of {R.size} observations, expected {size}")
        return R if isinstance(R, ObservationNoise) else R.stated()
    try:
        values = np.asarray(R, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"R must be numbers, got {type(R).__name__}") from error
    if values.shape not in ((), (size,), (size, size)):
        raise InputError(
            f"R must be one variance, the {size} variances of the observations, or their "
            f"covariance ({size}, {size}); got shape {values.shape}"
        )
    require_finite(np.atleast_1d(values), "R")
    if values.ndim == 2:
        if np.any(np.abs(values - values.T) > SYMMETRY_TOLERANCE * np.max(np.abs(values))):
            raise InputError("R must be symmetric; it differs from its transpose")
        try:
            root = np.asarray(np.linalg.cholesky(values), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            raise InputError("R must be positive definite") from error
        return kronecker_noise(1.0, root, 1)
    require_positive(values, "variance in R")
    weight = 1.0 / np.sqrt(values)
    log_determinant = float(np.sum(np.log(np.broadcast_to(values, (size,)))))
    return ObservationNoise(size, log_determinant, lambda observed: (weight * observed.T).T)


def kronecker_noise(variance: float, root: FloatArray, copies: int) -> ObservationNoise:
    """Noise of points, R = variance · (L Lᵀ ⊗ I) with the lower triangular ``root (k, k)`` L.

    Each point is observed in ``copies`` independent coordinates, which follow one another in the
    observation.
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
    """Noise of several independent observations, one after another."""
    ends = np.cumsum([part.size for part in parts])

    def whiten(values: FloatArray) -> FloatArray:
        pieces = np.split(values, ends[:-1])
        return np.concatenate([p.whiten(v) for p, v in zip(parts, pieces, strict=True)])

    log_determinant = float(sum(part.log_determinant for part in parts))
    return ObservationNoise(int(ends[-1]), log_determinant, whiten)


def scaled_noise(base: ObservationNoise, scale: FloatArray) -> ObservationNoise:
    """Noise D R D with R of ``base`` and the positive diagonal ``scale (n,)`` of D.

    InputError if the factors are not of n observations, or not positive.
    """
    factor = np.asarray(scale, dtype=np.float64)
    if factor.shape != (base.size,):
        raise InputError(f"scale of noise has shape {factor.shape}, expected ({base.size},)")
    require_positive(factor, "scale of noise")
    return ObservationNoise(
        base.size,
        base.log_determinant + 2.0 * float(np.sum(np.log(factor))),
        lambda values: base.whiten((np.asarray(values).T / factor).T),
    )


def low_rank_noise(base: ObservationNoise, columns: FloatArray) -> ObservationNoise:
    """Noise R + C Cᵀ with R of ``base`` and C of ``columns (n, q)``, in units of the observation.

    C has one column for each of q independent quantities of unit variance. With W of ``base`` and
    the thin singular value decomposition W C = U diag(s) Vᵀ::

        W (R + C Cᵀ) Wᵀ = I + U diag(s²) Uᵀ
        log det (R + C Cᵀ) = log det R + Σ log(1 + s²)

    so that (I − U diag(1 − 1 / √(1 + s²)) Uᵀ) W whitens the sum.

    InputError if C is not of n observations, or not finite.
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


@dataclass(frozen=True, slots=True, eq=False)
class NoiseBlock:
    """Points with the same kind of error, independent of other blocks."""

    rough: str  #: name of the standard deviation τ of the rough part
    scale: FloatArray  #: (k,), factor of each point on the standard deviations
    #: observed coordinates of each point; they are independent and follow one another
    coordinates: int = 1
    basis: Basis | None = None  #: of the smooth part, if there is one
    frame: str | None = None  #: name of a further factor f on all standard deviations of the block

    @property
    def size(self) -> int:
        """Number of observations."""
        return len(self.scale) * self.coordinates

    @property
    def variance_count(self) -> int:
        """Number of different variances: along the basis, and one across it."""
        return 1 if self.basis is None else 1 + len(self.basis.w)

    def noise(self, variances: FloatArray) -> ObservationNoise:
        """Noise with these ``variances``, that across the basis last."""
        v, flat = variances[:-1], float(variances[-1])
        k, copies, scale = len(self.scale), self.coordinates, self.scale[:, None]
        log_determinant = (k - len(v)) * np.log(flat) + float(np.sum(np.log(v)))
        log_determinant += 2.0 * float(np.sum(np.log(self.scale)))
        change = 1.0 / np.sqrt(v) - 1.0 / np.sqrt(flat)

        def whiten(observed: FloatArray) -> FloatArray:
            x = np.reshape(observed, (k, -1)) / scale
            white = x / np.sqrt(flat)
            if self.basis is not None:
                white += self.basis.U @ (change[:, None] * (self.basis.U.T @ x))
            return np.asarray(np.reshape(white, np.shape(observed)))

        return ObservationNoise(self.size, copies * log_determinant, whiten)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorColumns:
    """Noise s² C Cᵀ of q independent unknown quantities."""

    name: str  #: of the factor s
    #: (n, q) in units of the observation, C: change of the observation by one standard deviation of
    #: each quantity
    columns: FloatArray
    factor: float = 1.0  #: one standard deviation of s, about 1; 1 fixes it


class VarianceTerms(NamedTuple):
    """Terms of the variances f² (s_b² w + τ² + δ²) along and across the bases of all blocks.

    ``weight (r,)`` is w; ``band``, ``rough`` and ``frame (r,)`` are the indices of the quantities
    s_b, τ and f, -1 without f.
    """

    weight: FloatArray
    band: IntArray
    rough: IntArray
    frame: IntArray


@dataclass(frozen=True, eq=False)
class NoiseFamily:
    """Noise of n observations as a function of a few positive quantities.

    Code that expects a fixed noise gets the noise at the medians.

    InputError if the blocks' quantities are not those given, or names repeat.
    """

    blocks: tuple[NoiseBlock, ...]  #: one after another in the observation
    quantities: Mapping[str, LogNormal]  #: prior of the rough parts and of the factors of frames
    #: prior of the logarithms of s_b ``(BANDS,)``; needed if there is a smooth part
    bands: Gaussian | None = None
    resolution: float = 0.0  #: δ
    columns: tuple[ErrorColumns, ...] = ()  #: added noise

    def __post_init__(self) -> None:
        needed = {block.rough for block in self.blocks}
        needed |= {block.frame for block in self.blocks if block.frame is not None}
        if not self.blocks or needed != set(self.quantities):
            raise InputError(
                f"noise depends on {', '.join(sorted(needed)) or 'nothing'}; quantities are given "
                f"for {', '.join(sorted(self.quantities)) or 'none'}"
            )
        if self.bands is None and any(block.basis is not None for block in self.blocks):
            raise InputError("a smooth part has no prior; expected its bands")
        if len(set(self.names)) != len(self.names):
            raise InputError(f"noise of {', '.join(self.names)}: expected different names")

    @property
    def size(self) -> int:
        """Number n of observations."""
        return sum(block.size for block in self.blocks)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the h quantities: bands of the smooth part, the others, and added columns."""
        bands = () if self.bands is None else tuple(f"band {b}" for b in range(BANDS))
        return (*bands, *self.quantities, *(columns.name for columns in self.columns))

    @property
    def prior(self) -> Gaussian:
        """Prior of the logarithms of the quantities."""
        factors = (LogNormal(1.0, columns.factor) for columns in self.columns)
        others = [*self.quantities.values(), *factors]
        mean = np.log([belief.median for belief in others])
        covariance = np.diag([belief.log_std**2 for belief in others])
        if self.bands is None:
            return Gaussian(mean, covariance)
        return Gaussian(
            np.concatenate([self.bands.mean, mean]),
            scipy.linalg.block_diag(self.bands.covariance, covariance),
        )

    def plus(self, columns: ErrorColumns) -> NoiseFamily:
        """The family with further columns added."""
        return replace(self, columns=(*self.columns, columns))

    def without_columns(self) -> NoiseFamily:
        """The family without added columns."""
        return replace(self, columns=())

    def at(self, log: FloatArray, beats: float = 1.0) -> ObservationNoise:
        """The noise for given quantities.

        InputError if there is less than one beat, or no noise is left.

        Parameters
        ----------
        log : (h,)
            Logarithms of the quantities; those of columns come last.
        beats : float
            Heart beats whose mean is observed, may be infinite. It divides the variances of the
            smooth and the rough part, which are independent from beat to beat. Resolution and added
            columns are the same in every beat.
        """
        if not beats >= 1.0:
            raise InputError(f"mean of {beats} beats, expected >= 1")
        if np.isinf(beats) and not self.resolution > 0.0:
            raise InputError("the mean of any number of beats has no noise without a resolution")
        ends = np.cumsum([block.variance_count for block in self.blocks])
        variances = np.split(self.variances(log, beats)[0], ends[:-1])
        noise = stacked_noise(
            [block.noise(own) for block, own in zip(self.blocks, variances, strict=True)]
        )
        for k, columns in enumerate(self.columns, start=len(self.names) - len(self.columns)):
            noise = low_rank_noise(noise, np.exp(log[k]) * columns.columns)
        return noise

    def stated(self) -> ObservationNoise:
        """The noise at the medians."""
        return self.at(self.prior.mean)

    @cached_property
    def terms(self) -> VarianceTerms:
        """Terms of the variances of all blocks."""
        each = []
        for block in self.blocks:
            w, band = np.zeros(1), np.zeros(1, dtype=np.int64)
            if (basis := block.basis) is not None:
                w = np.append(basis.w, basis.across)
                last = bands_of(np.array([max(basis.across, 1e-300) / len(block.scale)]))
                band = np.concatenate([basis.band, last])
            rough = self.names.index(block.rough)
            frame = -1 if block.frame is None else self.names.index(block.frame)
            each.append((w, band, np.full(len(w), rough), np.full(len(w), frame)))
        return VarianceTerms(*(np.concatenate(own) for own in zip(*each, strict=True)))

    def variances(
        self, log: FloatArray, beats: float = 1.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The variances ``(r,)``, and the shares in each of the smooth and of the rough part.

        See `NoiseFamily.at` for the arguments.
        """
        of, log = self.terms, np.clip(log, -LARGEST, LARGEST)
        smooth = np.where(of.weight > 0.0, np.exp(2.0 * log[of.band]) * of.weight, 0.0)
        smooth, rough = smooth / beats, np.exp(2.0 * log[of.rough]) / beats
        within = smooth + rough + self.resolution**2
        f = np.where(of.frame >= 0, np.exp(2.0 * log[of.frame]), 1.0)
        return f * within, smooth / within, rough / within


NoiseCovariance: TypeAlias = float | FloatArray | ObservationNoise | NoiseFamily
"""R as one variance, n variances (n,), a covariance (n, n), factorised, or to be learned."""
