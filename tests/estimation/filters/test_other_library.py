"""The filters beside filterpy's, which was written by others from other books."""

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter

from mvest.estimation import (
    EnsembleFilter,
    ExtendedFilter,
    Gaussian,
    IteratedFilter,
    PaperFilter,
    Reason,
    UnscentedFilter,
)
from tests.estimation.problems import Linear, saturating


def kalman(problem) -> KalmanFilter:
    n, p = problem.H.shape
    other = KalmanFilter(dim_x=p, dim_z=n)
    other.x, other.P = problem.prior.mean.copy(), problem.prior.covariance.copy()
    other.H, other.R = problem.H, np.diag(problem.R)
    return other


def test_on_a_linear_model_all_filters_are_filterpys_kalman_filter() -> None:
    problem = Linear(n=12, p=4, seed=5)
    other = kalman(problem)
    other.update(problem.y)
    for filter_ in (
        IteratedFilter(),
        ExtendedFilter(),
        UnscentedFilter(),
        EnsembleFilter(members=12),
        EnsembleFilter(members=12, steps=3),
    ):
        found = problem.by(filter_)
        np.testing.assert_allclose(found.mean, np.ravel(other.x), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.covariance, other.P, rtol=1e-8, atol=1e-12)
        assert found.innovation is not None
    # The innovation and its likelihood are those of the prior, not of the posterior.
    found = problem.by(IteratedFilter())
    assert (found.converged, found.iterations, found.forward_solves) == (True, 1, 2)
    # Twice the objective at the minimum of a linear problem is the NIS of the prior's innovation.
    assert 2.0 * found.objective[-1] == pytest.approx(found.innovation.nis, rel=1e-12)
    np.testing.assert_allclose(found.log_likelihood[-1], other.log_likelihood, rtol=1e-9)
    innovation = np.ravel(other.y)
    np.testing.assert_allclose(found.innovation.rms, np.sqrt(np.mean(innovation**2)), rtol=1e-9)
    left = problem.y - problem.H @ np.ravel(other.x)
    np.testing.assert_allclose(found.innovation.residual_rms, np.sqrt(np.mean(left**2)), rtol=1e-9)


def test_one_update_of_a_nonlinear_model_is_filterpys_extended_filter() -> None:
    prior, y, R = Gaussian(np.array([0.7]), np.array([[0.3]])), np.array([0.3, 0.9]), 0.04
    other = ExtendedKalmanFilter(dim_x=1, dim_z=2)
    other.x, other.P, other.R = prior.mean.copy(), prior.covariance.copy(), R * np.eye(2)
    other.update(y, lambda m: saturating(m).jacobian, lambda m: saturating(m).y)
    found = ExtendedFilter()(saturating, prior, y, R)
    np.testing.assert_allclose(found.mean, np.ravel(other.x), rtol=1e-12)
    np.testing.assert_allclose(found.covariance, other.P, rtol=1e-12)


def test_rounds_of_the_papers_filter_are_filterpys_predictions_and_updates() -> None:
    problem, Q = Linear(), np.diag([0.1, 0.2, 0.3])
    other = kalman(problem)
    other.F, other.Q = np.eye(3), Q
    found = problem.by(PaperFilter(Q=Q, tolerance=1e-300, max_iterations=4))
    rounds = zip(found.iterates, found.iterate_covariances, found.log_likelihood, strict=True)
    for mean, covariance, log_likelihood in rounds:
        np.testing.assert_allclose(mean, np.ravel(other.x), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(covariance, other.P, rtol=1e-8, atol=1e-12)
        other.predict()
        other.update(problem.y)
        assert log_likelihood == pytest.approx(other.log_likelihood, rel=1e-9)
    assert found.reason is Reason.MAX_ITERATIONS
    assert not found.converged
