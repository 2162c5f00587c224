"""What a model's error does to an estimate: against an estimate with and without it."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import Gaussian, IteratedFilter, Prediction
from mvest.estimation.information.model_error import shift_by_model_error

PRIOR = Gaussian(np.array([1.0, -1.0]), np.array([[0.5, 0.1], [0.1, 2.0]]))
R = np.linspace(0.1, 0.4, 6)


def test_the_shift_is_the_difference_of_two_estimates_of_a_linear_model():
    rng = np.random.default_rng(2)
    H, y, offset = rng.normal(size=(6, 2)), rng.normal(size=6), rng.normal(size=6)
    estimate = [
        IteratedFilter(1e-12)(lambda m: Prediction(H @ m, H), PRIOR, seen, R).mean
        for seen in (y, y + offset)
    ]
    shift = shift_by_model_error(H, R, offset, PRIOR)
    np.testing.assert_allclose(shift, estimate[1] - estimate[0], rtol=1e-9)


def test_what_the_prior_holds_is_not_shifted():
    held = Gaussian.from_variance(np.zeros(2), np.array([1.0, 0.0]))
    shift = shift_by_model_error(np.ones((3, 2)), 0.01, np.ones(3), held)
    assert shift[1] == 0.0
    # One parameter, three observations: 300 of 300 + 1.
    assert shift[0] == pytest.approx(300 / 301)


@pytest.mark.parametrize(
    ("offset", "message"), [(np.ones(4), r"shape \(4,\)"), (np.array([1, 2, np.nan]), "finite")]
)
def test_inadmissible_offsets_are_refused(offset, message):
    with pytest.raises(InputError, match=message):
        shift_by_model_error(np.ones((3, 2)), 0.01, offset, PRIOR)
