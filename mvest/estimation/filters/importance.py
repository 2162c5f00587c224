"""Weighted draws from the posterior itself, whatever its form."""

from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from mvest.errors import InputError
from mvest.estimation.check import ApproximationCheck
from mvest.estimation.estimate import Estimate, Reason
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian, standard
from mvest.estimation.prediction import Prediction
from mvest.estimation.run import Filter, FilterRun, by_filter
from mvest.typing import FloatArray, IntArray

K_HAT_LIMIT = 0.7
"""Largest shape of the weights' tail for a reliable mean (Vehtari et al. 2024)."""

PRIOR_SHARE = 0.1
"""Share of each round's draws from the prior, so that no region of it is left out."""

EXPLORING = 3
"""Rounds before kernels are chosen by weight."""

KERNELS = 24
"""Largest number of runs around which the next are drawn."""

WIDTHS = (1.0, 0.5, 0.25, 0.1)
"""Candidate widths of these kernels, in parts of the posterior linearised at the run."""

FEWEST = 25
"""Smallest number of weights to which the tail is fitted."""

NOTHING = 50.0
"""Weights smaller than the largest by this logarithm are set to zero and not fitted."""

DRAWS = 4000
"""Equally weighted draws in an estimate."""


@dataclass(frozen=True, slots=True)
class ImportanceFilter(Filter):
    """Weighted draws from the posterior; the proposals use the model's derivatives.

    In coordinates x in which the prior is N(0, I), with π(x) = exp(−J(x)):

    1. The posterior's mode and its Gaussian N(x₀, P₀) come from ``start``.
    2. A round draws points from a mixture q and runs the model there. The first mixture is of
       N(x₀, P₀), wider, and the prior. Later ones add kernels N(xᵢ, s² Pᵢ) around runs with large
       weights, where Pᵢ = (I + Hᵢᵀ R⁻¹ Hᵢ)⁻¹ is the posterior linearised at xᵢ, so that they
       follow a curved ridge (gradient adaptive population importance sampling, Elvira, Martino,
       Luengo and Corander 2015, IEEE ICASSP 4075). s gives the weighted draws so far the largest
       probability, each left out of its own kernel.
    3. All draws of all rounds are weighted by π over the mixture of all proposals (Cornuet, Marin,
       Mira and Robert 2012, Scand. J. Stat. 39:798), which the prior's share bounds.

    until there are enough effective draws, or runs. The weights are smoothed by a generalised
    Pareto tail (Vehtari, Simpson, Gelman, Yao and Gabry 2024, J. Mach. Learn. Res. 25:72); they are
    unreliable above a shape k̂ of 0.7.

    A model without derivatives has P₀ for every Pᵢ, and needs a ``start`` that takes such a model,
    for example `UnscentedFilter`.
    """

    #: largest number of runs of the model, without those of `start`, and runs of each round
    runs: int = 320
    batch: int = 32
    effective: float = 60.0  #: sufficient number of effective draws
    #: finds x₀ and P₀
    start: Filter = field(default_factory=lambda: IteratedFilter(tolerance=0.01))
    seed: int = 1

    def __post_init__(self) -> None:
        if not (self.runs >= self.batch >= 10 and self.effective > 1.0):
            raise InputError(
                f"importance sampling needs batches of at least 10, no fewer runs, and more than "
                f"one effective draw; got {self.batch}, {self.runs} and {self.effective:g}"
            )

    def estimate(self, run: FilterRun) -> Estimate:
        """Draw from the posterior."""
        first = self.start(
            run.model, run.physical_prior, run.y, run.R, names=run.names, transform=run.transform
        )
        run.forward_solves += first.forward_solves
        if first.prediction is None:
            z = first.transformed
            return run.fail(z.mean, z.covariance, Prediction.failed(first.detail))
        at, last = first.transformed, (first.objective[-1], first.log_likelihood[-1])
        run.record(at.mean, at.covariance, *map(float, last))
        rng, L = np.random.default_rng(self.seed), run.L
        draws = _Draws(run, standard(run.prior, at))
        while True:
            draws.more(min(self.batch, self.runs - len(draws.points)), rng)
            weights, k_hat, effective = draws.weights()
            good = effective >= self.effective and k_hat <= K_HAT_LIMIT
            good = good and len(draws.rounds) > EXPLORING
            if good or len(draws.points) >= self.runs:
                break
        x = weights @ draws.points
        spread = draws.points - x
        chosen = draws.points[rng.choice(len(weights), DRAWS, p=weights)]
        checks = [
            ApproximationCheck(compared, value, limit, len(weights))
            for compared, value, limit in (
                ("effective draws, how many times too few", self.effective / effective, 1.0),
                ("tail of the weights, Pareto k", max(k_hat, 0.0), K_HAT_LIMIT),
            )
        ]
        return run.finish_with_slope(
            run.z(x),
            L @ (spread.T * weights) @ spread @ L.T,
            by_filter(draws.slope, L),
            Reason.COMPLETED if good else Reason.NOT_SAMPLED,
            f"{len(weights)} weighted draws, {effective:.0f} effective, Pareto k {k_hat:.2f}",
            run.prior.mean + chosen @ L.T,
            checks,
        )


