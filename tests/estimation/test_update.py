"""The update against a dense textbook Kalman filter that shares no code with it."""

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


def test_wrong_shapes_are_refused():
    prior, noise = Gaussian(np.zeros(2), np.eye(2)), observation_noise(1.0, 3)
    with pytest.raises(InputError, match=r"innovation of shape \(3,\)"):
        kalman_update(prior, np.zeros(4), np.zeros((3, 2)), noise)
    with pytest.raises(InputError, match=r"H of shape \(3, 2\)"):
        kalman_update(prior, np.zeros(3), np.zeros((3, 3)), noise)
