"""The update against a dense textbook Kalman filter that shares no code with it."""

import tracemalloc

import numpy as np
import pytest
from scipy.linalg import sqrtm

from mvest.errors import InputError
from mvest.estimation import Gaussian, kalman_update, observation_noise


def textbook_update(m, P, e, H, R):
    """The textbook's equations with the dense n x n matrices that the library avoids."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    sign, log_det = np.linalg.slogdet(S)
    assert sign > 0
    nis = e @ np.linalg.inv(S) @ e
    log_likelihood = -0.5 * (e.size * np.log(2 * np.pi) + log_det + nis)
    return m + K @ e, P - K @ H @ P, log_likelihood, nis, S


def random_spd(rng, n, condition=10.0):
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return (Q * np.geomspace(1.0, condition, n)) @ Q.T


def noise_of(kind, rng, n):
    """R as the library takes it and as a dense matrix."""
    if kind == "scalar":
        return 0.3, 0.3 * np.eye(n)
    if kind == "diagonal":
        variances = rng.uniform(0.1, 2.0, n)
        return variances, np.diag(variances)
    R = random_spd(rng, n)
    return R, R


@pytest.mark.parametrize("kind", ["scalar", "diagonal", "full"])
@pytest.mark.parametrize(("n", "p"), [(12, 3), (4, 4), (5, 8), (30, 1)])
def test_equals_the_textbook_filter_in_both_forms(kind, n, p):
    rng = np.random.default_rng(7)
    P = random_spd(rng, p)
    m, y, H = rng.standard_normal(p), rng.standard_normal(n), rng.standard_normal((n, p))
    R, dense = noise_of(kind, rng, n)
    noise, e = observation_noise(R, n), y - H @ m
    found = kalman_update(Gaussian(m, P), e, H, noise)

    mean, covariance, log_likelihood, nis, S = textbook_update(m, P, e, H, dense)
    np.testing.assert_allclose(found.posterior.mean, mean, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(found.posterior.covariance, covariance, rtol=1e-12, atol=1e-12)
    assert found.log_likelihood == pytest.approx(log_likelihood, rel=1e-12)
    assert found.nis == pytest.approx(nis, rel=1e-11)
    # Information form: P+ = (P^-1 + H' R^-1 H)^-1 and m+ = P+ (P^-1 m + H' R^-1 y).
    covariance = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.solve(dense, H))
    mean = covariance @ (np.linalg.solve(P, m) + H.T @ np.linalg.solve(dense, y))
    np.testing.assert_allclose(found.posterior.covariance, covariance, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found.posterior.mean, mean, rtol=1e-10, atol=1e-12)
    # W is not unique, but W'W = R^-1 is: check it, then the definition (W S W')^(-1/2) W e.
    W = noise.whiten(np.eye(n))
    np.testing.assert_allclose(W.T @ W, np.linalg.inv(dense), rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(noise.whiten(e), W @ e, rtol=1e-12, atol=1e-14)
    # Row i belongs to observation i: rows left in the order of the factorisation miss it.
    assert np.all(np.diagonal(W) > 0.0)
    assert noise.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)
    expected = np.linalg.inv(sqrtm(W @ S @ W.T).real) @ W @ e
    np.testing.assert_allclose(found.standardised_innovation, expected, rtol=1e-9, atol=1e-11)


def test_sequential_updates_equal_one_update():
    # Observing two halves one after the other is observing the whole, likelihoods adding up; wrong
    # for a gain or a likelihood that is right for one observation only.
    rng = np.random.default_rng(10)
    n, p = 14, 3
    prior = Gaussian(rng.standard_normal(p), random_spd(rng, p))
    y, H = rng.standard_normal(n), rng.standard_normal((n, p))
    R = rng.uniform(0.1, 1.0, n)

    def update(prior, part):
        noise = observation_noise(R[part], len(R[part]))
        return kalman_update(prior, (y - H @ prior.mean)[part], H[part], noise)

    whole, first = update(prior, slice(None)), update(prior, slice(5))
    second = update(first.posterior, slice(5, None))
    np.testing.assert_allclose(second.posterior.mean, whole.posterior.mean, rtol=1e-11)
    np.testing.assert_allclose(second.posterior.covariance, whole.posterior.covariance, rtol=1e-10)
    total = first.log_likelihood + second.log_likelihood
    assert total == pytest.approx(whole.log_likelihood, rel=1e-12)


def test_a_fixed_parameter_stays_fixed():
    # Zero variance: P is singular, P^-1 does not exist, and the parameter must not move at all.
    rng = np.random.default_rng(11)
    m, P = np.array([1.0, 2.0, 3.0]), np.diag([1.0, 0.0, 4.0])
    H, e = rng.standard_normal((6, 3)), rng.standard_normal(6)
    found = kalman_update(Gaussian(m, P), e, H, observation_noise(0.5, 6)).posterior
    mean, covariance, *_ = textbook_update(m, P, e, H, 0.5 * np.eye(6))
    assert found.mean[1] == 2.0
    assert not found.covariance[1].any()
    np.testing.assert_allclose(found.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-12, atol=1e-14)


def test_nearly_parallel_columns_keep_their_digits():
    # H = [[1, 1], [0, d], [0, 0]] with d = 1e-9, R = r and P = I. The information is
    # [[1, 1], [1, 1 + d²]]/r + I, and its determinant (1/r + 1)((1 + d²)/r + 1) - 1/r² is
    # 1 + 2/r + d²/r + d²/r². For r = 1e-18 these are 1, 2e18, 1 and 1e18. The last one comes from
    # the difference of d² between entries of 1e18, which H'R^-1 H has no digits for.
    d, r = 1e-9, 1e-18
    H = np.array([[1.0, 1.0], [0.0, d], [0.0, 0.0]])
    prior = Gaussian(np.zeros(2), np.eye(2))
    found = kalman_update(prior, np.zeros(3), H, observation_noise(r, 3)).posterior
    determinant = 1.0 + 2.0 / r + d**2 / r + d**2 / r**2
    # P+[0, 0] is the other diagonal entry of the information over its determinant.
    expected = ((1.0 + d**2) / r + 1.0) / determinant
    assert found.covariance[0, 0] == pytest.approx(expected, rel=1e-6)


def test_three_hundred_thousand_observations_take_little_memory():
    # A dense n x n matrix would need 720 GB; what is needed are some arrays of n x p, 7 MB each.
    n, p = 300_000, 3
    rng = np.random.default_rng(12)
    H, e = rng.standard_normal((n, p)), rng.standard_normal(n)
    noise = observation_noise(rng.uniform(0.5, 1.0, n), n)
    tracemalloc.start()
    kalman_update(Gaussian(np.zeros(p), np.eye(p)), e, H, noise)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6


def test_wrong_shapes_are_refused():
    prior, noise = Gaussian(np.zeros(2), np.eye(2)), observation_noise(1.0, 3)
    with pytest.raises(InputError, match=r"innovation of shape \(3,\)"):
        kalman_update(prior, np.zeros(4), np.zeros((3, 2)), noise)
    with pytest.raises(InputError, match=r"H of shape \(3, 2\)"):
        kalman_update(prior, np.zeros(3), np.zeros((3, 3)), noise)
