"""Stated errors of detectors: size, correlation length, and widening at low confidence."""

import numpy as np
import pytest

from mvest.imaging.learning.accuracy import (
    matern,
    measure_accuracy,
    share_within,
    unlike_share,
    widened,
)
from mvest.observation.errors import SpatialCorrelation

LENGTH = 7.0


def sheet() -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, 40, 3.0), np.arange(0, 30, 3.0))
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)


def fields(count: int, std: np.ndarray, seed: int = 0) -> np.ndarray:
    """Errors ``(count, 2, n, 3)`` alike over LENGTH."""
    points = sheet()
    factor = SpatialCorrelation(points, LENGTH).factor
    white = np.random.default_rng(seed).standard_normal((count, 2, 3, len(points)))
    return (white @ factor.T).transpose(0, 1, 3, 2) * std[:, None]


def test_size_and_length_are_found_whatever_the_mean_error():
    points, std = sheet(), np.linspace(0.3, 1.2, len(sheet()))
    # The correlation is that of the estimation.
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert np.allclose(matern(d, LENGTH), SpatialCorrelation(points, LENGTH).matrix(), atol=1e-9)
    errors = fields(30, std)
    mean = np.random.default_rng(1).normal(0, 3, errors.shape[1:])
    tips = np.ones((30, 2, 2, 3))
    accuracy = measure_accuracy(errors + mean, tips, sheet())
    # 174 free numbers for each: a standard error of 5 %.
    assert np.abs(accuracy.std_mm / std - 1).max() < 0.2
    assert np.abs(accuracy.std_mm / std - 1).mean() < 0.06
    assert accuracy.correlation_length_mm == pytest.approx(LENGTH, rel=0.15)
    assert accuracy.samples.shape == errors.shape
    assert accuracy.tip_samples is tips


def test_errors_are_stated_wider_where_there_is_less_confidence():
    # Errors of the further volumes are three times as large, and these are believed less.
    std = np.full(len(sheet()), 0.7)
    own, wide = fields(40, std, 1), 3.0 * fields(30, std, 2)
    rng = np.random.default_rng(0)
    confidence, less = 0.95 + 0.01 * rng.standard_normal(40), 0.75 + 0.01 * rng.standard_normal(30)
    accuracy = measure_accuracy(own, np.zeros((40, 2, 2, 3)), sheet())
    found = widened(accuracy, confidence, wide, less)
    assert found.factor(0.95) == pytest.approx(1.0, abs=0.1)
    assert found.factor(0.75) == pytest.approx(3.0, rel=0.1)
    for errors, stated in ((fields(40, std, 3), 0.95), (3.0 * fields(40, std, 4), 0.75)):
        assert share_within(errors, found.at(stated).std_mm) == pytest.approx(0.95, abs=0.015)

    # Smaller errors with less confidence are luck, and are not extrapolated.
    lucky = widened(accuracy, np.full(40, 0.95), wide / 6.0, np.full(30, 0.75))
    assert lucky.widening[1] == 0.0


@pytest.mark.parametrize("count", [9, 60])
def test_what_counts_as_unlike_is_as_rare_as_promised_however_confidence_is_distributed(count):
    # The limit of a normal distribution: of confidences that are skewed, most near 1, as those of
    # detectors are, twice as many would be beyond one for 2 %.
    rng = np.random.default_rng(5)
    points = sheet()[:4]
    errors = rng.standard_normal((count, 1, len(points), 3))
    accuracy = measure_accuracy(errors, np.zeros((count, 1, 2, 3)), points)
    beyond = []
    for _ in range(300):
        drawn = 1.0 - 0.05 * rng.standard_exponential(count + 1) ** 1.5
        found = widened(accuracy, drawn[1:], errors[:1], drawn[:1])
        beyond.append(drawn[0] < found.like_from)
    assert unlike_share(count) == pytest.approx({9: 0.1, 60: 1 / 61}[count])
    # Within three standard errors of a share of 300.
    spread = np.sqrt(unlike_share(count) / 300)
    assert abs(np.mean(beyond) - unlike_share(count)) < 3 * spread
