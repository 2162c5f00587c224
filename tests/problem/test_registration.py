"""A rigid displacement as parameters: exact for known motions, differentiated exactly."""

from types import SimpleNamespace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import Prediction
from mvest.problem.registration import (
    REGISTRATION,
    RegisteredModel,
    displace,
    registration_of,
)

RNG = np.random.default_rng(2)
REST = RNG.standard_normal((7, 3)) * 10
MOVE = RNG.standard_normal((7, 3, 2))
NAMES = ("E_f.anterior", "chord_rest_length", *REGISTRATION)


class Closure:
    """Stands for a closure: closed positions are a curved function of two parameters."""

    names = NAMES[:2]
    closed_times = 0
    valve = SimpleNamespace(motion=SimpleNamespace(annulus=np.stack([REST[:4], REST[:4] + 1.0])))
    closed = None

    def restart(self, closed):
        self.closed = closed

    def __call__(self, m):
        self.closed_times += 1
        if m[0] < 0:
            return Prediction.failed("no equilibrium")
        closed = REST + MOVE @ np.sin(m)
        by_closed = (MOVE * np.cos(m)).reshape(-1, 2)
        return Prediction(
            np.concatenate([REST.ravel(), closed.ravel()]),
            np.concatenate([np.zeros_like(by_closed), by_closed]),
        )


def at(model, m):
    return model(np.asarray(m, dtype=float))


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (2.0, -1.0, 3.0), (1e-7, 0.0, 2e-7)])
def test_jacobian_against_central_differences(turn):
    model = RegisteredModel(Closure(), NAMES)
    m = np.array([0.7, 1.1, 0.3, -0.8, 1.2, *turn])
    exact = at(model, m).jacobian
    errors = []
    for h in (1e-2, 1e-3):
        columns = [
            (at(model, m + h * e).y - at(model, m - h * e).y) / (2 * h) for e in np.eye(len(m))
        ]
        errors.append(np.abs(np.stack(columns, axis=1) - exact).max())
    # Second order: the error falls by a hundred until rounding takes over.
    assert errors[1] < min(1e-5, 0.02 * errors[0])


def test_a_displacement_alone_closes_nothing_again():
    closure = Closure()
    model = RegisteredModel(closure, NAMES)
    m = np.array([0.7, 1.1, 0.3, -0.8, 1.2, 2.0, -1.0, 3.0])
    moved = m + np.array([0, 0, 0.1, 0, 0, 0, 0.5, 0])
    at(model, m)
    found = at(model, moved)
    assert closure.closed_times == 1
    fresh = at(RegisteredModel(Closure(), NAMES), moved)
    np.testing.assert_array_equal(found.y, fresh.y)
    np.testing.assert_array_equal(found.jacobian, fresh.jacobian)
    model.restart(None)
    at(model, moved)
    assert closure.closed_times == 2
    failed = at(model, [-1.0, 1.1, *np.zeros(6)])
    assert (failed.converged, failed.reason) == (False, "no equilibrium")


def test_shift_and_turn_displace_the_closed_frame():
    model = RegisteredModel(Closure(), NAMES)
    plain = at(model, [0.7, 1.1, *np.zeros(6)]).y.reshape(2, -1, 3)
    np.testing.assert_allclose(plain.ravel(), Closure()(np.array([0.7, 1.1])).y, rtol=0, atol=1e-12)
    shifted = at(model, [0.7, 1.1, 1, 2, 3, 0, 0, 0]).y.reshape(2, -1, 3)
    np.testing.assert_allclose(shifted[1], plain[1] + [1, 2, 3], atol=1e-12)
    np.testing.assert_array_equal(shifted[0], plain[0])
    turned = at(model, [0.7, 1.1, 0, 0, 0, 0, 0, 90]).y.reshape(2, -1, 3)
    arm = plain[1] - model.centre
    expected = np.stack([-arm[:, 1], arm[:, 0], arm[:, 2]], 1)
    np.testing.assert_allclose(turned[1] - model.centre, expected, atol=1e-12)
    np.testing.assert_allclose(model.centre, (REST[:4] + 1.0).mean(axis=0))
    points = RNG.standard_normal((5, 3))
    moved = displace(points, np.array([1.0, 2, 3, 10, 20, 30]), np.ones(3))
    gaps = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (points, moved)]
    np.testing.assert_allclose(gaps[0], gaps[1], atol=1e-12)


def test_parameters_may_come_in_any_order_and_in_part():
    names = ("shift.z", "E_f.anterior", "turn.x", "chord_rest_length")
    model, m = RegisteredModel(Closure(), names), np.array([0.4, 0.7, 5.0, 1.1])
    found = at(model, m)
    whole = at(RegisteredModel(Closure(), NAMES), [0.7, 1.1, 0, 0, 0.4, 5.0, 0, 0])
    np.testing.assert_allclose(found.y, whole.y, atol=1e-12)
    np.testing.assert_allclose(found.jacobian, whole.jacobian[:, [4, 0, 5, 1]], atol=1e-12)
    np.testing.assert_array_equal(registration_of(names, m), [0, 0, 0.4, 5.0, 0, 0])
    np.testing.assert_array_equal(model.mechanical(m), [0.7, 1.1])


@pytest.mark.parametrize(
    "names", [("E_f.anterior", *REGISTRATION), (*NAMES, "shift.w"), NAMES[1::-1] + REGISTRATION]
)
def test_names_must_be_those_of_the_closure_and_of_the_displacement(names):
    with pytest.raises(InputError, match=r"expected E_f\.anterior, chord_rest_length"):
        RegisteredModel(Closure(), names)
