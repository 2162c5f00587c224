"""Learns the noise together with the parameters, from one linearisation of the model.

With the innovation e = y − h(z) + H (z − m) of the prior N(m, P), linearised at z, and the noise
R(θ) of quantities θ (see `mvest.estimation.noise`)::

    log p(e | θ) = log N(e; 0, S),   S = R(θ) + H P Hᵀ + C Cᵀ

is the evidence of θ (MacKay 1992, Neural Comput. 4:415), maximised together with the prior of
log θ. All columns are projected once on the basis of the smooth part and across it, where their
triangular factor suffices. A few hundred rows remain of n observations. They are independent for
every θ, so that an evaluation with derivatives costs p² times their number.

The uncertainty of θ widens the covariance of z (Kass and Steffey 1989, J. Am. Stat. Assoc. 84:717).
The covariance of log θ follows from the second derivatives (Laplace), E is the mean over it::

    P⁺ = E P⁺(θ) + (dz/dθ) cov(θ) (dz/dθ)ᵀ
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from scipy.spatial.distance import cdist

from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseFamily, ObservationNoise
from mvest.estimation.spectrum import BANDS, Basis, LogNormal, matern, spread_points
from mvest.typing import FloatArray

TOLERANCE = 1e-3
"""Slope of the evidence at its maximum, per standard deviation of the prior."""

DIFFERENCE = 1e-4
"""Step in differences of exact derivatives, in standard deviations of the prior."""

SHELLS, CENTRES = 60, 60
"""Distances at which the correlation of the smooth part is sampled, and points around which."""

RANGE = 1.5
"""Largest of these distances, in lengths of the reference correlation."""

SMOOTH, LENGTH = "smooth part", "length of the smooth part"
"""Quantities that summarise the bands."""


@dataclass(frozen=True, slots=True)
class LearnedQuantity:
    """Prior and posterior of one quantity of the noise.

    It is a factor (of a frame, of added columns), or has the unit of the observation or, as a
    length, of the points.
    """

    name: str
    believed: LogNormal
    learned: LogNormal
    #: Change of the logarithm's mean in standard deviations of the prior, without the resolution; 0
    #: if the quantity is held.
    stretch: float
    is_factor: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class LearnedNoise:
    """Posterior of the noise."""

    posterior: Gaussian  #: of the logarithms of the family's quantities
    #: for a reader: standard deviation and length of the smooth part (at which its correlation is
    #: that of a Matérn correlation at its length), and all others; the rough part includes the
    #: resolution
    quantities: tuple[LearnedQuantity, ...]
    noise: ObservationNoise  #: at the mean, added columns included
    #: (p, p) in filter coordinates, added to the covariance of the estimate by the uncertainty of θ
    covariance: FloatArray


class Posterior(NamedTuple):
    """Mode, mean and a root of the covariance of coordinates u."""

    mode: FloatArray
    mean: FloatArray
    spread: FloatArray


class Evidence:
    """log p(e | θ) of the innovation e (n,) and B = H L (n, p), with the prior covariance P = L Lᵀ.

    The prior of log θ is N(0, I) in coordinates u: log θ = mean + root u.

    Attributes
    ----------
    rows : (r, 1 + p + q)
        Innovation, columns of the parameters, and added columns.
    kind, count : (r,), (v,)
        Index of each row's variance, and number of observations with each variance.
    added : list of (int, slice)
        Index of a quantity, and the columns of which it is the factor.
    log_scale : float
        log det D².
    """

    def __init__(self, family: NoiseFamily, innovation: FloatArray, B: FloatArray) -> None:
        self.family, self.prior = family, family.prior
        self.root = self.prior.factor
        columns = [own.columns for own in family.columns]
        data = np.concatenate([innovation[:, None], B, *columns], axis=1)
        ends = np.cumsum([B.shape[1], *(own.shape[1] for own in columns)]).tolist()
        quantities = range(len(family.names) - len(columns), len(family.names))
        self.added = list(zip(quantities, map(slice, ends, ends[1:]), strict=True))
        width = data.shape[1]
        rows, kind = [], []
        self.count = np.zeros(len(family.terms.weight))
        self.log_scale, at, first = 0.0, 0, 0
        for block in family.blocks:
            k, copies, m = len(block.scale), block.coordinates, block.variance_count - 1
            part = data[at : at + block.size].reshape(k, -1) / block.scale[:, None]
            at += block.size
            self.log_scale += 2.0 * copies * float(np.sum(np.log(block.scale)))
            if block.basis is not None:
                inside = block.basis.U.T @ part
                part = part - block.basis.U @ inside
                rows.append(inside.reshape(-1, width))
                kind.append(np.repeat(np.arange(first, first + m), copies))
                self.count[first : first + m] = copies
            if k > m:
                triangle = np.asarray(np.linalg.qr(part.reshape(-1, width), mode="r"))
                rows.append(triangle)
                kind.append(np.full(len(triangle), first + m))
                self.count[first + m] = (k - m) * copies
            first += m + 1
        self.rows, self.kind = np.concatenate(rows), np.concatenate(kind)

    def log(self, u: FloatArray) -> FloatArray:
        """Logarithms of θ ``(h,)``."""
        return np.asarray(self.prior.mean + self.root @ u)

    def posterior(self, start: FloatArray | None = None) -> Posterior:
        """Approximate posterior of u.

        With few observations, the most probable variance is too small. The mean is to first order
        ``u − ½ H⁻¹ d(log det H)/du`` with the second derivatives H (Tierney and Kadane 1986, J. Am.
        Stat. Assoc. 81:82). With the columns s of a root of H⁻¹ and the slope g of the objective,
        that is ``u − ½ H⁻¹ Σ (g(u + s) − 2 g(u) + g(u − s))``.
        """
        h = self.prior.size
        u = np.zeros(h) if start is None else start
        if not self.root.any():
            return Posterior(u, u, np.zeros((h, h)))
        u = np.asarray(
            scipy.optimize.minimize(
                self.objective, u, jac=True, method="BFGS", options={"gtol": TOLERANCE}
            ).x
        )
        hessian = np.empty((h, h))
        for k in range(h):
            step = DIFFERENCE * np.eye(h)[k]
            hessian[k] = self.objective(u + step)[1] - self.objective(u - step)[1]
        values, V = np.linalg.eigh((hessian + hessian.T) / (4.0 * DIFFERENCE))
        # Data never reduce certainty.
        values = np.maximum(values, 1.0)
        spread = V / np.sqrt(values)
        slope = self.objective(u)[1]
        bend = sum(
            self.objective(u + s)[1] - 2.0 * slope + self.objective(u - s)[1] for s in spread.T
        )
        moved = -0.5 * spread.T @ bend
        moved /= max(1.0, float(np.linalg.norm(moved)))
        return Posterior(u, u + spread @ moved, spread)

    def objective(self, u: FloatArray) -> tuple[float, FloatArray]:
        """−log p(e | θ) − log p(θ) up to a constant, and its derivatives by u."""
        value, slope = self.misfit(self.log(u))
        return value + 0.5 * float(u @ u), self.root.T @ slope + u

    def misfit(self, log: FloatArray) -> tuple[float, FloatArray]:
        """−log p(e | θ) − ½ n log 2π, and its derivatives by log θ.

        With V the diagonal R, B all columns and M = I + Bᵀ V⁻¹ B::

            log det S = log det V + log det M,   S⁻¹ = V⁻¹ − V⁻¹ B M⁻¹ Bᵀ V⁻¹
            d/dθ (½ log det S + ½ eᵀ S⁻¹ e) = ½ tr(S⁻¹ dS/dθ) − ½ eᵀ S⁻¹ dS/dθ S⁻¹ e
        """
        v, smooth, rough = self.family.variances(log)
        of = self.family.terms
        e, B, root, mean = self._solved(log, v)
        residual = e - B @ mean
        half = _forward(root, B.T)
        log_det = float(self.count @ np.log(v)) + self.log_scale
        log_det += 2.0 * float(np.sum(np.log(np.diagonal(root))))
        # Derivative by the logarithm of each standard deviation.
        by_row = np.sum(half**2, axis=0) + residual**2
        by_std = self.count - np.bincount(self.kind, by_row, len(v))
        slope = np.zeros(len(log) + 1)
        np.add.at(slope, of.rough, by_std * rough)
        # Rows without a frame's factor have the index -1 and add to the entry that is dropped.
        np.add.at(slope, of.frame, by_std)
        if self.family.bands is not None:
            np.add.at(slope, of.band, by_std * smooth)
        for k, members in self.added:
            # For unit variances Bᵀ S⁻¹ B = I − M⁻¹, and Bᵀ S⁻¹ e is the mean.
            inverse = _forward(root, np.eye(len(mean))[:, members])
            q = inverse.shape[1]
            slope[k] = q - float(np.sum(inverse**2)) - float(mean[members] @ mean[members])
        return 0.5 * (log_det + float(e @ residual)), slope[:-1]

    def update(self, log: FloatArray, p: int) -> tuple[FloatArray, FloatArray]:
        """Posterior mean ``(p,)`` and covariance of the first p unit quantities, for log θ."""
        _, _, root, mean = self._solved(log, self.family.variances(log)[0])
        inverse = _forward(root, np.eye(len(mean))[:, :p])
        return mean[:p], inverse.T @ inverse

    def _solved(
        self, log: FloatArray, v: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Weighted innovation and columns, the root of M, and M⁻¹ Bᵀ V⁻¹ e."""
        weighted = self.rows / np.sqrt(v)[self.kind][:, None]
        e, B = weighted[:, 0], weighted[:, 1:]
        for k, members in self.added:
            B[:, members] *= np.exp(log[k])
        M = B.T @ B
        M[np.diag_indices_from(M)] += 1.0
        root = scipy.linalg.cholesky(M, lower=True, check_finite=False)
        return e, B, root, scipy.linalg.cho_solve((root, True), B.T @ e, check_finite=False)

    def learned(self, posterior: Posterior, L: FloatArray) -> LearnedNoise:
        """The learned noise, for a prior covariance P = L Lᵀ of the parameters."""
        u, h, p = posterior.mean, self.prior.size, len(L)
        P = self.update(self.log(u), p)[1]
        more = np.zeros((p, p))
        # Points of a cubature rule of third degree for h normal numbers are √h away.
        for direction in np.sqrt(h) * posterior.spread.T:
            up, P_up = self.update(self.log(u + direction), p)
            down, P_down = self.update(self.log(u - direction), p)
            more += np.outer(up - down, up - down) / (4.0 * h) + (P_up + P_down - 2.0 * P) / (2 * h)
        spread = self.root @ posterior.spread
        found = Gaussian(self.log(u), spread @ spread.T)
        return LearnedNoise(
            found,
            _quantities(self.family, self.prior, found),
            self.family.at(found.mean),
            L @ more @ L.T,
        )


