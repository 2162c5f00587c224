"""Samples of an estimate and what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import Gaussian, IteratedFilter, Log, Prediction, Reason, observation_noise
from mvest.scenarios.predict import PredictedScenario, Sample, posterior_samples

MEAN, SHIFT = np.array([5.0, 2.0]), np.array([[1.0, 0.6], [0.0, 1.0]])


def estimated():
    """Two positive parameters seen through their logarithms, so that the posterior is normal."""

    def model(m):
        if np.any(m <= 0):
            return Prediction.failed("not positive")
        return Prediction(SHIFT @ np.log(m), SHIFT / m)

    return IteratedFilter(1e-9)(
        model,
        Gaussian.from_variance(np.array([4.0, 3.0]), np.array([9.0, 9.0])),
        SHIFT @ np.log(MEAN),
        observation_noise(np.array([0.01, 0.0025]), 2),
        names=("a", "b"),
        transform=Log(),
    )


def test_samples_have_the_moments_of_the_posterior():
    estimate = estimated()
    posterior = estimate.transformed
    z = np.log(posterior_samples(estimate, 1024, 7))
    # A Sobol sequence of n points is off by about 1/n of a standard deviation, not 1/sqrt(n) = 3 %.
    assert np.all(np.abs(z.mean(axis=0) - posterior.mean) < 0.005 * posterior.std)
    found = np.cov(z.T)
    scale = np.outer(posterior.std, posterior.std)
    assert np.all(np.abs(found - posterior.covariance) < 0.01 * scale)
    assert abs(posterior.covariance[0, 1]) > 0.2 * scale[0, 1]  # or the factor is not tested


def test_samples_follow_the_seed_and_stay_positive():
    estimate = estimated()
    one, again, other = (posterior_samples(estimate, 8, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.any(one == other)
    assert np.all(one > 0)
    assert one.shape == (8, 2)


@pytest.mark.parametrize("count", [0, 1, 24])
def test_other_counts_than_powers_of_two_are_refused(count):
    with pytest.raises(InputError, match=f"samples = {count}, expected a power of two"):
        posterior_samples(estimated(), count, 1)


def test_an_estimate_that_did_not_converge_has_no_samples():
    with pytest.raises(InputError, match="no samples of an estimate that is none"):
        posterior_samples(replace(estimated(), reason=Reason.NO_DECREASE), 8, 1)


def spread_of(values):
    samples = tuple(Sample({"a": float(value)}) for value in values)
    return PredictedScenario(Sample({}), None, (*samples, Sample({}, "did not close"))).spread("a")


def test_the_interval_is_that_of_the_samples():
    # Type 8 of n = 40 numbers 1 to 40: at position (n + 1/3) p + 1/3 = 1.3417 for p = 0.025.
    spread = spread_of(range(1, 41))
    assert spread["samples"] == 40
    assert spread["low"] == pytest.approx(1.3417, abs=1e-4)
    assert spread["high"] == pytest.approx(41 - 1.3417, abs=1e-4)
    assert spread["mean"] == 20.5
    assert spread["std"] == pytest.approx(np.std(range(40), ddof=1))
    # One sample has no spread.
    spread = spread_of([3.0])
    assert (spread["mean"], spread["samples"]) == (3.0, 1)
    assert np.isnan([spread["std"], spread["low"], spread["high"]]).all()