class _Draws:
    """Draws ``points (s, p)`` of all rounds, with their mixtures (shares, means and covariances).

    ``slope (n, p)`` is dh/dx at the last run with derivatives; 0 without any.
    """

    def __init__(self, run: FilterRun, laplace: Gaussian) -> None:
        self._run, self._laplace = run, laplace
        self.points = np.empty((0, laplace.size))
        self.slope = np.zeros((run.y.size, laplace.size))
        self._log_target = np.empty(0)
        self._moved: list[tuple[FloatArray, FloatArray]] = []
        self._covariances: list[FloatArray] = []
        self.rounds: list[tuple[int, list[tuple[float, FloatArray, FloatArray]]]] = []

    def more(self, count: int, rng: np.random.Generator) -> None:
        """Draw from the next mixture, and run the model there."""
        mixture, p = self._mixture(), self._laplace.size
        shares = np.array([share for share, _, _ in mixture])
        # Stratified: each part in proportion to its share, up to rounding.
        edges = (np.arange(count) + rng.random()) / count
        which = np.searchsorted(np.cumsum(shares / shares.sum()), edges)
        drawn = np.array(
            [
                mixture[k][1] + np.linalg.cholesky(mixture[k][2]) @ rng.standard_normal(p)
                for k in np.minimum(which, len(mixture) - 1)
            ]
        )
        self.rounds.append((count, mixture))
        values = [self._evaluate(x) for x in drawn]
        self.points = np.vstack([self.points, drawn])
        self._log_target = np.append(self._log_target, values)

    def weights(self) -> tuple[FloatArray, float, float]:
        """Smoothed weights (s,) that sum to 1, their k̂, and the number of effective draws."""
        from arviz_stats.base import array_stats  # takes a second, for this function alone

        count = len(self.points)
        parts = [
            np.log(drawn / count) + self._log_mixture(mixture) for drawn, mixture in self.rounds
        ]
        raw = self._log_target - logsumexp(parts, axis=0)
        possible = raw > max(float(np.max(raw)), -1e300) - NOTHING
        weights = np.zeros(count)
        k_hat = np.inf
        smoothed: FloatArray = raw[possible]
        if len(smoothed) >= FEWEST:
            smoothed, k_hat = array_stats.psislw(-smoothed)  # it takes log-likelihoods
        if not np.any(possible):
            return np.full(count, 1.0 / count), np.inf, 1.0
        weights[possible] = np.exp(smoothed - logsumexp(smoothed))
        return weights, float(k_hat), float(1.0 / np.sum(weights**2))

    def _evaluate(self, x: FloatArray) -> float:
        """Logarithm of π(x); −∞ where the model gives no prediction."""
        z = self._run.z(x)
        prediction = self._run.predict(z, derivatives=False)
        covariance = self._laplace.covariance
        value = -np.inf
        if prediction.converged:
            value = -self._run.misfit(prediction) - 0.5 * float(x @ x)
            if prediction.differentiated:
                self.slope = self._run.jacobian(z, prediction) @ self._run.L
                A = self._run.noise.whiten(self.slope)
                covariance = np.asarray(np.linalg.inv(np.eye(len(x)) + A.T @ A), np.float64)
                e = self._run.noise.whiten(self._run.y - prediction.y)
                self._moved.append((covariance @ (A.T @ (e + A @ x)), covariance))
        self._covariances.append(0.5 * (covariance + covariance.T))
        return value

    def _mixture(self) -> list[tuple[float, FloatArray, FloatArray]]:
        """Shares, means and covariances of the next proposal."""
        p = self._laplace.size
        wide = self._laplace.covariance * 1.3**2
        prior = (PRIOR_SHARE, np.zeros(p), np.eye(p))
        if not self.rounds:
            return [(0.5, self._laplace.mean, wide), (0.5, *prior[1:])]
        if len(self.rounds) < EXPLORING and self._moved:
            share = (0.9 - PRIOR_SHARE) / len(self._moved)
            moved = [(share, mean, 0.25 * P) for mean, P in self._moved]
            self._moved = []
            return [*moved, (0.1, self._laplace.mean, wide), prior]
        weights, _, _ = self.weights()
        order = np.argsort(-weights)[:KERNELS]
        tempered = np.sqrt(weights[order])
        tempered /= tempered.sum()
        width = self._width(order, tempered, weights)
        kernels = [
            ((0.9 - PRIOR_SHARE) * share, self.points[i], width**2 * self._covariances[i])
            for i, share in zip(order, tempered, strict=True)
            if share > 0.0
        ]
        return [*kernels, (0.1, self._laplace.mean, wide), prior]

    def _width(self, order: IntArray, shares: FloatArray, weights: FloatArray) -> float:
        """Width of the kernels under which the weighted draws so far are most probable."""
        scores = []
        for width in WIDTHS:
            parts = np.array(
                [
                    np.log(max(share, 1e-300))
                    + _log_normal(self.points, self.points[i], width**2 * self._covariances[i])
                    for i, share in zip(order, shares, strict=True)
                ]
            )
            parts[np.arange(len(order)), order] = -np.inf
            at = logsumexp(parts, axis=0)
            # The prior's share bounds the score of a draw that no other kernel reaches.
            prior = np.log(PRIOR_SHARE) - 0.5 * np.sum(self.points**2, axis=1)
            scores.append(float(weights @ np.maximum(at, prior)))
        return WIDTHS[int(np.argmax(scores))]

    def _log_mixture(self, mixture: list[tuple[float, FloatArray, FloatArray]]) -> FloatArray:
        total = sum(share for share, _, _ in mixture)
        parts = [np.log(share / total) + _log_normal(self.points, *of) for share, *of in mixture]
        return np.asarray(logsumexp(parts, axis=0))


def _log_normal(points: FloatArray, mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Logarithm of N(points; mean, covariance) (s,), without the constant of its size."""
    L = np.linalg.cholesky(covariance)
    u = np.linalg.solve(L, (points - mean).T)
    return np.asarray(-0.5 * np.sum(u**2, axis=0) - np.log(np.diagonal(L)).sum())