def _forward(root: FloatArray, columns: FloatArray) -> FloatArray:
    return np.asarray(scipy.linalg.solve_triangular(root, columns, lower=True, check_finite=False))


def _quantities(
    family: NoiseFamily, prior: Gaussian, posterior: Gaussian
) -> tuple[LearnedQuantity, ...]:
    """The quantities of a family for a reader."""

    def with_resolution(of: Gaussian, k: int, least: float) -> LogNormal:
        variance = np.exp(2.0 * of.mean[k])
        factor = np.exp(of.std[k] * variance / (variance + least))
        return LogNormal(float(np.sqrt(variance + least)), float(factor))

    def in_stds(change: float, std: float) -> float:
        return float(change / std) if std > 0.0 else 0.0

    quantities, first = [], 0
    basis = next((block.basis for block in family.blocks if block.basis is not None), None)
    if basis is not None:
        first = BANDS
        for name, amount in _amounts(basis).items():
            before = _log_normal(amount, prior.mean, prior.covariance)
            after = _log_normal(amount, posterior.mean, posterior.covariance)
            change = np.log(after.median / before.median)
            quantities.append(LearnedQuantity(name, before, after, in_stds(change, before.log_std)))
    factors = {block.frame for block in family.blocks} | {c.name for c in family.columns}
    rough = {block.rough for block in family.blocks}
    for k, name in enumerate(family.names[first:], first):
        least = family.resolution**2 if name in rough else 0.0
        before, after = (with_resolution(of, k, least) for of in (prior, posterior))
        stretch = in_stds(posterior.mean[k] - prior.mean[k], prior.std[k])
        quantities.append(LearnedQuantity(name, before, after, stretch, name in factors))
    return tuple(quantities)


