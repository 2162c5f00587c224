"""Noise that is learned with the parameters: exact evidence, and robustness to wrong priors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

from mvest.errors import InputError
from mvest.estimation import Gaussian, kalman_update
from mvest.estimation.evidence import Evidence, LearnedNoise
from mvest.estimation.noise import ErrorColumns, NoiseBlock, NoiseFamily, kronecker_noise
from mvest.estimation.spectrum import BANDS, LogNormal, Spectrum, matern, smooth_basis
from mvest.typing import FloatArray

BELIEVED = Spectrum(LogNormal(0.6, 2.0), LogNormal(10.0, 2.0))
ROUGH = LogNormal(0.12, 3.0)


UNIT = {p: Gaussian(np.zeros(p), np.eye(p)) for p in (5, 8)}


def learn_noise(family: NoiseFamily, innovation: FloatArray, B: FloatArray) -> LearnedNoise:
    """The most probable noise of a linear model whose prior covariance is the unit matrix."""
    evidence = Evidence(family, innovation, B)
    return evidence.learned(evidence.posterior(), np.eye(B.shape[1]))


def sheet(rows: int, columns: int, spacing: float) -> FloatArray:
    """Points (k, 3) mm of a bent sheet."""
    x, y = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing)
    return np.column_stack([x.ravel(), y.ravel(), 0.05 * (x.ravel() - x.mean()) ** 2])


WAVES = ((0, 0), (0, 0), (0, 0), (2, 1), (4, 2), (7, 3), (10, 5), (14, 7))
"""Of what the parameters do along and across the sheet: shifts, and as fine as a fold."""


def slopes(points: FloatArray, waves: Sequence[tuple[int, int]] = WAVES) -> FloatArray:
    """B (3 k, p), large over the errors."""
    scaled = np.pi * (points - points.min(axis=0)) / np.ptp(points, axis=0)
    axes = [*np.eye(3), *np.tile([0.4, 0.3, 0.87], (len(waves), 1))]
    shapes = [
        np.outer(np.cos(a * scaled[:, 0]) * np.cos(b * scaled[:, 1]), axis)
        for (a, b), axis in zip(waves, axes, strict=False)
    ]
    return 3.0 * np.stack([shape.ravel() for shape in shapes], axis=1)


def of_points(points: FloatArray) -> NoiseFamily:
    """The noise of all points of a sheet, in three coordinates."""
    basis = smooth_basis(points, BELIEVED.reference_length)
    block = NoiseBlock("rough", np.ones(len(points)), 3, basis)
    return NoiseFamily((block,), {"rough": ROUGH}, BELIEVED.prior(points), 0.03)


POINTS = sheet(14, 28, 1.2)
FAMILY = of_points(POINTS)
B = slopes(POINTS)


def mixed_family() -> NoiseFamily:
    """Two frames, one with points of different scale, a curve, and columns of unknown factor."""
    rng = np.random.default_rng(1)
    first, second = rng.uniform(0.0, 30.0, (50, 2)), rng.uniform(0.0, 30.0, (40, 2))
    length = BELIEVED.reference_length
    blocks = (
        NoiseBlock("rough", np.linspace(0.5, 2.0, 40), 2, smooth_basis(second, length), "frame"),
        NoiseBlock("rough", np.ones(50), 3, smooth_basis(first, length)),
        NoiseBlock("curve", np.ones(20)),
    )
    believed = {"rough": ROUGH, "frame": LogNormal(1.0, 1.5), "curve": LogNormal(0.3, 2.0)}
    family = NoiseFamily(blocks, believed, BELIEVED.prior(first), 0.03)
    return family.plus(ErrorColumns("open shape", 0.3 * rng.standard_normal((family.size, 3)), 2.0))


def dense(family: NoiseFamily, log: FloatArray, beats: float = 1.0) -> FloatArray:
    """R of the mean of a number of beats by its definition, entry by entry."""
    value = dict(zip(family.names, np.exp(log), strict=True))
    blocks = []
    for block in family.blocks:
        k = len(block.scale)
        R = np.zeros((k, k))
        if block.basis is not None:
            U, basis = block.basis.U, block.basis
            s2 = np.exp(2.0 * log[basis.band])
            R = (U * (s2 * basis.w)) @ U.T
            # All points are among those chosen: nothing is left across the basis.
            np.testing.assert_allclose(basis.across, 0.0, atol=1e-6)
            if len(basis.w) < k:
                R += np.exp(2.0 * log[BANDS - 1]) * basis.across * (np.eye(k) - U @ U.T)
        R = (R + value[block.rough] ** 2 * np.eye(k)) / beats + family.resolution**2 * np.eye(k)
        R *= np.outer(block.scale, block.scale)
        if block.frame is not None:
            R *= value[block.frame] ** 2
        blocks.append(np.kron(R, np.eye(block.coordinates)))
    R = scipy.linalg.block_diag(*blocks)
    for columns in family.columns:
        R += value[columns.name] ** 2 * columns.columns @ columns.columns.T
    return R


def some(family: NoiseFamily, seed: int, p: int = 5) -> tuple[FloatArray, FloatArray, FloatArray]:
    """An innovation, B, and logarithms of the quantities."""
    rng = np.random.default_rng(seed)
    log = family.prior.mean + 0.5 * family.prior.factor @ rng.standard_normal(family.prior.size)
    return rng.standard_normal(family.size), rng.standard_normal((family.size, p)), log


@pytest.mark.parametrize("seed", range(2))
def test_the_evidence_is_that_of_the_dense_normal_distribution(seed: int) -> None:
    family = mixed_family()
    e, columns, log = some(family, seed)
    S = dense(family, log) + columns @ columns.T
    expected = multivariate_normal(np.zeros(family.size), S).logpdf(e)
    misfit = Evidence(family, e, columns).misfit(log)[0]
    found = -misfit - 0.5 * family.size * np.log(2.0 * np.pi)
    assert found == pytest.approx(expected, rel=1e-8)
    # The same from the noise itself, as the filter uses it.
    update = kalman_update(UNIT[5], e, columns, family.at(log))
    assert update.log_likelihood == pytest.approx(expected, rel=1e-8)
    mean, covariance = Evidence(family, e, columns).update(log, 5)
    np.testing.assert_allclose(mean, update.posterior.mean, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(covariance, update.posterior.covariance, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("beats", [4.0, np.inf])
def test_what_differs_from_beat_to_beat_is_averaged_and_nothing_else(beats: float) -> None:
    family = mixed_family()
    e, B, log = some(family, 3)
    update = kalman_update(UNIT[5], e, B, family.at(log, beats))
    S = dense(family, log, beats) + B @ B.T
    expected = np.eye(5) - B.T @ np.linalg.solve(S, B)
    np.testing.assert_allclose(update.posterior.covariance, expected, rtol=1e-6, atol=1e-12)
    # The same frame seen without any error but the resolution tells no less.
    exact = dense(family, log, np.inf) + B @ B.T
    gained = np.eye(5) - B.T @ np.linalg.solve(exact, B)
    assert np.linalg.eigvalsh(update.posterior.covariance - gained).min() > -1e-12


def test_its_derivatives_are_those_of_differences() -> None:
    family = mixed_family()
    e, columns, log = some(family, 7)
    evidence = Evidence(family, e, columns)
    _, slope = evidence.misfit(log)
    # Fourth order: central differences at two steps, extrapolated.
    for k in range(len(log)):

        def central(h: float, k: int = k) -> float:
            step = h * np.eye(len(log))[k]
            return (evidence.misfit(log + step)[0] - evidence.misfit(log - step)[0]) / (2.0 * h)

        expected = (4.0 * central(1e-3) - central(2e-3)) / 3.0
        assert slope[k] == pytest.approx(expected, rel=1e-7, abs=1e-6), family.names[k]


def posterior_of(learned: LearnedNoise, e: FloatArray, columns: FloatArray) -> Gaussian:
    """Of unit quantities with the uncertainty of the noise."""
    posterior = kalman_update(UNIT[columns.shape[1]], e, columns, learned.noise).posterior
    return Gaussian(posterior.mean, posterior.covariance + learned.covariance)


@pytest.mark.parametrize(("length", "rough"), [(5.0, 0.0), (10.0, 0.3)])
def test_intervals_hold_for_errors_other_than_stated(length: float, rough: float) -> None:
    points = sheet(9, 16, 1.8)
    distance, family, columns = cdist(points, points), of_points(points), slopes(points)
    own, stated = (
        scipy.linalg.cholesky(matern(distance, one) + 1e-10 * np.eye(len(points)), lower=True)
        for one in (length, 10.0)
    )
    rng = np.random.default_rng(5)
    inside, fixed, nis = [], [], []
    for _ in range(20):
        x = rng.standard_normal(8)
        noise = 0.6 * own @ rng.standard_normal((len(points), 3))
        e = columns @ x + (noise + rough * rng.standard_normal(noise.shape)).ravel()
        learned = learn_noise(family, e, columns)
        posterior = posterior_of(learned, e, columns)
        inside.append(np.abs(posterior.mean - x) < 1.96 * posterior.std)
        nis.append(kalman_update(UNIT[8], e, columns, learned.noise).nis / e.size)
        plain = kalman_update(UNIT[8], e, columns, kronecker_noise(0.36, stated, 3)).posterior
        fixed.append(np.abs(plain.mean - x) < 1.96 * plain.std)
    # The share of 160 intervals has a standard deviation of 1.7 percent.
    assert 0.90 <= np.mean(inside) <= 0.99
    assert np.mean(fixed) < 0.85
    if rough:
        assert learned.quantities[-1].learned.median == pytest.approx(rough, rel=0.1)
        # What is left is as large as expected.
        assert np.mean(nis) == pytest.approx(1.0, abs=0.01)


def test_a_rough_part_below_the_resolution_is_moved_by_its_own_standard_deviations():
    # It is learned to be five times as large, log 5 / log 3 of its standard deviations. With the
    # resolution, that is 0.14 mm instead of 0.102 mm, which were expected to 4 %.
    block, rng = NoiseBlock("rough", np.ones(4000)), np.random.default_rng(3)
    noise = NoiseFamily((block,), {"rough": LogNormal(0.02, 3.0)}, resolution=0.1)
    seen = np.hypot(0.1, 0.1) * rng.standard_normal(4000)
    (rough,) = learn_noise(noise, seen, np.zeros((4000, 1))).quantities
    assert rough.learned.median == pytest.approx(np.hypot(0.1, 0.1), rel=0.03)
    assert rough.stretch == pytest.approx(np.log(5.0) / np.log(3.0), rel=0.1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NoiseFamily(FAMILY.blocks, {}, FAMILY.bands), "rough; quantities .* for none"),
        (lambda: FAMILY.plus(ErrorColumns("rough", B[:, :1])), "different names"),
        (lambda: LogNormal(0.0), "median 0.0, expected > 0"),
        (lambda: FAMILY.at(FAMILY.prior.mean, 0.5), "mean of 0.5 beats, expected >= 1"),
        (lambda: replace(FAMILY, resolution=0).at(FAMILY.prior.mean, np.inf), "no noise without"),
    ],
)
def test_bad_input_is_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()
