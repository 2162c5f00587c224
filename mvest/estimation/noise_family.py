"""Noise that is known up to a few quantities: a smooth part, a rough part, and further columns.

Errors of neighbouring points are alike in part. Of a block of k points, each observed in several
coordinates that are independent of each other::

    R = f² D (Σ s_b² U_b diag(w_b) U_bᵀ + τ² I + δ² I) D

U and w are eigenvectors and eigenvalues of a smooth correlation K over the points, in bands b of
half a decade of w / k, that is by how finely they vary along the leaflets. s_b is the standard
deviation of the smooth part in one band (as much of K as is in it), τ that of the rough part, δ a
resolution below which nothing is believed, f the factor of a frame and D the scales of single
points. The logarithms of the quantities have a normal prior; ``evidence`` learns them.

So the kernel of the errors is not assumed. One of a few parameters, fitted to thousands of points,
follows the finest detail, of which there is most, while parameters of a model depend on the
coarse: fitted to fields of an exponential or a Gaussian kernel a Matérn kernel with a nugget gave
intervals of 95 % that held 84 and 75 %; bands, each from what varies as finely, 92 to 95 %.

K enters by its best part of low rank. Of m points that are spread evenly (the farthest from those
chosen before, Gonzalez 1985, Theoret. Comput. Sci. 38:293) its columns give the approximation of
Nyström (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 8.1); what
it leaves is spread evenly over all directions across them. It costs k m² once, and k m for
whitening a vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.spatial.distance import cdist

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import ObservationNoise, low_rank_noise, stacked_noise
from mvest.estimation.prediction import read_only, require_finite
from mvest.typing import FloatArray, IntArray

MAX_RANK = 500
"""Points by which a smooth part is represented."""

MAX_BASIS_SIZE = 2_000_000
"""Numbers in the basis of a smooth part: of 10 000 points it has rank 200."""

JITTER = 1e-9
"""Added to the correlation of the chosen points, above its rounding errors."""

NEGLIGIBLE = 1e-9
"""Part of the largest eigenvalue below which what is left of one belongs to the rough part."""

BANDS = 14
"""Bands of a smooth part: half decades of w / k from 1 down; what is finer is in the last."""

LARGEST = 300.0
"""Logarithm of a standard deviation beyond which it is that: a search may try any."""

SPECTRUM_POINTS = 400
"""Points on which the bands of a stated correlation are computed."""


def matern(distance: FloatArray, length: float) -> FloatArray:
    """Matérn correlation of smoothness 3/2, ``(1 + √3 d / l) exp(−√3 d / l)``.

    Positive definite in space whatever the points (Rasmussen and Williams, eq. 4.17).
    """
    d = distance * (np.sqrt(3.0) / length)
    return np.asarray((1.0 + d) * np.exp(-d))


@dataclass(frozen=True, slots=True)
class LogNormal:
    """What is believed of a positive quantity.

    Attributes
    ----------
    median : float
    factor : float
        One standard deviation of the logarithm, as a factor; 1 holds the quantity at its median.
    """

    median: float
    factor: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.median) and self.median > 0.0):
            raise InputError(f"a positive quantity with the median {self.median}, expected > 0")
        if not (np.isfinite(self.factor) and self.factor >= 1.0):
            raise InputError(f"a positive quantity known to a factor {self.factor}, expected >= 1")

    @property
    def log_std(self) -> float:
        """Standard deviation of the logarithm."""
        return float(np.log(self.factor))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Ends of the central interval."""
        reach = float(scipy.special.ndtri(0.5 + 0.5 * level)) * self.log_std
        return self.median * float(np.exp(-reach)), self.median * float(np.exp(reach))


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """K of k points as U diag(w) Uᵀ + r (I − U Uᵀ), r such that the variance is right.

    Attributes
    ----------
    points : (k, d)
    U : (k, m)
        Orthonormal columns.
    w : (m,)
    band : (m,)
        Of each column.
    across : float
        r.
    length : float
        Of K.
    """

    points: FloatArray
    U: FloatArray
    w: FloatArray
    band: IntArray
    across: float
    length: float


