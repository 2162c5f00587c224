"""The diagnostics' own numbers, and that they catch what they are for."""

import numpy as np
import pytest
from scipy import sparse

from mvest.estimation import (
    Gaussian,
    IteratedFilter,
    Prediction,
    moran,
    nees,
)
from tests.estimation.problems import consistent


def test_statistics_by_hand():
    # P^-1 = [[2, -1], [-1, 2]]/3 and e = (1, 2): (2 - 4 + 8)/3 = 2.
    assert nees(np.array([1.0, 2.0]), np.array([[2.0, 1.0], [1.0, 2.0]])) == pytest.approx(2.0)
    # A path of four with weight 1 both ways: I = (4/6)(2*1.25)/5 = 1/3.
    assert moran(np.array([1.0, 2.0, 3.0, 4.0]), path(4)) == pytest.approx(1 / 3)


def path(n):
    return sparse.diags_array([np.ones(n - 1), np.ones(n - 1)], offsets=[-1, 1])


# --- Monte Carlo: is the filter's own uncertainty honest? -----------------------------------------


def monte_carlo(method, model, runs):
    """NEES, NIS and innovations of `runs` problems whose truth is drawn from the prior."""
    rng = np.random.default_rng(5)
    errors, nis, innovations = [], [], []
    for _ in range(runs):
        truth = rng.multivariate_normal(LINEAR_PRIOR.mean, LINEAR_PRIOR.covariance)
        y = model(truth).y + 0.3 * rng.standard_normal(12)
        estimate = method(model, LINEAR_PRIOR, y, 0.09)
        errors.append(nees(estimate.mean - truth, estimate.covariance))
        nis.append(estimate.innovation.nis)
        innovations.append(estimate.standardised)
    return np.array(errors), np.array(nis), np.concatenate(innovations)


H = np.random.default_rng(6).standard_normal((12, 2))
LINEAR_PRIOR = Gaussian(np.array([1.0, -2.0]), np.array([[1.0, 0.6], [0.6, 2.0]]))


def linear(m):
    return Prediction(H @ m, H)


def bent(m):
    """The linear model with curvature of a tenth over one standard deviation."""
    y = H @ m
    return Prediction(y + 0.05 * y**2, (1.0 + 0.1 * y)[:, None] * H)


@pytest.mark.parametrize("model", [linear, bent])
def test_iterated_mode_is_consistent(model):
    errors, nis, innovations = monte_carlo(IteratedFilter(), model, runs=400)
    assert consistent(errors, 2)
    assert consistent(nis, 12)
    if model is linear:
        # A linearised innovation has a mean of second order.
        assert abs(innovations.mean()) < 3.0 * innovations.std() / np.sqrt(innovations.size)
