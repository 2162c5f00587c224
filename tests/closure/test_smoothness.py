"""Made-up closed states along a modulus: curvature passes, jumps and wrong derivatives do not.

States have 400 vertices, of which a few may jump, which a mean would not show.
"""

import numpy as np
import pytest

from mvest.closure.smoothness import (
    JUMP_LIMIT,
    RESOLUTION,
    SEEN,
    SLOPE_LIMIT,
    PathState,
    follow,
)
from mvest.observation.learned import ErrorBeliefs

FACTORS = (0.8, 0.95, 0.99, 1.01, 1.05, 1.2)
FEW = 4
RNG = np.random.default_rng(1)
PLACE = RNG.normal(size=(400, 3))
WAY = RNG.normal(size=(400, 3))


def response(shape, slope, jump_at=None, jump=0.0, wrong=1.0):
    """PLACE + shape(s) WAY, s = log E; a few vertices move by ``jump`` mm above ``jump_at``."""

    def close(factor):
        s = np.log(factor)
        y = PLACE + shape(s) * WAY
        if jump_at is not None and s > jump_at:
            y[:FEW, 2] += jump
        return PathState(y, wrong * slope(s) * WAY)

    return close


def judged(close, factors=FACTORS):
    return follow("E_f", close, close(1.0), factors)


def waves(size, width):
    return (lambda s: size * np.sin(s / width), lambda s: size / width * np.cos(s / width))


@pytest.mark.parametrize(
    ("shape", "slope"),
    [
        # Over 20 % these differ by more from their derivative than any criterion that compares
        # differences with it could let pass.
        (lambda s: np.exp(5 * s), lambda s: 5 * np.exp(5 * s)),
        waves(0.3, 0.08),
        (lambda s: 0.5 * np.tanh(s / 0.05), lambda s: 10 / np.cosh(s / 0.05) ** 2),
    ],
)
def test_smooth_responses_pass_however_curved(shape, slope):
    path = judged(response(shape, slope))
    assert path.passed, path.reason
    # Ascending, and without a hole from one end to the other.
    assert path.pieces[0].low == 0.8
    assert path.pieces[-1].high == 1.2
    assert [p.high for p in path.pieces[:-1]] == [p.low for p in path.pieces[1:]]


@pytest.mark.parametrize("place", [-0.2, -0.005, 0.07])
@pytest.mark.parametrize("curve", [waves(0.1, 0.3), waves(0.3, 0.08)])
def test_a_jump_of_few_vertices_is_seen_wherever_it_is(place, curve):
    path = judged(response(*curve, place, 0.3))
    assert not path.passed
    last = path.pieces[-1]
    # It is found with its size and number of vertices, and where it is.
    assert last.unexplained_mm == pytest.approx(0.3, abs=0.05)
    assert last.vertices == FEW
    assert np.log(last.low) <= place <= np.log(last.high)
    assert last.width < RESOLUTION
    assert f"at {FEW} vertices" in path.reason
    assert "a jump of 0.3" in path.reason or "a jump of 0.2" in path.reason


def test_a_jump_within_the_limit_passes_and_one_beyond_does_not():
    gentle = (lambda s: 0.0 * s, lambda s: 1e3 + 0.0 * s)
    line = (lambda s: 2.0 * s, lambda s: 2.0 + 0.0 * s)
    assert judged(response(*line, 0.1, 0.9 * JUMP_LIMIT)).passed
    assert not judged(response(*line, 0.1, 1.1 * JUMP_LIMIT)).passed
    assert not judged(response(*gentle)).passed


@pytest.mark.parametrize(("change", "passes"), [(0.5, True), (40.0, False)])
def test_a_kink_is_judged_by_what_it_moves_within_the_resolution(change, passes):
    # A slope of 2 that changes by k at s = 0.003, off the middle of [0, log 1.01]: unexplained
    # is k |h / 2 - 0.003| WAY, 0.002 k |WAY|, with |WAY| up to 3.5.
    def shape(s):
        return 2.0 * s + change * max(s - 0.003, 0.0)

    path = judged(response(shape, lambda s: 2.0 + change * (s > 0.003)))
    assert path.passed == passes, path.reason


def test_a_derivative_that_is_wrong_everywhere_is_seen_by_its_share():
    # 10 % too large: less than the limit in mm on small steps, but a tenth of the way.
    right = waves(0.05, 1.0)
    assert judged(response(*right)).passed
    path = judged(response(*right, wrong=1.1))
    assert not path.passed
    assert "explain 9.1 % of the whole motion" in path.reason
    assert path.pieces[-1].unexplained_mm < SEEN


@pytest.mark.parametrize(("wrong", "passes"), [(1.3, True), (1.6, False), (0.5, False)])
def test_a_derivative_that_is_wrong_at_one_state_explains_neither_side(wrong, passes):
    # Of a way so short that nothing of it is seen, and of all of it too little to count.
    close = response(*waves(0.05, 1.0))
    centre = PathState(close(1.0).y, wrong * close(1.0).slope)
    path = follow("E_f", close, centre, FACTORS)
    assert max(piece.unexplained_mm for piece in path.pieces) < SEEN
    assert path.share < SLOPE_LIMIT
    assert path.passed == passes, path.reason
    assert passes or path.reason.startswith("the derivative at +0 % explains neither side")


def test_what_is_seen_is_what_an_estimator_believes_of_a_point():
    assert ErrorBeliefs().resolution_mm == SEEN


def test_a_closure_that_fails_is_the_reason():
    def close(factor):
        return "it buckled" if factor > 1.1 else response(*waves(0.1, 0.5))(factor)

    path = follow("E_f.anterior", close, response(*waves(0.1, 0.5))(1.0), FACTORS)
    assert not path.passed
    assert path.reason == "no closed state at +20 %: it buckled"
