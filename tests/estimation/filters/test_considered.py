"""The Schmidt-Kalman filter against the filter that estimates everything, and by hand."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import (
    Gaussian,
    IteratedFilter,
    Log,
    Prediction,
    Reason,
    SchmidtFilter,
    observation_noise,
)
from mvest.estimation.noise import low_rank_noise

NAMES = ("a", "c", "b")
RNG = np.random.default_rng(4)
H = RNG.standard_normal((40, 3))
R = RNG.uniform(0.5, 2.0, 40)
PRIOR = Gaussian(np.array([1.0, 0.5, -1.0]), np.diag([4.0, 0.3, 2.0]))
Y = H @ np.array([2.0, 0.9, -0.4]) + np.sqrt(R) * RNG.standard_normal(40)


def linear(m):
    return Prediction(H @ m, H)


def schmidt(model=linear, considered=("c",), transform=None, **settings):
    inner = IteratedFilter(tolerance=1e-10, objective_tolerance=1e-15)
    filter_ = SchmidtFilter(inner, considered, **settings)
    return filter_(model, PRIOR, Y, R, names=NAMES, transform=transform)


def test_the_estimated_part_equals_that_of_the_filter_that_estimates_everything():
    every = IteratedFilter(tolerance=1e-10)(linear, PRIOR, Y, R, names=NAMES)
    some = schmidt()
    assert some.converged
    kept = [0, 2]
    np.testing.assert_allclose(some.mean[kept], every.mean[kept], rtol=1e-9)
    np.testing.assert_allclose(
        some.covariance[np.ix_(kept, kept)], every.covariance[np.ix_(kept, kept)], rtol=1e-9
    )


def test_the_considered_parameter_keeps_its_prior():
    found = schmidt()
    assert found.mean[1] == PRIOR.mean[1]
    assert found.covariance[1, 1] == pytest.approx(PRIOR.covariance[1, 1], rel=1e-12)
    assert found.names == NAMES
    assert found.prediction is not None
    assert found.prediction.jacobian.shape == (40, 3)


def test_covariance_is_that_of_the_error_of_the_linear_estimate():
    # m+ - m = (K H - I) dm + K C dc + K v: its covariance by sums of squares, cross terms included.
    found = schmidt()
    kept = [0, 2]
    A, C, P = H[:, kept], H[:, [1]], PRIOR.covariance
    S = A @ P[np.ix_(kept, kept)] @ A.T + C @ P[[1]][:, [1]] @ C.T + np.diag(R)
    K = P[np.ix_(kept, kept)] @ A.T @ np.linalg.inv(S)
    J = np.eye(2) - K @ A
    expected = J @ P[np.ix_(kept, kept)] @ J.T + K @ C * P[1, 1] @ C.T @ K.T + K @ np.diag(R) @ K.T
    np.testing.assert_allclose(found.covariance[np.ix_(kept, kept)], expected, rtol=1e-9)
    np.testing.assert_allclose(found.covariance[kept, 1], (-K @ C * P[1, 1])[:, 0], rtol=1e-9)


def test_ignoring_what_is_not_known_gives_too_narrow_an_interval():
    ignored = IteratedFilter()(
        lambda m: Prediction(H[:, [0, 2]] @ m + 0.5 * H[:, 1], H[:, [0, 2]]),
        Gaussian(PRIOR.mean[[0, 2]], PRIOR.covariance[np.ix_([0, 2], [0, 2])]),
        Y,
        R,
    )
    assert np.all(schmidt().std[[0, 2]] > ignored.std)


def test_a_considered_parameter_without_doubt_is_a_fixed_one():
    certain = Gaussian(PRIOR.mean, np.diag([4.0, 0.0, 2.0]))
    found = SchmidtFilter(IteratedFilter(tolerance=1e-10), ("c",))(
        linear, certain, Y, R, names=NAMES
    )
    fixed = IteratedFilter(tolerance=1e-10)(
        lambda m: Prediction(H[:, [0, 2]] @ m + 0.5 * H[:, 1], H[:, [0, 2]]),
        Gaussian(PRIOR.mean[[0, 2]], PRIOR.covariance[np.ix_([0, 2], [0, 2])]),
        Y,
        R,
    )
    np.testing.assert_allclose(found.mean[[0, 2]], fixed.mean, rtol=1e-9)
    np.testing.assert_allclose(found.covariance[0, 0], fixed.covariance[0, 0], rtol=1e-9)


def test_noise_columns_are_renewed_where_the_model_is_not_linear():
    # dh/dc grows with a: columns taken at the prior's mean would leave another optimum.
    def curved(m):
        a, c, b = m
        jacobian = H * [1.0, np.exp(a), 1.0]
        jacobian[:, 0] += H[:, 1] * c * np.exp(a)
        return Prediction(H[:, 0] * a + H[:, 1] * c * np.exp(a) + H[:, 2] * b, jacobian)

    found = schmidt(curved, tolerance=1e-9, max_rounds=40)
    assert found.converged
    kept = [0, 2]
    at = curved(found.mean)
    noise = low_rank_noise(
        observation_noise(R, 40), at.jacobian[:, [1]] * np.sqrt(PRIOR.covariance[1, 1])
    )
    e, A = noise.whiten(Y - at.y), noise.whiten(at.jacobian[:, kept])
    slope = -A.T @ e + np.linalg.solve(
        PRIOR.covariance[np.ix_(kept, kept)], found.mean[kept] - PRIOR.mean[kept]
    )
    assert np.abs(slope).max() < 1e-6 * np.abs(A.T).sum(axis=1).max()
    first_round = schmidt(curved, max_rounds=1)
    assert abs(first_round.mean[0] - found.mean[0]) > 1e-3


def test_logarithms_are_taken_of_the_estimated_parameters():
    positive = Log((True, False, False))
    found = schmidt(transform=positive)
    assert found.converged
    low, high = found.interval()
    assert 0 < low[0] < found.mean[0] < high[0]
    assert found.mean[0] ** 2 == pytest.approx(low[0] * high[0], rel=1e-9)


def test_a_model_that_fails_is_a_reason():
    found = schmidt(lambda m: Prediction.failed("no equilibrium"))
    assert found.reason is Reason.MODEL_FAILED
    assert "no equilibrium" in found.detail
    assert found.prediction is None


@pytest.mark.parametrize("considered", [("d",), ("a", "b", "c")])
def test_considered_parameters_are_some_of_the_problem(considered):
    with pytest.raises(InputError, match="considered"):
        schmidt(considered=considered)


def test_a_prior_that_ties_considered_to_estimated_parameters_is_refused():
    P = np.diag([4.0, 0.3, 2.0])
    P[0, 1] = P[1, 0] = 0.1
    with pytest.raises(InputError, match="independent"):
        SchmidtFilter(IteratedFilter(), ("c",))(linear, Gaussian(PRIOR.mean, P), Y, R, names=NAMES)


def test_low_rank_noise_whitens_the_sum():
    C = RNG.standard_normal((40, 3))
    noise = low_rank_noise(observation_noise(R, 40), C)
    full = np.diag(R) + C @ C.T
    W = noise.whiten(np.eye(40))
    np.testing.assert_allclose(W @ full @ W.T, np.eye(40), atol=1e-12)
    assert noise.log_determinant == pytest.approx(np.linalg.slogdet(full)[1], rel=1e-12)
    with pytest.raises(InputError, match="40, q"):
        low_rank_noise(observation_noise(R, 40), C[:5])
