"""The information of linear models by hand, and what an error of the model does to an estimate."""

import numpy as np
import pytest

from mvest.estimation import Gaussian, IteratedFilter, Prediction, identifiability
from mvest.estimation.information.identifiability import shift_by_model_error, with_shift
from tests.estimation.problems import bound


def test_the_bound_of_a_straight_line_by_hand():
    # Intercept and slope at x = 0, 1, 2 with variance 0.5: H'H = [[3, 3], [3, 5]],
    # 0.5 (H'H)^-1 = 0.5/6 [[5, -3], [-3, 3]]; correlation -3/√15.
    H = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    expected = np.array([[5.0, -3.0], [-3.0, 3.0]]) / 12.0
    np.testing.assert_allclose(bound(H, 0.5), expected, rtol=1e-12)
    found = identifiability(H, 0.5, np.ones(2), names=("intercept", "slope"))
    assert found.correlation[0, 1] == pytest.approx(-3.0 / np.sqrt(15.0))
    # Eigenvalues of 2 H'H: 8 ± 2√10.
    assert found.condition_number == pytest.approx((8 + 2 * 10**0.5) / (8 - 2 * 10**0.5))
    # A slope known beforehand to 0.5, as one more observation: H'R^-1H = [[6, 6], [6, 10 + 4]].
    prior = Gaussian.from_variance(np.zeros(2), np.array([1e12, 0.25]))
    assert bound(H, 0.5, prior)[0, 0] == pytest.approx(14.0 / (6 * 14 - 36))


def test_two_parameters_with_the_same_effect_are_not_determined():
    # The relative combination (E, q) = (1, 1)/√2 changes nothing.
    values = np.array([6.0, 1.0])
    H = np.outer(np.arange(1.0, 5.0), [-1.0 / values[0], 1.0])
    report = identifiability(H, 0.01, values, names=("E", "pressure_scale"))
    (words,) = report.flat()
    assert words.endswith("not determined at all")
    assert report.condition_number == np.inf
    assert np.all(np.isinf(report.std))
    assert np.all(np.isnan(report.correlation))
    # A prior of 10 % on the pressure makes the modulus known to 10 %.
    prior = Gaussian(values, np.diag([100.0**2, 0.1**2]))
    known = identifiability(H, 1e-6, values, prior=prior)
    assert known.std[0] / values[0] == pytest.approx(0.1, rel=1e-2)


def test_parameters_that_act_alike_are_named_with_how_one_makes_up_for_the_other():
    # x and 2 x + a little: -1 of b is +2 of a. The last observation is of c alone.
    x = np.array([1.0, -2.0, 0.5, 3.0, 0.0])
    other = np.array([0.0, 0.03, 0.1, 0.05, 0.0])
    H = np.stack([x, 2.0 * x + other, np.eye(5)[4]], axis=1)
    found = identifiability(H, 0.01, np.ones(3), names=("a", "b", "c"))
    (group,) = found.confounded()
    assert sorted(group.parameters) == ["a", "b"]
    assert group.correlation == pytest.approx(-found.correlation[0, 1])
    assert group.correlation > 0.99
    first = "ab".index(group.parameters[0])
    C = found.covariance
    assert group.relative == (0.1, pytest.approx(0.1 * C[0, 1] / C[first, first]))
    assert group.relative[1] == pytest.approx(-0.2 if first == 1 else -0.05, rel=0.05)
    # However correlated: with a hundredth of the noise both are known to better than 5 %.
    exact = identifiability(H, 1e-6, np.ones(3), names=("a", "b", "c"))
    assert exact.confounded() == ()
    assert exact.confounded(width=1e-4)[0].correlation == pytest.approx(group.correlation)


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
