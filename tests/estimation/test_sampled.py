"""Errors known by samples: the linear filter with them, against Monte Carlo."""

import numpy as np
import pytest
from scipy import stats

from mvest.errors import InputError
from mvest.estimation import observation_noise
from mvest.estimation.sampled import SampledErrors

N, P0 = 60, np.diag([0.25, 0.16, 0.01])
RNG = np.random.default_rng(11)
H = RNG.standard_normal((N, 3))
MODES = 0.8 * RNG.standard_normal((N, 40))
"""True errors of the innovation: many directions, more than samples."""


def errors(count, seed):
    rng = np.random.default_rng(seed) if isinstance(seed, int) else seed
    return MODES @ rng.standard_normal((MODES.shape[1], count)) / np.sqrt(MODES.shape[1])


def sampled(std, samples, *more):
    return SampledErrors(observation_noise(std**2, N), samples, *more)


def gain_of(R):
    return P0 @ H.T @ np.linalg.inv(H @ P0 @ H.T + R)


def covariance_of(noise):
    W = noise.whiten(np.eye(N))
    return np.linalg.inv(W.T @ W)


def widened(count):
    """Factor of Student's distribution on a variance."""
    return (stats.t.ppf(0.975, count) / stats.norm.ppf(0.975)) ** 2


def test_intervals_hold_the_truth_as_often_as_stated_and_those_of_the_filter_do_not():
    rng = np.random.default_rng(2)
    hits, filters, tries = np.zeros(3), np.zeros(3), 0
    for _ in range(60):
        known = sampled(0.2, errors(10, rng))
        K = gain_of(covariance_of(known.noise))
        std = np.sqrt(np.diag(known.posterior(H, P0).covariance))
        own = np.sqrt(np.diag(P0 - K @ H @ P0))
        for _ in range(20):
            m = np.sqrt(np.diag(P0)) * rng.standard_normal(3)
            error = K @ (H @ m + errors(1, rng)[:, 0]) - m
            hits += np.abs(error) < 1.96 * std
            filters += np.abs(error) < 1.96 * own
            tries += 1
    assert np.all(hits / tries > 0.9)
    assert filters[0] / tries < 0.8


def test_the_posterior_is_that_of_a_gain_without_the_source_of_each_sample():
    rng = np.random.default_rng(14)
    places = np.linspace(0.0, 1.0, N)
    near = np.exp(-0.5 * ((places[:, None] - places) / 0.12) ** 2)
    samples = 0.8 * np.linalg.cholesky(near + 1e-9 * np.eye(N)) @ rng.standard_normal((N, 6))
    source, beside = np.array([0, 0, 1, 1, 2, 2]), 0.1 * rng.standard_normal((N, 2))

    def gain(chosen):
        C = samples[:, chosen]
        return gain_of(0.09 * np.eye(N) + C @ C.T / chosen.sum())

    moved = np.concatenate(
        [gain(source != one) @ samples[:, source == one] for one in range(3)], axis=1
    )
    K = gain(np.ones(6, dtype=bool))
    rest = np.eye(3) - K @ H
    part = widened(3) / 6 * moved @ moved.T
    expected = rest @ P0 @ rest.T + part + K @ beside @ beside.T @ K.T
    found = sampled(0.3, samples, source, beside).posterior(H, P0)
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
def test_bad_samples_are_refused(samples, message):
    with pytest.raises(InputError, match=message):
        sampled(1.0, samples)
