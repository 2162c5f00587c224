"""Filters in logarithmic coordinates, and what they report in both."""

import numpy as np
import pytest

from mvest.estimation import (
    Gaussian,
    Identity,
    IteratedFilter,
    Log,
    PaperFilter,
    Prediction,
)

PRIOR = Gaussian(np.array([5.0]), np.array([[0.25]]))


def logarithm(m):
    """h(m) = log m, which is linear in the filter's coordinates."""
    if np.any(m <= 0.0):
        return Prediction.failed(f"no logarithm of {m}")
    return Prediction(np.log(m), np.diag(1.0 / m))


def test_log_problem_with_a_known_answer():
    # Prior N(5, 0.25): z0 = log 5, variance 0.25/25 = 0.01. One observation log 6 of z with the
    # same variance pulls halfway: z = log sqrt 30, variance 0.005; back: sqrt 30, 30 * 0.005.
    estimate = IteratedFilter()(logarithm, PRIOR, np.log([6.0]), 0.01, transform=Log())
    assert estimate.transformed.mean[0] == pytest.approx(0.5 * np.log(30), rel=1e-13)
    assert estimate.transformed.covariance[0, 0] == pytest.approx(0.005, rel=1e-12)
    assert estimate.mean[0] == pytest.approx(np.sqrt(30), rel=1e-13)
    assert estimate.covariance[0, 0] == pytest.approx(0.15, rel=1e-12)
    # The reported Jacobian is with respect to the parameter, not to its logarithm.
    assert estimate.prediction.jacobian[0, 0] == pytest.approx(1 / np.sqrt(30))
    for end, sign in zip(estimate.interval(0.95), (-1, 1), strict=True):
        expected = np.sqrt(30) * np.exp(sign * 1.959964 * np.sqrt(0.005))
        assert end[0] == pytest.approx(expected, rel=1e-6)


def test_process_noise_is_carried_into_logarithms_at_the_prior():
    # Q = 0.25 at the prior mean 5 is 0.01 in z: P- = 0.02, K = 0.02/(0.02 + 0.01) = 2/3.
    one_round = PaperFilter(Q=0.25, max_iterations=1, tolerance=1e-300)
    estimate = one_round(logarithm, PRIOR, np.log([6.0]), 0.01, transform=Log())
    assert estimate.transformed.mean[0] == pytest.approx(np.log(5) / 3 + 2 * np.log(6) / 3)
    assert estimate.transformed.covariance[0, 0] == pytest.approx(0.02 / 3)


@pytest.mark.parametrize("transform", [Identity(), Log(), Log((False, True, True))])
def test_derivative_is_that_of_the_inverse(transform):
    z, d = np.array([0.3, -1.2, 2.0]), 1e-6
    difference = (transform.inverse(z + d) - transform.inverse(z - d)) / (2 * d)
    np.testing.assert_allclose(transform.derivative(z), difference, rtol=1e-9)
    np.testing.assert_allclose(transform.forward(transform.inverse(z)), z)
