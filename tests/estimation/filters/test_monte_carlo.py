"""Draws from posteriors that are known: within the error that the draws themselves tell."""

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.stats import norm

from mvest.errors import InputError
from mvest.estimation import (
    Gaussian,
    IteratedFilter,
    MonteCarloFilter,
    Prediction,
    Reason,
    SamplerSettings,
)
from mvest.estimation.filters.sampler import draw, split_r_hat
from tests.estimation.problems import Linear, saturating

FEW = SamplerSettings(chains=2, walkers=16, steps=800, least_effective=200.0, largest_r_hat=1.05)
"""Of which a test takes about half a second."""


def normal(points):
    return -0.5 * (points**2).sum(axis=1)


def test_draws_of_a_normal_density_are_normal() -> None:
    settings = SamplerSettings(chains=2, walkers=16, steps=1500)
    start = Gaussian(np.zeros(2), np.eye(2))
    found = draw(normal, start, settings, np.random.default_rng(1))
    # Within four standard errors of the effective number of draws; a variance's is √(2/s).
    assert np.all(np.abs(found.points.mean(axis=0)) < 4 * found.mean_error)
    error = np.abs(found.points.var(axis=0) - 1.0)
    assert np.all(error < 4 * np.sqrt(2 / found.effective))
    # 2 chains of 16 walkers, a quarter of the steps left out.
    assert found.points.shape == (2 * 16 * 1125, 2)
    assert np.all(found.effective < len(found.points))
    assert np.all(found.r_hat < 1.02)


def test_draws_repeat_with_their_seed() -> None:
    start = Gaussian(np.zeros(2), np.eye(2))
    one, same, other = (
        draw(normal, start, SamplerSettings(2, 8, 40), np.random.default_rng(seed)).points
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_chains_that_disagree_are_seen() -> None:
    rng = np.random.default_rng(0)
    chains = rng.standard_normal((2, 500, 8, 1))
    assert split_r_hat(chains)[0] < 1.01
    # Chains one standard deviation apart: the halves' means are ± 1/2, twice each, and their
    # variance 4 (1/2)²/3 = 1/3, so that the factor is √(1 + 1/3).
    chains[1] += 1.0
    assert split_r_hat(chains)[0] == pytest.approx(np.sqrt(4 / 3), rel=0.03)
    # One chain that drifts: its halves disagree.
    drift = rng.standard_normal((2, 500, 8, 1)) + np.linspace(0, 2, 500)[:, None, None]
    assert split_r_hat(drift)[0] > 1.1


@pytest.mark.parametrize("differentiated", [True, False])
def test_on_a_linear_model_it_is_the_kalman_filter_within_its_error(differentiated) -> None:
    problem = Linear(p=2)
    model = problem.differentiated if differentiated else problem.plain
    found = MonteCarloFilter(sampler=FEW)(model, problem.prior, problem.y, problem.R)
    assert found.reason is Reason.COMPLETED
    std = np.sqrt(np.diag(problem.covariance))
    # At least 200 effective draws: four standard errors of a mean are 4/√200 = 0.28 of a standard
    # deviation, of a standard deviation 4/√400 = 0.2 of itself.
    assert np.all(np.abs(found.mean - problem.mean) < 0.28 * std)
    np.testing.assert_allclose(found.std, std, rtol=0.2)
    # The surrogate of a linear model is the model.
    error = float(found.detail.split("±")[1].split(";")[0])
    assert error < 1e-9
    np.testing.assert_allclose(found.prediction.jacobian, problem.H, atol=1e-8)


def test_the_interval_of_a_skew_posterior_is_skew() -> None:
    # h = (e^-m, 2 e^-m), prior N(0, 1), y = 0.1 times (1, 2), R = 0.04: large m are as good as the
    # one that made y, so that the data bound m from below only. The reference is a sum over m.
    prior, y, R = Gaussian(np.zeros(1), np.eye(1)), np.array([0.1, 0.2]), 0.04
    m = np.linspace(-5, 6, 20001)
    h = np.exp(-m)
    density = np.exp(-0.5 * ((y[0] - h) ** 2 + (y[1] - 2 * h) ** 2) / R - 0.5 * m**2)
    cumulated = np.cumsum(density) / density.sum()
    exact = np.interp([0.025, 0.975], cumulated, m)
    mean = trapezoid(density * m, m) / trapezoid(density, m)

    found = MonteCarloFilter(sampler=FEW, tolerance=0.05)(saturating, prior, y, R)
    assert found.reason is Reason.COMPLETED
    low, high = found.interval()
    # The quantiles of 200 draws: √(0.025 · 0.975/200)/density = 0.011/0.06 = 0.2 deviations.
    np.testing.assert_allclose([low[0], high[0]], exact, atol=4 * 0.2 * found.std[0])
    np.testing.assert_allclose(found.mean, mean, atol=0.28 * found.std[0])
    # A Gaussian about the mode is another interval altogether.
    gaussian = IteratedFilter()(saturating, prior, y, R)
    half = norm.ppf(0.975) * gaussian.std[0]
    assert abs(gaussian.mean[0] - half - exact[0]) > 5 * abs(low[0] - exact[0])


def test_a_box_that_cuts_the_posterior_off_is_made_larger() -> None:
    # A first box of a quarter of a standard deviation holds a fifth of the posterior only.
    problem = Linear(p=2)
    narrow = MonteCarloFilter(sampler=FEW, width=0.25)
    found = narrow(problem.plain, problem.prior, problem.y, problem.R)
    assert found.reason is Reason.COMPLETED
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(problem.covariance)), rtol=0.2)


def test_too_few_draws_are_no_estimate() -> None:
    problem = Linear(p=2)
    asks = SamplerSettings(chains=2, walkers=8, steps=60, least_effective=1e6)
    found = MonteCarloFilter(sampler=asks)(problem.plain, problem.prior, problem.y, problem.R)
    assert found.reason is Reason.NOT_SAMPLED
    assert not found.converged


def test_a_surrogate_that_stays_wrong_is_no_posterior() -> None:
    # Noise of the model itself cannot be fitted: the check by further runs finds it.
    rng = np.random.default_rng(0)

    def rough(m):
        return Prediction.undifferentiated(np.repeat(m, 4) + 0.5 * rng.standard_normal(4))

    prior = Gaussian(np.zeros(1), np.eye(1))
    found = MonteCarloFilter(sampler=FEW, max_rounds=2)(rough, prior, np.zeros(4), 0.01)
    assert found.reason is Reason.NOT_SAMPLED


def test_runs_are_counted_and_a_failing_model_ends_the_run() -> None:
    problem, calls = Linear(p=2), []

    def counted(m):
        calls.append(m)
        return problem.plain(m)

    found = MonteCarloFilter(sampler=FEW)(counted, problem.prior, problem.y, problem.R)
    assert found.forward_solves == len(calls)
    failed = MonteCarloFilter(sampler=FEW)(
        lambda m: Prediction.failed("no valve"), problem.prior, problem.y, problem.R
    )
    assert failed.reason is Reason.MODEL_FAILED
    assert "no valve" in failed.detail


@pytest.mark.parametrize("settings", [{"tolerance": 0.0}, {"runs": 0}, {"width": -1.0}])
def test_inadmissible_settings_are_refused(settings) -> None:
    with pytest.raises(InputError):
        MonteCarloFilter(**settings)


@pytest.mark.parametrize("settings", [{"chains": 1}, {"walkers": 2}, {"largest_r_hat": 1.0}])
def test_an_inadmissible_sampler_is_refused(settings) -> None:
    with pytest.raises(InputError):
        SamplerSettings(**settings)
