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


def test_what_is_considered_keeps_its_prior_and_widens():
    told = SampledErrors(observation_noise(0.3**2, N), errors(12, np.random.default_rng(4)))
    found = told.posterior(H, P0, np.array([True, True, False])).covariance
    assert found[2, 2] == pytest.approx(P0[2, 2])
    whole = told.posterior(H, P0).covariance
    assert np.all(np.diag(found)[:2] > 0.9 * np.diag(whole)[:2])


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


def localised(samples, length=0.25):
    """Times the modes of a field of unit variance, of that correlation."""
    w, U = np.linalg.eigh(np.exp(-0.5 * ((PLACES[:, None] - PLACES) / length) ** 2))
    modes = U[:, w > 1e-12] * np.sqrt(w[w > 1e-12])
    return samples[:, :, None] * modes[:, None, :]


def test_a_localised_sample_is_weighed_with_by_its_product_with_a_correlation():
    samples = errors(7, np.random.default_rng(12))
    told = SampledErrors(
        observation_noise(0.3**2, N), samples, localised=localised(samples, length=0.25)
    )
    W = told.noise.whiten(np.eye(N))
    schur = samples @ samples.T / 7 * np.exp(-0.5 * ((PLACES[:, None] - PLACES) / 0.25) ** 2)
    np.testing.assert_allclose(
        np.linalg.inv(W.T @ W), 0.09 * np.eye(N) + schur, rtol=1e-6, atol=1e-8
    )


def test_samples_that_are_their_only_part_are_as_if_they_were_not_localised():
    base, samples = observation_noise(0.2**2, N), errors(6, np.random.default_rng(13))
    told, alone = (
        SampledErrors(base, samples, localised=parts) for parts in (samples[:, :, None], None)
    )
    np.testing.assert_allclose(
        told.posterior(H, P0).covariance, alone.posterior(H, P0).covariance, rtol=1e-12
    )


def test_the_posterior_is_that_of_a_gain_without_the_sample_and_what_it_was_made_from():
    rng = np.random.default_rng(14)
    samples, source = smooth_errors(6, rng), np.array([0, 0, 1, 1, 2, 2])
    parts, considered = localised(samples), 0.1 * rng.standard_normal((N, 2))
    told = SampledErrors(observation_noise(0.3**2, N), samples, source, considered, parts)
    estimated = np.array([True, True, False])

    def gain_of(chosen):
        C = parts[:, chosen].reshape(N, -1)
        R = 0.09 * np.eye(N) + C @ C.T / chosen.sum()
        K = P0 @ H.T @ np.linalg.inv(H @ P0 @ H.T + R)
        return np.where(estimated[:, None], K, 0.0)

    moved = np.concatenate(
        [gain_of(source != one) @ samples[:, source == one] for one in range(3)], axis=1
    )
    K = gain_of(np.ones(6, dtype=bool))
    rest = np.eye(3) - K @ H
    part = (stats.t.ppf(0.975, 3) / stats.norm.ppf(0.975)) ** 2 / 6 * moved @ moved.T
    expected = rest @ P0 @ rest.T + part + K @ considered @ considered.T @ K.T
    found = told.posterior(H, P0, estimated)
    np.testing.assert_allclose(found.from_samples, part, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-4, atol=1e-9)


def test_localised_samples_of_smooth_errors_make_a_better_gain_and_intervals_hold():
    # A few samples of errors that are alike near each other only; how such a filter fares.
    base, rng = observation_noise(0.05**2, N), np.random.default_rng(15)
    square, hits, tries = np.zeros(2), np.zeros(3), 0
    smooth_H = np.stack([np.sin((k + 1.5) * PLACES * 3) for k in range(3)], axis=1)
    for _ in range(25):
        samples = smooth_errors(8, rng)
        plain = SampledErrors(base, samples)
        told = SampledErrors(base, samples, localised=localised(samples))
        std = np.sqrt(np.diag(told.posterior(smooth_H, P0).covariance))
        gains = [gain(one.noise, smooth_H) for one in (plain, told)]
        for _ in range(20):
            m = np.sqrt(np.diag(P0)) * rng.standard_normal(3)
            y = smooth_H @ m + smooth_errors(1, rng)[:, 0]
            square += [np.sum((K @ y - m) ** 2) for K in gains]
            hits += np.abs(gains[1] @ y - m) < 1.96 * std
            tries += 1
    assert square[1] < 0.8 * square[0]
    assert np.all(hits / tries > 0.9)


def test_localised_samples_of_another_shape_are_refused():
    samples = errors(4, np.random.default_rng(16))
    with pytest.raises(InputError, match="localised samples have shape"):
        SampledErrors(observation_noise(1.0, N), samples, localised=np.zeros((N, 3, 2)))
    with pytest.raises(InputError, match="localised samples of errors"):
        SampledErrors(observation_noise(1.0, N), samples, localised=np.full((N, 4, 2), np.nan))


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
