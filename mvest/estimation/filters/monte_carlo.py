"""The posterior itself, by Monte Carlo: what the Gaussian filters are to be measured against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.check import ApproximationCheck
from mvest.estimation.estimate import Estimate, OnIterate, Reason
from mvest.estimation.filters.sampler import Draws, LogDensity, SamplerSettings, draw
from mvest.estimation.filters.surrogate import (
    Misfit,
    Region,
    Surrogate,
    affordable_degree,
    fit_surrogate,
)
from mvest.estimation.filters.unscented import UnscentedFilter
from mvest.estimation.gaussian import Gaussian, standard
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.estimation.run import FilterRun, by_filter
from mvest.estimation.transform import Transform
from mvest.typing import FloatArray

FURTHEST = 4.5
"""Prior standard deviations beyond which no region reaches."""

EDGE = 0.9
"""Part of the region outside which there must be almost no draw."""

ALMOST_NONE = 2e-3
"""Share of the draws."""

ROOM = 1.5
"""Width of a renewed region over that of the draws, along each of its axes."""

LOOK = 400
"""Steps of the sampler before the surrogate is good enough."""


@dataclass(frozen=True, slots=True)
class MonteCarloFilter:
    """Draws from the posterior of a surrogate that is fitted to the model until it is good enough.

    1. A Gaussian of the posterior, N(x, P), is found by `UnscentedFilter`. All runs of the model
       are kept.
    2. The model is run at points that fill a box about it (Sobol's points, scrambled), and a
       polynomial is fitted to all runs in the box (`mvest.estimation.filters.surrogate`).
    3. The posterior that has the polynomial for a model is drawn from
       (`mvest.estimation.filters.sampler`). A box that cuts draws off is made larger.
    4. The model is run at some of the draws. The error of the surrogate is the standard deviation,
       over these, of the difference between both logarithms of the likelihood: 0.1 changes the
       probability of a draw by about a tenth. If it is above the tolerance these runs are added,
       and 2 to 4 repeated; they lie where the posterior does.

    The mean and the covariance are those of the draws, and the intervals their quantiles. The
    detail of the estimate tells the error of the surrogate and how good the draws are.

    Attributes
    ----------
    tolerance : float
        Largest standard deviation of the error of the log-likelihood.
    runs : int
        Runs of the model that fill the first box, and a larger one.
    checks : int
        Runs at draws, in each round.
    max_rounds : int
    degree : int
        Largest degree of the polynomial.
    width : float
        Half-width of the first box in standard deviations of the Gaussian.
    sampler : SamplerSettings
    start : UnscentedFilter
    seed : int
        Of all random numbers.

    Raises
    ------
    InputError
        If a setting, a shape or a covariance is not admissible; never for a failing model.
    """

    tolerance: float = 0.1
    runs: int = 16
    checks: int = 8
    max_rounds: int = 8
    degree: int = 6
    width: float = 4.0
    sampler: SamplerSettings = field(default_factory=SamplerSettings)
    start: UnscentedFilter = field(default_factory=lambda: UnscentedFilter(tolerance=0.02))
    seed: int = 1

    def __post_init__(self) -> None:
        if not (np.isfinite(self.tolerance) and self.tolerance > 0 and self.width > 0):
            raise InputError(
                f"the tolerance and the width of a Monte Carlo filter must be positive; got "
                f"{self.tolerance} and {self.width}"
            )
        if min(self.runs, self.checks, self.max_rounds, self.degree) < 1:
            raise InputError("runs, checks, max_rounds and degree must be at least 1")

    def __call__(
        self,
        model: ObservationModel,
        prior: Gaussian,
        y: FloatArray,
        R: NoiseCovariance,
        *,
        names: Sequence[str] | None = None,
        transform: Transform | None = None,
        on_iterate: OnIterate | None = None,
    ) -> Estimate:
        """Draw from the posterior; see `Filter` for the arguments."""
        kept: list[tuple[FloatArray, Prediction]] = []

        def recorded(m: FloatArray) -> Prediction:
            prediction = predict(model, m)
            if prediction.converged:
                kept.append((m, prediction))
            return prediction

        run = FilterRun(recorded, prior, y, R, names, transform, on_iterate)
        first = self.start(recorded, prior, y, R, names=names, transform=transform)
        run.forward_solves += first.forward_solves
        z, P = first.transformed.mean, first.transformed.covariance
        if first.prediction is None:
            return run.fail(z, P, Prediction.failed(first.detail))
        run.record(z, P, float(first.objective[-1]), float(first.log_likelihood[-1]))

        rng = np.random.default_rng(self.seed)
        explored = self._explore(_Runs(run, kept), standard(run.prior, first.transformed), rng)
        if isinstance(explored, Prediction):
            return run.fail(z, P, explored)
        surrogate, at, error, rounds = explored
        density = log_posterior(surrogate.misfit(run.y, run.noise))
        draws = draw(density, at, self.sampler, rng)
        L, x = run.prior.factor, draws.points.mean(axis=0)
        return run.finish_with_slope(
            run.prior.mean + L @ x,
            L @ np.cov(draws.points.T).reshape(at.size, -1) @ L.T,
            by_filter(surrogate.jacobian(x), L),
            self._reason(draws, error),
            f"{rounds} rounds; log-likelihood of the surrogate ± {error:.2g}; "
            f"{draws.effective.min():.0f} effective draws, R-hat {draws.r_hat.max():.3f}",
            run.prior.mean + draws.points @ L.T,
            self._checks(draws, error),
        )

    def _explore(
        self, runs: _Runs, at: Gaussian, rng: np.random.Generator
    ) -> tuple[Surrogate, Gaussian, float, int] | Prediction:
        """Surrogate, Gaussian of its posterior, error and rounds; or why there is none."""
        look = replace(self.sampler, steps=min(LOOK, self.sampler.steps))
        region = Region(at.mean, self.width * at.factor)
        runs.fill(region, self.runs, rng)
        rounds, error = 0, np.inf
        while True:
            rounds += 1
            surrogate = runs.fit(region, self.degree)
            if surrogate is None:
                return Prediction.failed("the model fails at most points about the posterior")
            misfit = surrogate.misfit(runs.run.y, runs.run.noise)
            points = draw(log_posterior(misfit), at, look, rng).points
            at = Gaussian(points.mean(axis=0), np.cov(points.T).reshape(at.size, -1))
            cut = np.mean(~region.holds(points, EDGE)) > ALMOST_NONE
            last = rounds == self.max_rounds
            # A surrogate that is used is measured, also where its region still cuts draws off.
            if not cut or last:
                error = runs.check(misfit, rng.choice(points, self.checks, replace=False))
            if (error <= self.tolerance and not cut) or last:
                return surrogate, at, error, rounds
            if cut:
                region = _around(points)
                runs.fill(region, self.runs, rng)

    def _checks(self, draws: Draws, error: float) -> list[ApproximationCheck]:
        """The surrogate against the model where the draws are, and the draws against each other."""
        count = self.checks
        return [
            ApproximationCheck(
                "log-likelihoods by the surrogate and by the model at draws, standard deviation",
                error,
                self.tolerance,
                count,
                count,
            ),
            ApproximationCheck(
                f"effective draws ({draws.effective.min():.0f}, autocorrelation over "
                f"{draws.autocorrelation_time.max():.0f} steps), how many times too few",
                self.sampler.least_effective / float(draws.effective.min()),
                1.0,
                len(draws.points),
            ),
            ApproximationCheck(
                "disagreement of chains, R-hat",
                float(draws.r_hat.max()),
                self.sampler.largest_r_hat,
                len(draws.points),
            ),
        ]

    def _reason(self, draws: Draws, error: float) -> Reason:
        good = error <= self.tolerance and draws.enough(self.sampler)
        return Reason.COMPLETED if good else Reason.NOT_SAMPLED


def log_posterior(misfit: Misfit) -> LogDensity:
    """``−½ (y − h)ᵀ R⁻¹ (y − h) − ½ |x|²`` where the prior is N(0, I)."""

    def density(points: FloatArray) -> FloatArray:
        return -misfit(points) - 0.5 * np.einsum("kp,kp->k", points, points)

    return density


class _Runs:
    """All runs of the model so far, in coordinates x in which the prior is N(0, I)."""

    def __init__(self, run: FilterRun, kept: list[tuple[FloatArray, Prediction]]) -> None:
        self.run, self._kept = run, kept
        self._L = run.prior.factor

    def fill(self, region: Region, count: int, rng: np.random.Generator) -> None:
        """Run the model at points that fill a region evenly."""
        sobol = scipy.stats.qmc.Sobol(region.centre.size, rng=rng)
        drawn = sobol.random_base2((count - 1).bit_length())[:count]
        for x in region.points(2.0 * drawn - 1.0):
            if np.linalg.norm(x) <= FURTHEST:
                self.run.predict(self.run.prior.mean + self._L @ x, derivatives=False)

    def fit(self, region: Region, max_degree: int) -> Surrogate | None:
        """The polynomial through all runs in a region; None if there are fewer than 3 p."""
        z = np.array([self.run.transform.forward(m) for m, _ in self._kept])
        offset = (z - self.run.prior.mean).T
        points = np.asarray(np.linalg.lstsq(self._L, offset, rcond=None)[0].T, dtype=np.float64)
        inside = np.flatnonzero(region.holds(points, ROOM))
        r, p = len(inside), points.shape[1]
        if r < 3 * p:
            return None
        predictions = [self._kept[i][1] for i in inside]
        values = np.array([prediction.y for prediction in predictions])
        jacobians = None
        if all(prediction.differentiated for prediction in predictions):
            pairs = zip(z[inside], predictions, strict=True)
            jacobians = np.array([self.run.jacobian(at, one) @ self._L for at, one in pairs])
        numbers = r if jacobians is None else r * (1 + p)
        degree = affordable_degree(numbers, p, max_degree)
        return fit_surrogate(points[inside], values, jacobians, region, degree)

    def check(self, misfit: Misfit, points: FloatArray) -> float:
        """Standard deviation of the error of the log-likelihood at points (k, p)."""
        errors = []
        for x in points:
            prediction = self.run.predict(self.run.prior.mean + self._L @ x, derivatives=False)
            if prediction.converged:
                errors.append(float(misfit(x[None])[0]) - self.run.misfit(prediction))
        return float(np.std(errors, ddof=1)) if len(errors) > 1 else np.inf


def _around(points: FloatArray) -> Region:
    """A region with room about draws (s, p), along the axes of their covariance."""
    _, axes = np.linalg.eigh(np.cov(points.T).reshape(points.shape[1], -1))
    t = points @ axes
    low, high = t.min(axis=0), t.max(axis=0)
    room = 0.5 * (ROOM - 1.0) * (high - low)
    low, high = np.maximum(low - room, -FURTHEST), np.minimum(high + room, FURTHEST)
    return Region(axes @ (0.5 * (low + high)), axes * (0.5 * (high - low)))