def smooth_basis(points: FloatArray, length: float) -> Basis:
    """The Matérn correlation of a length over points ``(k, d)``, by its best part of low rank."""
    k = len(points)
    chosen = spread_points(points, min(k, MAX_RANK, max(1, MAX_BASIS_SIZE // k)))
    columns = matern(cdist(points, points[chosen]), length)
    among = columns[chosen]
    among[np.diag_indices_from(among)] += JITTER
    L = _solved(among, columns.T).T
    values, vectors = np.linalg.eigh(L.T @ L)
    kept = values > NEGLIGIBLE * values[-1]
    w = values[kept]
    U = L @ (vectors[:, kept] / np.sqrt(w))
    # Once more: the columns of small eigenvalues are orthogonal to rounding over these only.
    U = _solved(U.T @ U, U.T).T
    across = max(0.0, k - float(w.sum())) / max(1, k - len(w))
    return Basis(points, U, w, bands_of(w / k), across, length)


def _solved(A: FloatArray, B: FloatArray) -> FloatArray:
    """L⁻¹ B with A = L Lᵀ."""
    root = scipy.linalg.cholesky(A, lower=True, check_finite=False)
    return np.asarray(scipy.linalg.solve_triangular(root, B, lower=True, check_finite=False))


def bands_of(level: FloatArray) -> IntArray:
    """Band of eigenvalues, each as a part of the number of points."""
    return np.clip(np.floor(-2.0 * np.log10(level)), 0, BANDS - 1).astype(np.int64)


def spread_points(points: FloatArray, count: int) -> IntArray:
    """Indices of points spread evenly, each the farthest from those before; all different."""
    chosen = [int(np.argmin(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
        farthest = int(np.argmax(nearest))
        if nearest[farthest] == 0.0:
            break
        chosen.append(farthest)
    return np.array(chosen)


@dataclass(frozen=True, slots=True)
class Spectrum:
    """What is believed of a smooth part, from a standard deviation and a length that are stated.

    Attributes
    ----------
    std, length : LogNormal
        As of a Matérn correlation.
    deviation : float
        Factor by which a band may deviate from it, one standard deviation; neighbours alike.
    reference : float
        Length of K, in parts of the stated one. Eigenvectors of a long one are nearly those of any
        other; of a short one they mix what is coarse.
    """

    std: LogNormal
    length: LogNormal
    deviation: float = 1.65
    reference: float = 3.0

    @property
    def reference_length(self) -> float:
        """Length of K."""
        return self.reference * self.length.median

    def prior(self, points: FloatArray) -> Gaussian:
        """What is believed of the logarithms of s_b ``(BANDS,)``, over points ``(k, d)``."""
        some = points[spread_points(points, min(len(points), SPECTRUM_POINTS))]
        distance = cdist(some, some)
        w, U = np.linalg.eigh(matern(distance, self.reference_length))
        seen = w > JITTER * w[-1]
        band, w, U = bands_of(w[seen] / len(some)), w[seen], U[:, seen]
        whole = np.bincount(band, w, BANDS)
        known = np.flatnonzero(whole > 0.0)

        def log_std(length: float) -> FloatArray:
            share = np.bincount(band, np.sum(U * (matern(distance, length) @ U), axis=0), BANDS)
            # Finer than these points tell, spectra of one smoothness are parallel.
            return np.interp(np.arange(BANDS), known, 0.5 * np.log(share[known] / whole[known]))

        median, step = self.length.median, 0.1
        slope = (log_std(median * np.exp(step)) - log_std(median * np.exp(-step))) / (2.0 * step)
        apart = np.abs(np.arange(BANDS)[:, None] - np.arange(BANDS))
        covariance = (
            self.std.log_std**2
            + self.length.log_std**2 * np.outer(slope, slope)
            + np.log(self.deviation) ** 2 * np.exp(-0.5 * apart)
        )
        return Gaussian(np.log(self.std.median) + log_std(median), covariance)


@dataclass(frozen=True, slots=True, eq=False)
class NoiseBlock:
    """Observations of points that share their kind of error, independent of other blocks.

    Attributes
    ----------
    rough : str
        Name of the standard deviation τ of the rough part.
    scale : (k,)
        Factor of each point on the standard deviations.
    coordinates : int
        Observed of each point; they are independent and follow one another in the observation.
    basis : Basis or None
        Of the smooth part, if there is one.
    frame : str or None
        Name of a further factor f on all standard deviations of the block.
    """

    rough: str
    scale: FloatArray
    coordinates: int = 1
    basis: Basis | None = None
    frame: str | None = None

    def __post_init__(self) -> None:
        scale = np.array(self.scale, dtype=np.float64)
        if scale.ndim != 1 or not scale.size or self.coordinates < 1:
            raise InputError(f"noise of scale {scale.shape}, expected one for each of its points")
        require_finite(scale, "scale of noise")
        if np.any(scale <= 0.0):
            raise InputError(f"scale of noise is {scale.min():g}, expected > 0")
        if self.basis is not None and len(self.basis.U) != len(scale):
            raise InputError(f"smooth noise of {len(self.basis.U)} points, expected {len(scale)}")
        object.__setattr__(self, "scale", read_only(scale))

    @property
    def size(self) -> int:
        """Number of observations."""
        return len(self.scale) * self.coordinates

    def noise(self, v: FloatArray, flat: float) -> ObservationNoise:
        """Noise with the variances ``v (m,)`` along the basis and ``flat`` across it."""
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
    """What q independent quantities that are not known add to the noise, s² C Cᵀ.

    Attributes
    ----------
    name : str
        Of the factor s.
    columns : (n, q) in units of the observation
        C: what one standard deviation of each does to the observation.
    factor : float
        To which s is known, about 1; 1 holds it there.
    """

    name: str
    columns: FloatArray
    factor: float = 1.0

    def __post_init__(self) -> None:
        columns = np.array(self.columns, dtype=np.float64)
        if columns.ndim != 2:
            raise InputError(f"added noise {self.name} has shape {columns.shape}, expected (n, q)")
        require_finite(columns, f"added noise {self.name}")
        LogNormal(1.0, self.factor)
        object.__setattr__(self, "columns", read_only(columns))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFamily:
    """Noise of n observations as a function of a few positive quantities.

    To what takes a noise as it is given, a family is its noise at the medians.

    Attributes
    ----------
    blocks : tuple of NoiseBlock
        One after another in the observation.
    quantities : mapping of str to LogNormal
        What is believed of the rough parts and the factors of frames.
    bands : Gaussian or None
        What is believed of the logarithms of s_b ``(BANDS,)``; needed if there is a smooth part.
    resolution : float
        δ.
    columns : tuple of ErrorColumns
        Added, each with a factor of its own.
    """

    blocks: tuple[NoiseBlock, ...]
    quantities: Mapping[str, LogNormal]
    bands: Gaussian | None = None
    resolution: float = 0.0
    columns: tuple[ErrorColumns, ...] = ()

    def __post_init__(self) -> None:
        needed = {block.rough for block in self.blocks}
        needed |= {block.frame for block in self.blocks if block.frame is not None}
        if not self.blocks or needed != set(self.quantities):
            raise InputError(
                f"noise depends on {', '.join(sorted(needed)) or 'nothing'}; quantities are given "
                f"for {', '.join(sorted(self.quantities)) or 'none'}"
            )
        if self.bands is None and any(block.basis is not None for block in self.blocks):
            raise InputError("a smooth part, of which nothing is believed; expected its bands")
        if self.bands is not None and self.bands.size != BANDS:
            raise InputError(f"{self.bands.size} bands of a smooth part, expected {BANDS}")
        if not (np.isfinite(self.resolution) and self.resolution >= 0.0):
            raise InputError(f"resolution of {self.resolution}, expected >= 0")
        names = self.names
        if len(set(names)) != len(names):
            raise InputError(f"noise of {', '.join(names)}: expected different names")
        for columns in self.columns:
            if len(columns.columns) != self.size:
                raise InputError(
                    f"added noise {columns.name} has shape {columns.columns.shape}, expected "
                    f"({self.size}, q)"
                )

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
        """What is believed of their logarithms."""
        others = [
            *self.quantities.values(),
            *(LogNormal(1.0, columns.factor) for columns in self.columns),
        ]
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
        """The errors of single observations alone."""
        return replace(self, columns=())

    def at(self, log: FloatArray, beats: float = 1.0) -> ObservationNoise:
        """The noise for given quantities.

        Parameters
        ----------
        log : (h,)
            Logarithms of the quantities; those of columns come last.
        beats : float
            Heart beats whose mean is observed, may be infinite. The smooth and the rough part are
            independent from beat to beat, so that their variance falls by this factor. Resolution
            and added columns are the same in every beat and stay.

        Raises
        ------
        InputError
            If there is less than one beat, or no noise is left.
        """
        if not beats >= 1.0:
            raise InputError(f"mean of {beats} beats, expected >= 1")
        if np.isinf(beats) and not self.resolution > 0.0:
            raise InputError("the mean of any number of beats has no noise without a resolution")
        of = self.rows
        parts, start = [], 0
        v = of.variances(log, beats)[0]
        for block, count in zip(self.blocks, of.sizes, strict=True):
            own = v[start : start + count]
            parts.append(block.noise(own[: count - 1], float(own[-1])))
            start += count
        noise = stacked_noise(parts)
        for k, columns in enumerate(self.columns, start=len(self.names) - len(self.columns)):
            noise = low_rank_noise(noise, np.exp(log[k]) * columns.columns)
        return noise

    def stated(self) -> ObservationNoise:
        """The noise at the medians."""
        return self.at(self.prior.mean)

    @property
    def rows(self) -> VarianceRows:
        """Variances of all blocks along their bases and across them, as a function."""
        names = self.names
        weight, band, rough, frame, sizes = [], [], [], [], []
        for block in self.blocks:
            w, b = np.zeros(0), np.zeros(0, dtype=np.int64)
            last, level = 0, 0.0
            if block.basis is not None:
                w, b, level = block.basis.w, block.basis.band, block.basis.across
                last = int(bands_of(np.array(max(level, 1e-300) / len(block.scale))))
            weight.append(np.append(w, level))
            band.append(np.append(b, last))
            sizes.append(len(w) + 1)
            rough.append(np.full(sizes[-1], names.index(block.rough)))
            frame.append(
                np.full(sizes[-1], -1 if block.frame is None else names.index(block.frame))
            )
        return VarianceRows(
            np.concatenate(weight),
            np.concatenate(band),
            np.concatenate(rough),
            np.concatenate(frame),
            tuple(sizes),
            self.resolution**2,
        )


@dataclass(frozen=True, slots=True, eq=False)
class VarianceRows:
    """Variances along and across the bases of all blocks, f² (s_b² w + τ² + δ²).

    Attributes
    ----------
    weight : (r,)
        w; of each block those of its basis, then that across it.
    band, rough, frame : (r,)
        Which of the quantities are s_b, τ and f; no f where it is -1.
    sizes : tuple of int
        Rows of each block.
    resolution : float
        δ².
    """

    weight: FloatArray
    band: IntArray
    rough: IntArray
    frame: IntArray
    sizes: tuple[int, ...]
    resolution: float

    def variances(
        self, log: FloatArray, beats: float = 1.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The variances ``(r,)``, and the shares in each of the smooth and of the rough part.

        See `NoiseFamily.at` for the arguments.
        """
        log = np.clip(log, -LARGEST, LARGEST)
        smooth = np.where(self.weight > 0.0, np.exp(2.0 * log[self.band]) * self.weight, 0.0)
        smooth, rough = smooth / beats, np.exp(2.0 * log[self.rough]) / beats
        within = smooth + rough + self.resolution
        f = np.where(self.frame >= 0, np.exp(2.0 * log[self.frame]), 1.0)
        return f * within, smooth / within, rough / within