def _log_normal(
    amount: Callable[[FloatArray], float], mean: FloatArray, covariance: FloatArray
) -> LogNormal:
    """The exponential of an amount of the bands, which come first, to first order."""
    m, step = mean[:BANDS], 1e-3
    slope = np.array(
        [(amount(m + step * e) - amount(m - step * e)) / (2.0 * step) for e in np.eye(BANDS)]
    )
    variance = max(0.0, float(slope @ covariance[:BANDS, :BANDS] @ slope))
    return LogNormal(float(np.exp(amount(m))), float(np.exp(np.sqrt(variance))))


def _amounts(basis: Basis) -> dict[str, Callable[[FloatArray], float]]:
    """Logarithms of the smooth part's standard deviation and length as functions of its bands.

    They follow from its covariance at the distances of the shells per unit s_b².
    """
    centres = spread_points(basis.points, min(len(basis.points), CENTRES))
    apart = cdist(basis.points[centres], basis.points)
    near = apart < RANGE * basis.length
    apart = apart[near]
    edges = np.linspace(0.0, float(apart.max()), SHELLS + 1)[1:-1]
    shell = np.digitize(apart, edges)
    count = np.bincount(shell, minlength=SHELLS)
    filled = count > 0

    def mean(values: FloatArray) -> FloatArray:
        return np.bincount(shell, values, SHELLS)[filled] / count[filled]

    own = np.sum(basis.U**2, axis=0) / len(basis.U)
    by_band = np.zeros((BANDS, 1 + np.count_nonzero(filled)))
    for band in np.unique(basis.band):
        members = basis.band == band
        U, w = basis.U[:, members], basis.w[members]
        by_band[band, 1:] = mean(((U[centres] * w) @ U.T)[near])
        by_band[band, 0] = float(own[members] @ w)
    distance = np.append(0.0, mean(apart))
    level = float(matern(np.ones(1), 1.0)[0])

    def log_std(bands: FloatArray) -> float:
        return float(0.5 * np.log(np.exp(2.0 * bands) @ by_band[:, 0]))

    def log_length(bands: FloatArray) -> float:
        """Distance at which the correlation is that of a Matérn correlation at its length."""
        covariance = np.exp(2.0 * bands) @ by_band
        below = np.flatnonzero(covariance[1:] < level * covariance[0])
        if not below.size:
            return float(np.log(distance[-1]))
        j = int(below[0]) + 1
        share = covariance[j - 1 : j + 1] / covariance[0]
        at = (share[0] - level) / (share[0] - share[1])
        return float(np.log(distance[j - 1] + at * (distance[j] - distance[j - 1])))

    return {SMOOTH: log_std, LENGTH: log_length}
