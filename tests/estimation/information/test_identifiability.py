"""The information of linear models by hand."""

import numpy as np
import pytest

from mvest.estimation import Gaussian, cramer_rao_bound, identifiability


def test_the_bound_of_a_straight_line_by_hand():
    # Intercept and slope at x = 0, 1, 2 with variance 0.5: H'H = [[3, 3], [3, 5]],
    # 0.5 (H'H)^-1 = 0.5/6 [[5, -3], [-3, 3]]; correlation -3/√15.
    H = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    expected = np.array([[5.0, -3.0], [-3.0, 3.0]]) / 12.0
    np.testing.assert_allclose(cramer_rao_bound(H, 0.5), expected, rtol=1e-12)
    found = identifiability(H, 0.5, np.ones(2), names=("intercept", "slope"))
    assert found.correlation[0, 1] == pytest.approx(-3.0 / np.sqrt(15.0))
    # Eigenvalues of 2 H'H: 8 ± 2√10.
    assert found.condition_number == pytest.approx((8 + 2 * 10**0.5) / (8 - 2 * 10**0.5))
    # A slope known beforehand to 0.5, as one more observation: H'R^-1H = [[6, 6], [6, 10 + 4]].
    prior = Gaussian.from_variance(np.zeros(2), np.array([1e12, 0.25]))
    assert cramer_rao_bound(H, 0.5, prior)[0, 0] == pytest.approx(14.0 / (6 * 14 - 36))


def test_parameters_that_act_alike_are_named_with_how_one_makes_up_for_the_other():
    # x and 2 x + a little: -1 of b is +2 of a. The last observation is of c alone.
    x = np.array([1.0, -2.0, 0.5, 3.0, 0.0])
    other = np.array([0.0, 0.03, 0.1, 0.05, 0.0])
    H = np.stack([x, 2.0 * x + other, np.eye(5)[4]], axis=1)
    found = identifiability(H, 0.01, np.ones(3), names=("a", "b", "c"))
    (group,) = found.confounded()
    assert sorted(group.names) == ["a", "b"]
    assert group.correlation == pytest.approx(-found.correlation[0, 1])
    assert group.correlation > 0.99
    first = "ab".index(group.names[0])
    C = found.covariance
    assert group.exchange == (1.0, pytest.approx(C[0, 1] / C[first, first]))
    assert group.exchange[1] == pytest.approx(-2.0 if first == 1 else -0.5, rel=0.05)
    # With 4 for a large change of a, the same change is a fourth of it.
    (scaled,) = identifiability(
        H, 0.01, np.array([4.0, 1.0, 1.0]), names=("a", "b", "c")
    ).confounded(width=0.01)
    b_per_a = scaled.exchange[1] ** (1 if scaled.names[0] == "a" else -1)
    assert b_per_a == pytest.approx(4.0 * -0.5, rel=0.05)
    # However correlated: with a hundredth of the noise both are known to better than 5 %.
    exact = identifiability(H, 1e-6, np.ones(3), names=("a", "b", "c"))
    assert exact.confounded() == ()
    assert exact.confounded(width=1e-4)[0].correlation == pytest.approx(group.correlation)


def test_three_that_share_one_direction_are_one_group():
    # Ratios of a and b to c are seen to 1 %, c itself to 50 %: whatever c is, a and b are as much.
    # d is seen by itself.
    H = np.array([[1.0, 0.0, -1.0, 0.0], [0.0, 1.0, -1.0, 0.0], [0, 0, 0.02, 0], [0, 0, 0, 0.1]])
    found = identifiability(H, 1e-4, np.ones(4), names=("a", "b", "c", "d"))
    (group,) = found.confounded()
    assert sorted(group.names) == ["a", "b", "c"]
    assert group.exchange == pytest.approx((1.0, 1.0, 1.0), rel=1e-3)
    # corr(a, c) = 0.5 / √(0.5² + 0.01²)
    assert group.correlation == pytest.approx(0.5 / np.hypot(0.5, 0.01), rel=1e-3)


def test_what_is_not_determined_is_told_as_such_and_not_as_a_correlation():
    H = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 1.0]])
    found = identifiability(H, 1.0, np.ones(3), names=("a", "b", "c"))
    assert found.confounded() == ()
    assert any("a" in words and "not determined at all" in words for words in found.flat())


def test_what_is_known_to_no_better_than_its_size_has_no_percentage():
    found = identifiability(np.diag([1.0, 0.04]), 0.01, np.ones(2), names=("a", "b"))
    assert found.flat() == ("1.00 b: known to no better than its own size",)
