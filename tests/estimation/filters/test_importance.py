"""Weighted draws against posteriors that are known, in a few hundred runs of the model."""

import numpy as np
import pytest

from mvest.estimation import Gaussian, ImportanceFilter, Reason, UnscentedFilter
from tests.estimation.problems import Linear, banana, gridded, wings


@pytest.mark.parametrize(("y", "R"), [(0.0, 0.01), (1.0, 0.05), (2.0, 0.01)])
def test_a_banana_is_drawn_as_one(y, R) -> None:
    prior = Gaussian(np.array([0.3, 0.0]), np.eye(2))
    mean, std, kurtosis = gridded(banana, prior, np.array([y]), R)
    found = ImportanceFilter(effective=100.0)(banana, prior, np.array([y]), R)
    assert found.trusted, found.why
    # Four standard errors of a mean of 100 effective draws, and of a standard deviation of theirs.
    assert np.all(np.abs(found.mean - mean) < 4.0 * std / 10.0)
    # The latter has the relative variance (kurtosis - 1)/(4 n).
    assert np.all(np.abs(np.log(found.std / std)) < 2.0 * np.sqrt((kurtosis - 1.0) / 100.0))
    assert found.forward_solves < 340


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_both_wings_are_seen(seed) -> None:
    prior = Gaussian(np.array([0.05]), np.eye(1))
    mean, std, _ = gridded(wings, prior, np.array([1.3]), 0.05)
    found = ImportanceFilter(seed=seed)(wings, prior, np.array([1.3]), 0.05)
    assert found.trusted, found.why
    assert abs(found.mean[0] - mean[0]) < 4.0 * std[0] / np.sqrt(60.0)
    assert found.std[0] == pytest.approx(std[0], rel=0.2)
    low, high = found.interval()
    assert low[0] < -1.0
    assert high[0] > 1.0


@pytest.mark.parametrize("p", [2, 5, 11, None])
def test_on_a_linear_model_it_is_the_kalman_filter_within_its_error(p) -> None:
    # Also drawn from a model without derivatives.
    problem = Linear(n=30, p=p, seed=1) if p else Linear(p=2)
    start = {} if p else {"start": UnscentedFilter()}
    found = problem.by(ImportanceFilter(**start), plain=not p)
    assert found.reason is Reason.COMPLETED
    std = np.sqrt(np.diagonal(problem.covariance))
    assert np.all(np.abs(found.mean - problem.mean) < 4.0 * std / np.sqrt(60.0))
    assert np.all(np.abs(np.log(found.std / std)) < 4.0 / np.sqrt(120.0))
