"""What a model's error does to an estimate: against an estimate with and without it."""

import numpy as np
import pytest

from mvest.estimation import Gaussian, IteratedFilter, Log, Prediction
from mvest.estimation.information.identifiability import shift_by_model_error, with_shift

PRIOR = Gaussian(np.array([1.0, -1.0]), np.array([[0.5, 0.1], [0.1, 2.0]]))
R = np.linspace(0.1, 0.4, 6)


def estimated(H, y, prior=PRIOR, R=R):
    return IteratedFilter(1e-12)(lambda m: Prediction(H @ m, H), prior, y, R)


def drawn(seed):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(6, 2)), rng.normal(size=6), rng.normal(size=6)


def test_the_shift_is_the_difference_of_two_estimates_of_a_linear_model():
    H, y, offset = drawn(2)
    found, moved = estimated(H, y), estimated(H, y + offset)
    shift = shift_by_model_error(found, R, offset)
    np.testing.assert_allclose(shift, moved.mean - found.mean, rtol=1e-9)
    wider = with_shift(found, shift)
    np.testing.assert_allclose(wider.std, np.hypot(found.std, shift))
    np.testing.assert_array_equal(wider.mean, found.mean)


def test_the_shift_is_in_the_coordinates_of_the_filter():
    H, y, offset = drawn(6)
    prior = Gaussian.from_variance(np.ones(2), np.ones(2))
    # Linear in the logarithms.
    found, moved = (
        IteratedFilter(1e-12)(
            lambda m: Prediction(H @ np.log(m), H / m), prior, seen, R, transform=Log()
        )
        for seen in (y, y + offset)
    )
    difference = moved.transformed.mean - found.transformed.mean
    np.testing.assert_allclose(shift_by_model_error(found, R, offset), difference, rtol=1e-8)


def test_what_the_prior_holds_is_not_shifted():
    held = Gaussian.from_variance(np.zeros(2), np.array([1.0, 0.0]))
    found = estimated(np.ones((3, 2)), np.zeros(3), held, 0.01)
    shift = shift_by_model_error(found, 0.01, np.ones(3))
    assert shift[1] == 0.0
    # One parameter, three observations: 300 of 300 + 1.
    assert shift[0] == pytest.approx(300 / 301)
