"""Cables: the force law with its toe, and what the parameters of the chordae do."""

import numpy as np
import pytest

from mvest.mechanics.forces.cables import Cables, cable_force
from tests.mechanics.bodies import point_masses

TOE = 0.03


def test_cables_are_slack_or_linear_beyond_the_toe():
    # N / EA = e - e_t / 2.
    force, slope = cable_force(np.array([-0.5, 0.0, 0.03, 0.05, 0.2]), TOE)
    np.testing.assert_allclose(force, [0, 0, 0.015, 0.035, 0.185], rtol=1e-12)
    np.testing.assert_allclose(slope, [0, 0, 1, 1, 1])


def test_slope_is_the_derivative_of_the_force():
    e = np.array([0.004, 0.012, 0.025, 0.04])
    h = 1e-6
    ahead, behind = cable_force(e + h, TOE)[0], cable_force(e - h, TOE)[0]
    np.testing.assert_allclose(cable_force(e, TOE)[1], (ahead - behind) / (2 * h), rtol=1e-7)


@pytest.mark.parametrize("end", [0.0, TOE])
def test_force_is_twice_continuously_differentiable_at_both_ends_of_the_toe(end):
    # The jump of a function over a gap 2h falls as h if the function is continuous; for the third
    # derivative it does not. Slope: jump 0; curvature, by one-sided differences of the slope: jump
    # 0.
    for h in (1e-5, 1e-6):
        force, slope = cable_force(np.array([end - h, end, end + h]), TOE)
        assert abs(force[2] - force[0]) < 2.1 * h
        assert abs(slope[2] - slope[0]) < 1e3 * h
        left, right = (slope[1] - slope[0]) / h, (slope[2] - slope[1]) / h
        assert abs(right - left) < 1e4 * h


def cable(rest=8.0, stiffness=16.0):
    return Cables(point_masses(1), np.array([0]), np.array([rest]), np.array([stiffness]), TOE)


TIP = np.array([[0.0, 0.0, -10.0]])


def test_force_points_to_the_tip_and_scales_with_both_factors():
    # L = 10, L0 = 8: e = 0.25, N = 16 (0.25 - 0.015) = 3.76 N, pulling the leaflet end down; the
    # energy grows upwards, hence the positive sign of the internal force.
    end = np.zeros((1, 3))
    force, *_ = cable().forces(end, TIP, 1.0, 1.0)
    np.testing.assert_allclose(force, [[0, 0, 3.76]], rtol=1e-12)
    force, *_ = cable().forces(end, TIP, 0.5, 1.0)
    np.testing.assert_allclose(force, [[0, 0, 1.88]], rtol=1e-12)
    # Rest length 8.8: e = 0.13636, N = 16 * 0.12136 = 1.9418 N.
    force, *_ = cable().forces(end, TIP, 1.0, 1.1)
    np.testing.assert_allclose(force, [[0, 0, 16 * (10 / 8.8 - 1 - 0.015)]], rtol=1e-12)
    np.testing.assert_allclose(cable().state(end, TIP, 1.0, 1.1).strain, [10 / 8.8 - 1])


@pytest.mark.parametrize("rest", [8.0, 9.85, 12.0], ids=["taut", "toe", "slack"])
def test_derivatives_by_the_factors_and_the_position(rest):
    end = np.array([[0.7, -0.3, 0.2]])
    c, k, g, h = cable(rest), 0.9, 0.97, 1e-6

    def force(k, g, end=end):
        return c.forces(end, TIP, k, g)[0]

    _, stiffness = c.forces(end, TIP, k, g)
    state = c.state(end, TIP, k, g)
    by_stiffness, by_length = c.change(state, stiffness=1.0), c.change(state, length=1.0)
    np.testing.assert_allclose(
        by_stiffness, (force(k + h, g) - force(k - h, g)) / (2 * h), atol=1e-7
    )
    np.testing.assert_allclose(by_length, (force(k, g + h) - force(k, g - h)) / (2 * h), atol=1e-6)
    for i in range(3):
        step = h * np.eye(3)[i]
        difference = (force(k, g, end + step) - force(k, g, end - step)) / (2 * h)
        np.testing.assert_allclose(stiffness[:, :, i], difference, atol=1e-7)
