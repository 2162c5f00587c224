"""Errors known by samples: the linear filter with them, against Monte Carlo."""

import numpy as np
import pytest
from scipy import stats

from mvest.errors import InputError
from mvest.estimation import Gaussian, kalman_update, observation_noise
from mvest.estimation.sampled import SampledErrors

N, P0 = 60, np.diag([0.25, 0.16, 0.01])
RNG = np.random.default_rng(11)
H = RNG.standard_normal((N, 3))
MODES = 0.8 * RNG.standard_normal((N, 40))
"""True errors of the innovation: many directions, more than samples."""


def errors(count, rng):
    return MODES @ rng.standard_normal((MODES.shape[1], count)) / np.sqrt(MODES.shape[1])


def gain(noise, H=H):
    W = noise.whiten(np.eye(noise.size))
    R = np.linalg.inv(W.T @ W)
    return P0 @ H.T @ np.linalg.inv(H @ P0 @ H.T + R)


def test_intervals_hold_the_truth_as_often_as_they_say_and_those_of_the_filter_do_not():
    base = observation_noise(0.2**2, N)
    rng = np.random.default_rng(2)
    hits, filters, tries = np.zeros(3), np.zeros(3), 0
    for _ in range(60):
        told = SampledErrors(base, errors(10, rng))
        K = gain(told.noise)
        std = np.sqrt(np.diag(told.posterior(H, P0).covariance))
        own = np.sqrt(np.diag(P0 - K @ H @ P0))
        for _ in range(20):
            m = np.sqrt(np.diag(P0)) * rng.standard_normal(3)
            error = K @ (H @ m + errors(1, rng)[:, 0]) - m
            hits += np.abs(error) < 1.96 * std
            filters += np.abs(error) < 1.96 * own
            tries += 1
    assert np.all(hits / tries > 0.9)
    assert filters[0] / tries < 0.8


def test_without_the_leave_one_out_the_formula_is_that_of_joseph():
    # Where the base rules, leaving one out changes nothing.
    base = observation_noise(20.0**2, N)
    told = SampledErrors(base, errors(200, np.random.default_rng(3)))
    K = gain(told.noise)
    rest = np.eye(3) - K @ H
    expected = rest @ P0 @ rest.T + K @ (told.samples @ told.samples.T / 200) @ K.T
    expected += ((stats.t.ppf(0.975, 200) / 1.959964) ** 2 - 1) * (expected - rest @ P0 @ rest.T)
    found = told.posterior(H, P0)
    np.testing.assert_allclose(found.covariance, expected, rtol=0.02, atol=1e-6)
    np.testing.assert_allclose(
        found.covariance - found.from_samples, rest @ P0 @ rest.T, rtol=1e-8, atol=1e-12
    )


def test_the_noise_is_that_of_the_base_and_the_mean_square_of_the_samples():
    told = SampledErrors(observation_noise(0.3**2, N), errors(7, np.random.default_rng(5)))
    W = told.noise.whiten(np.eye(N))
    expected = 0.09 * np.eye(N) + told.samples @ told.samples.T / 7
    np.testing.assert_allclose(np.linalg.inv(W.T @ W), expected, rtol=1e-6, atol=1e-9)


def test_tiny_samples_leave_the_filter_s_own_covariance_but_for_the_noise():
    # Samples that vanish: no error reaches the estimate, only the prior is left through the gain.
    base = observation_noise(0.3**2, N)
    told = SampledErrors(base, 1e-9 * errors(5, np.random.default_rng(6)))
    own = kalman_update(Gaussian(np.zeros(3), P0), np.zeros(N), H, base)
    assert np.all(np.diag(told.posterior(H, P0).covariance) < own.posterior.std**2)


def test_few_samples_widen_by_student_s_distribution():
    base = observation_noise(1e6, N)
    samples = errors(4, np.random.default_rng(7))
    # So little weight that all gains are one: leaving one out changes nothing.
    K = gain(base)
    moved = K @ samples
    expected = (stats.t.ppf(0.975, 4) / stats.norm.ppf(0.975)) ** 2 / 4 * moved @ moved.T
    found = SampledErrors(base, samples).posterior(H, P0).from_samples
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_what_a_sample_was_made_from_is_left_out_with_it():
    base, samples = observation_noise(0.2**2, N), errors(6, np.random.default_rng(8))
    alone = SampledErrors(base, samples).posterior(H, P0)
    # Twice the same tells nothing more: were the copies taken for independent, a gain that has seen
    # one of them would be better than it is where neither was seen.
    twice = np.concatenate([samples, samples], axis=1)
    together = SampledErrors(base, twice, np.tile(np.arange(6), 2)).posterior(H, P0)
    np.testing.assert_allclose(together.covariance, alone.covariance, rtol=1e-9)
    apart = SampledErrors(base, twice).posterior(H, P0)
    assert np.all(np.diag(apart.from_samples) < 0.7 * np.diag(alone.from_samples))
    with pytest.raises(InputError, match="one for each of 12 samples"):
        SampledErrors(base, twice, np.arange(6))


PLACES = np.linspace(0.0, 1.0, N)
NEAR = np.exp(-0.5 * ((PLACES[:, None] - PLACES) / 0.12) ** 2)
"""Correlation of errors at two places."""


def smooth_errors(count, rng):
    root = np.linalg.cholesky(NEAR + 1e-9 * np.eye(N))
    return 0.8 * root @ rng.standard_normal((N, count))


def test_the_posterior_is_that_of_a_gain_without_the_sample_and_what_it_was_made_from():
    rng = np.random.default_rng(14)
    samples, source = smooth_errors(6, rng), np.array([0, 0, 1, 1, 2, 2])
    considered = 0.1 * rng.standard_normal((N, 2))
    told = SampledErrors(observation_noise(0.3**2, N), samples, source, considered)

    def gain_of(chosen):
        C = samples[:, chosen]
        R = 0.09 * np.eye(N) + C @ C.T / chosen.sum()
        return P0 @ H.T @ np.linalg.inv(H @ P0 @ H.T + R)

    moved = np.concatenate(
        [gain_of(source != one) @ samples[:, source == one] for one in range(3)], axis=1
    )
    K = gain_of(np.ones(6, dtype=bool))
    rest = np.eye(3) - K @ H
    part = (stats.t.ppf(0.975, 3) / stats.norm.ppf(0.975)) ** 2 / 6 * moved @ moved.T
    expected = rest @ P0 @ rest.T + part + K @ considered @ considered.T @ K.T
    found = told.posterior(H, P0)
    np.testing.assert_allclose(found.from_samples, part, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.zeros((N, 1)), "K at least 2"),
        (np.zeros((N + 1, 5)), "samples of errors have shape"),
        (np.full((N, 5), np.nan), "samples of errors"),
    ],
)
def test_samples_that_are_none_are_refused(samples, message):
    with pytest.raises(InputError, match=message):
        SampledErrors(observation_noise(1.0, N), samples)
