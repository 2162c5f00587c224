"""A residual that is left times the model's second derivatives is part of the posterior."""

import numpy as np
import pytest
from scipy.optimize import minimize

from mvest.estimation.estimate import Reason
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction

N = 400
RNG = np.random.default_rng(3)
SLOPES = np.linalg.qr(RNG.normal(size=(N, 3)))[0]
LINEAR, BENT = SLOPES[:, :2] * [2.0, 1.5], SLOPES[:, 2]
BEND = np.array([[0.6, 0.2], [0.2, -0.1]])
PRIOR = Gaussian(np.zeros(2), np.eye(2))


def bent(m):
    """A plane, and a little of a saddle across it."""
    y = LINEAR @ m + 0.5 * (m @ BEND @ m) * BENT
    return Prediction(y, LINEAR + np.outer(BENT, BEND @ m))


def observed(residual: float):
    """At (0.4, -0.3), with a residual that no parameter explains, across the plane."""
    return bent(np.array([0.4, -0.3])).y + residual * BENT


def by_integration(y):
    """Mean and covariance of the posterior from a grid."""
    axis = np.linspace(-4.0, 4.0, 801)
    first, second = np.meshgrid(axis, axis, indexing="ij")
    points = np.stack([first.ravel(), second.ravel()], axis=1)
    # All that y has beside the three directions is the same everywhere.
    seen = SLOPES.T @ y
    across = seen[2] - 0.5 * np.einsum("ki,ij,kj->k", points, BEND, points)
    along = seen[:2] - points * [2.0, 1.5]
    log = -0.5 * (np.sum(along**2, axis=1) + across**2 + np.sum(points**2, axis=1))
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    mean = weights @ points
    return mean, (points - mean).T * weights @ (points - mean)


def filtered(y, **settings):
    return IteratedFilter(**settings)(bent, PRIOR, y, 1.0)


@pytest.mark.parametrize("residual", [-4.0, 4.0])
def test_the_covariance_is_that_of_the_posterior(residual):
    y = observed(residual)
    mean, covariance = by_integration(y)
    plain, better = filtered(y), filtered(y, second_order=True)
    true = np.sqrt(np.diag(covariance))
    assert np.max(np.abs(plain.std / true - 1.0)) > 0.15
    assert better.std == pytest.approx(true, rel=0.05)
    assert np.all(np.abs(better.mean - mean) < 0.1 * true)
    assert plain.check is not None
    assert better.check is not None
    assert not plain.check.holds
    assert better.check.holds


def test_what_is_well_linearised_costs_no_further_run():
    plain, better = filtered(observed(0.0)), filtered(observed(0.0), second_order=True)
    assert better.forward_solves == plain.forward_solves
    assert np.array_equal(better.std, plain.std)


def test_iterations_that_do_not_end_are_ended_by_newton_steps():
    y = observed(-4.0)
    begun = {"max_iterations": 1, "start": (-1.5, 1.5)}
    better = filtered(y, **begun, second_order=True)
    assert filtered(y, **begun).reason is Reason.MAX_ITERATIONS
    assert better.reason is Reason.CONVERGED
    exact = filtered(y, tolerance=1e-8, max_iterations=200)
    assert np.all(np.abs(better.mean - exact.mean) < 0.1 * exact.std)


def test_newton_steps_leave_where_the_objective_is_not_convex():
    y = observed(9.0)
    begun = {"max_iterations": 1, "start": (0.4, -0.3)}
    plain, better = filtered(y, **begun), filtered(y, **begun, second_order=True)

    def curvature(m):
        slope = LINEAR + np.outer(BENT, BEND @ m)
        return slope.T @ slope - BENT @ (y - bent(m).y) * BEND + np.eye(2)

    assert np.linalg.eigvalsh(curvature(plain.mean))[0] < -0.5
    assert better.reason is Reason.CONVERGED
    mode = minimize(lambda m: 0.5 * (np.sum((y - bent(m).y) ** 2) + m @ m), better.mean).x
    true = np.sqrt(np.diag(np.linalg.inv(curvature(mode))))
    assert np.all(np.abs(better.mean - mode) < 0.1 * true)
    assert better.std == pytest.approx(true, rel=0.05)
