"""Offset, slope and spread of estimates: other routes to the same posterior, and recovery."""

from itertools import product

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from mvest.errors import InputError
from mvest.estimation.recalibration import Beliefs, left_out, recalibrate

PRIOR_STD = 0.47
"""Of the logarithm of a modulus."""


def drawn(rng, n, offset=(0.0, 0.0), slope=(1.0, 1.0), spread=(1.0, 1.0)):
    """Estimates, stated covariances and truths of n cases whose regression is known."""
    stds = rng.uniform(0.1, 0.3, (n, 2))
    V = stds[:, :, None] * stds[:, None, :] * np.array([[1.0, 0.4], [0.4, 1.0]])
    x = np.sqrt(PRIOR_STD**2 - stds**2) * rng.standard_normal((n, 2))
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(V), rng.standard_normal((n, 2)))
    return x, V, np.array(offset) + np.array(slope) * x + np.array(spread) * noise


def stacked(x, V, spread, beliefs):
    """Believed mean and covariance of all truths ``(2n,)``, and of these with the coefficients."""
    design = np.concatenate([np.hstack([np.eye(2), np.diag(row)]) for row in x])
    prior = np.diag([beliefs.offset] * 2 + [beliefs.slope] * 2) ** 2
    noise = np.zeros((2 * len(x),) * 2)
    for k, own in enumerate(V):
        noise[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = np.outer(spread, spread) * own
    believed = np.array([0.0, 0.0, 1.0, 1.0])
    return believed, design @ believed, design @ prior @ design.T + noise, prior @ design.T, prior


def test_it_is_the_conditional_of_one_joint_normal_distribution():
    rng = np.random.default_rng(1)
    x, V, truth = drawn(rng, 9, (0.2, -0.1), (0.8, 1.1), (1.3, 0.9))
    found, beliefs = recalibrate(x, V, truth), Beliefs()
    believed, mean, S, cross, prior = stacked(x, V, np.exp(found.log_spread), beliefs)
    gain = cross @ np.linalg.inv(S)
    expected = believed + gain @ (truth.ravel() - mean)
    np.testing.assert_allclose(np.concatenate([found.offset, found.slope]), expected, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, prior - gain @ cross.T, atol=1e-12)


def test_the_spread_maximises_the_posterior_without_the_coefficients():
    rng = np.random.default_rng(2)
    x, V, truth = drawn(rng, 12, (0.2, 0.0), (1.0, 0.9), (1.5, 0.7))
    found = recalibrate(x, V, truth)

    def log_posterior(log_spread):
        _, mean, S, _, _ = stacked(x, V, np.exp(log_spread), Beliefs())
        prior = norm(0.0, Beliefs().log_spread).logpdf(log_spread).sum()
        return multivariate_normal(mean, S).logpdf(truth.ravel()) + prior

    best = log_posterior(found.log_spread)
    h = 1e-3
    for step in h * np.eye(2):
        assert log_posterior(found.log_spread + step) < best
        assert log_posterior(found.log_spread - step) < best
    corners = np.zeros((2, 2))
    for (i, j), (s, r) in product(product((0, 1), repeat=2), product((1, -1), repeat=2)):
        step = h * (s * np.eye(2)[i] + r * np.eye(2)[j])
        corners[i, j] += s * r * log_posterior(found.log_spread + step)
    curvature = -corners / (2 * h) ** 2
    np.testing.assert_allclose(
        found.log_spread_covariance, np.linalg.inv(curvature), rtol=1e-3, atol=1e-5
    )


def test_what_was_put_in_comes_out():
    rng, given = np.random.default_rng(3), ((0.25, -0.15), (0.75, 1.1), (1.4, 0.8))
    found = recalibrate(*drawn(rng, 4000, *given))
    stds = np.sqrt(np.diag(found.covariance))
    errors = np.concatenate([found.offset - given[0], found.slope - given[1]])
    assert np.all(np.abs(errors) < 3.5 * stds)
    assert stds.max() < 0.02
    np.testing.assert_allclose(np.exp(found.log_spread), given[2], rtol=0.05)


def test_right_estimates_stay_as_they_are():
    rng = np.random.default_rng(4)
    x, V, truth = drawn(rng, 2000)
    mean, covariance = recalibrate(x, V, truth).predicted(x, V)
    np.testing.assert_allclose(mean, x, atol=0.03)
    np.testing.assert_allclose(covariance, V, rtol=0.1)


def test_without_cases_the_beliefs_are_left():
    found = recalibrate(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))
    own = Beliefs()
    expected = np.array([own.offset, own.offset, own.slope, own.slope]) ** 2
    np.testing.assert_allclose(np.diag(found.covariance), expected)
    np.testing.assert_allclose(np.diag(found.log_spread_covariance), own.log_spread**2)
    # The mean of the square of a log-normal spread, and of two independent ones.
    v = own.log_spread**2
    np.testing.assert_allclose(found.widening(2), np.exp([[2 * v, v], [v, 2 * v]]))
    np.testing.assert_allclose(found.widening(3)[2], np.exp([v / 2, v / 2, 0.0]))


def test_intervals_hold_as_often_as_they_say_for_moduli_and_ratio():
    """Calibrations of ten cases drawn from the beliefs: what is not known of them must count."""
    rng, own = np.random.default_rng(5), Beliefs()
    inside, without = [], []
    for _ in range(300):
        offset, slope = own.offset * rng.standard_normal(2), 1 + own.slope * rng.standard_normal(2)
        spread = np.exp(own.log_spread * rng.standard_normal(2))
        known = recalibrate(*drawn(rng, 10, offset, slope, spread))
        x, V, truth = drawn(rng, 20, offset, slope, spread)
        mean, covariance = known.predicted(x, V)
        plain = np.exp(known.log_spread + known.log_spread[:, None]) * V
        for d in (np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([1.0, -1.0])):
            for P, kept in ((covariance, inside), (plain, without)):
                z = (truth - mean) @ d / np.sqrt(np.einsum("i,nij,j->n", d, P, d))
                kept.append(np.abs(z) < 1.96)
    # 18 000 predictions of 300 calibrations: the standard error is about half a per cent.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)
    assert np.mean(without) < 0.93


def test_a_case_that_is_left_out_does_not_see_its_truth():
    rng = np.random.default_rng(6)
    x, V, truth = drawn(rng, 12, (0.3, 0.3))
    means, covariances = left_out(x, V, truth)
    changed = truth.copy()
    changed[4] += 0.5
    others, _ = left_out(x, V, changed)
    np.testing.assert_array_equal(others[4], means[4])
    assert np.abs(others[3] - means[3]).max() > 0.02
    known = recalibrate(x[1:], V[1:], truth[1:]).predicted(x[0], V[0])
    np.testing.assert_allclose(means[0], known[0])
    np.testing.assert_allclose(covariances[0], known[1])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ((1.0, 1.0, (slice(1, None),)), "expected"),
        ((np.nan, 1.0, 1.0), "not finite"),
        ((1.0, -1.0, 1.0), "positive definite"),
    ],
)
def test_wrong_numbers_are_refused(change, says):
    given = drawn(np.random.default_rng(7), 5)
    pairs = zip(given, change, strict=True)
    wrong = [one[c] if isinstance(c, tuple) else c * one for one, c in pairs]
    with pytest.raises(InputError, match=says):
        recalibrate(*wrong)
