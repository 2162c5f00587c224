"""Errors regressed on shapes in which valves were found: known laws, and what is left of them."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.from_images.detector_errors import (
    coverage,
    error_at_shape,
    without_expected_error,
)
from mvest.errors import InputError
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.layout import ValveLayout
from tests.cases.from_images.test_imaged_case import FRAMES, LAYOUT, TURN, sequence, valve_axes

SMALL = ValveLayout(8, 3)
POINTS = SMALL.size + 2


def made_up(seed, count, noise, law=0.0):
    """Shapes of five modes and a large mean, and errors that follow them by a law, with noise."""
    rng = np.random.default_rng(seed)
    modes = rng.normal(size=(5, 2, POINTS, 3))
    bias, follows = rng.normal(size=(2, 2, POINTS, 3)), rng.normal(size=(5, 2, POINTS, 3))
    amplitude = rng.normal(size=(count, 5))
    shapes = 20.0 + np.tensordot(amplitude, modes, 1)
    errors = bias[0] + law * np.tensordot(amplitude, follows, 1)
    return shapes, errors + noise * rng.normal(size=errors.shape), errors


def test_what_is_stated_covers_the_errors_of_further_valves():
    shapes, errors, _ = made_up(3, 60, noise=1.0, law=0.5)
    n, own = SMALL.size, slice(0, 40)
    std = (errors[own, :, :n] - errors[own, :, :n].mean(axis=0)).std(axis=(0, 1, 3))
    accuracy = DetectionAccuracy(
        std, 5.0, errors[own, :, :n], errors[own, :, n:], widening=(2.0, 0.0),
        shapes=shapes[own, :, :n], tip_shapes=shapes[own, :, n:],
    )  # fmt: skip
    left = errors[40:, :, :n] - errors[own, :, :n].mean(axis=0)
    open_, closed = coverage(SMALL, accuracy, left, shapes[40:], np.ones(20))
    for row, k in ((open_, 0), (closed, 1)):
        # Stated twice as wide as they are: 1.96 becomes 3.92 standard deviations.
        assert row["within_95"] > 99
        assert row["rms"] == pytest.approx(np.sqrt((left[:, k] ** 2).mean()))
        assert row["stated"] == pytest.approx(2 * np.sqrt((std**2).mean()))
    exact = replace(accuracy, widening=(1.0, 0.0))
    for row in coverage(SMALL, exact, errors[40:, :, :n], shapes[40:], np.ones(20)):
        assert row["within_95_handed_on"] == pytest.approx(95, abs=3)
        assert row["rms_handed_on"] == pytest.approx(row["stated_handed_on"], rel=0.1)
        assert row["rms_handed_on"] < row["rms"]


def test_what_no_shape_tells_varies_about_the_mean_as_one_more_valve_does():
    shapes, errors, _ = made_up(2, 7, noise=1.0)
    expected, samples = error_at_shape(SMALL, errors, np.zeros_like(shapes), shapes[0])
    np.testing.assert_allclose(expected, errors.mean(axis=0), atol=1e-12)
    about = errors - errors.mean(axis=0)
    np.testing.assert_allclose(samples, np.sqrt(8 / 6) * about, atol=1e-12)


@pytest.mark.parametrize("law", [0.0, 2.0])
def test_samples_are_as_wide_as_the_error_of_one_more_valve(law):
    square, stated, plain = [], [], []
    for seed in range(40):
        shapes, errors, _ = made_up(seed, 25, noise=1.0, law=law)
        expected, samples = error_at_shape(SMALL, errors[1:], shapes[1:], shapes[0])
        square.append(((errors[0] - expected) ** 2).mean())
        stated.append((samples**2).mean())
        plain.append(((errors[0] - errors[1:].mean(axis=0)) ** 2).mean())
    assert np.mean(stated) == pytest.approx(np.mean(square), rel=0.1)
    # And it is worth it where there is a law, and costs next to nothing where there is none.
    assert np.mean(square) < (0.5 if law else 1.05) * np.mean(plain)


def test_the_expected_error_is_taken_off_in_the_axes_of_the_valve():
    # Taken off in the image's axes; shapes compared in axes that are not the valve's own.
    rng = np.random.default_rng(4)
    seen = sequence(TURN, (3.0, -8.0, 20.0))
    n, factor = LAYOUT.size, 1.2 * np.exp(0.5 * (1.0 - seen.confidence))
    at = np.stack(
        [
            (np.concatenate([seen.vertices[k], seen.tips[k]]) - seen.annulus[k].mean(axis=0))
            @ valve_axes(seen, k)
            for k in (FRAMES.open, FRAMES.closed)
        ]
    )
    mode, amplitude = rng.normal(size=at.shape), rng.normal(size=20)
    shapes = at + (amplitude - 1.5)[:, None, None, None] * mode
    follows = rng.normal(size=at.shape)
    errors = amplitude[:, None, None, None] * follows + 1e-3 * rng.normal(size=(20, *at.shape))
    accuracy = DetectionAccuracy(
        np.ones(n), 9.0, errors[:, :, :n], errors[:, :, n:], (1.2, 0.5),
        shapes=shapes[:, :, :n], tip_shapes=shapes[:, :, n:],
    )  # fmt: skip
    mean = replace(accuracy, shapes=None, tip_shapes=None)
    for known, expected in ((accuracy, 1.5 * follows), (mean, errors.mean(axis=0))):
        found, about = without_expected_error(seen, FRAMES, known)
        for number, off in zip((FRAMES.open, FRAMES.closed), expected, strict=True):
            axes = valve_axes(seen, number)
            moved = (seen.vertices[number] - found.vertices[number]) @ axes
            np.testing.assert_allclose(moved, off[:n], atol=0.05)
            moved = (seen.tips[number] - found.tips[number]) @ axes
            np.testing.assert_allclose(moved, off[n:], atol=0.05)
        # Other frames are left as they are.
        np.testing.assert_array_equal(found.vertices[1], seen.vertices[1])
        _, plain = without_expected_error(seen, FRAMES, replace(known, widening=(1.0, 0.0)))
        np.testing.assert_allclose(about, factor * plain)
    with pytest.raises(InputError, match="errors of shape"):
        without_expected_error(seen, FRAMES, replace(accuracy, samples=errors[:, :, :5]))
