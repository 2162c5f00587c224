"""Every kind of parameter of a closing valve: its derivative, its effect and its coordinate.

On the same small valve as in test_model.py.
"""

import numpy as np
import pytest

from mvest.closure.continuation import ClosedState, Coordinates
from mvest.errors import InputError, MaterialError
from mvest.mechanics.parameters import KINDS
from mvest.mechanics.settings import EXPONENTIAL_KINDS, ModulusField
from tests.closure.test_model import (
    AT,
    CLOSING,
    MODULI,
    OPEN,
    SMALL,
    TINY,
    continued,
    model_of,
    step_study,
)

FIELDS = {"fields": {"anterior": ModulusField(8.0, 0.4, 4)}}
VALUES = {
    **dict(zip(MODULI, AT, strict=True)),
    "field.anterior.0": 0.2,
    "field.anterior.3": -0.3,
    "pressure_scale": 1.1,
    "damping": 0.12,
    "chord_stiffness": 0.9,
    "chord_stiffness.marginal": 1.1,
    "chord_rest_length": 0.96,
    "chord_rest_length.marginal": 0.99,
    "chord_rest_length.tip0": 0.99,
}
NAMES = tuple(VALUES)
# Relative steps: the toe of the chordae ends at 1.5 % strain, which their length must not leave,
# and what is nearly linear in a parameter needs a large step, or round-off is all there is.
STEPS = {"chord_rest_length": 4e-4, "field": 2e-2}


def step_of(name, default):
    return STEPS.get(name.partition(".")[0], default)


def test_there_is_a_value_of_every_kind_here():
    # The others are in test_model_laws.py.
    others = {*EXPONENTIAL_KINDS, "stiffening", "prestretch"}
    assert {name.partition(".")[0] for name in NAMES} == set(KINDS) - others


def test_derivatives_of_a_moving_valve_agree_with_differences_for_every_kind():
    # No equilibrium at the end: velocity, damping and the history of strain are in the derivative.
    model = model_of(OPEN, NAMES, **SMALL, settings=FIELDS)
    m = np.array(list(VALUES.values()))
    simulation = model.close(m).simulation
    assert simulation.converged
    assert np.linalg.norm(simulation.frames[-1] - model.mesh.nodes) > 1.0
    exact = simulation.sensitivities[-1]

    def run(values):
        result = model.close(values, sensitivities=False).simulation
        assert result.converged
        return result.frames[-1]

    for k, name in enumerate(NAMES):
        assert np.linalg.norm(exact[k]) > 0.1, name
        coarse, fine, best = step_study(exact[k], run, m, k, step_of(name, 1.6e-3))
        # Second order, unless the error is round-off already.
        assert coarse / fine == pytest.approx(16, rel=0.1) or coarse < 1e-7, name
        assert best < 2e-8, name


def test_derivatives_of_the_closed_valve_agree_with_differences_for_every_kind():
    model = model_of(CLOSING, NAMES, continuation=True, settings=FIELDS)
    m = np.array(list({**VALUES, "chord_rest_length": 1.0}.values()))
    simulation = model.close(m).simulation
    assert simulation.converged
    assert simulation.records[-1].active_contacts > 200
    start, exact = simulation.frames[-1], simulation.sensitivities[-1]

    def run(values):
        return continued(model, start, values).frames[-1]

    for k, name in enumerate(NAMES):
        if name == "damping":
            # An equilibrium knows nothing of what damped the way to it.
            assert np.abs(exact[k]).max() == 0
            continue
        assert np.linalg.norm(exact[k]) > 0.1, name
        coarse, fine, best = step_study(exact[k], run, m, k, step_of(name, 3.2e-3))
        assert coarse / fine == pytest.approx(16, rel=0.1) or coarse < 1e-6, name
        assert best < 1e-6, name


def test_factors_of_all_chordae_and_of_some_multiply():
    # Each tip has its chordae: both tips by f is all by f, and family and tip act on top.
    def frame(**values):
        own = {name.replace("_of_", "."): value for name, value in values.items()}
        model = model_of(OPEN, MODULI, **TINY, fixed=own)
        result = model.close(AT, sensitivities=False).simulation
        assert result.converged
        return result.frames[-1]

    both = frame(chord_rest_length_of_tip0=0.95, chord_rest_length_of_tip1=0.95)
    np.testing.assert_array_equal(both, frame(chord_rest_length=0.95))
    product = frame(chord_rest_length=0.97, chord_rest_length_of_tip0=0.98)
    apart = frame(chord_rest_length_of_tip0=0.97 * 0.98, chord_rest_length_of_tip1=0.97)
    np.testing.assert_allclose(product, apart, rtol=0, atol=1e-9)
    assert np.abs(product - both).max() > 0.01


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("chord_stiffness.secondary", "known here: .*marginal.*strut.*tip0"),
        ("field.anterior.4", "known here: anterior.0, .*anterior.3"),
        ("viscosity", "unknown parameter 'viscosity'"),
    ],
)
def test_names_that_the_valve_does_not_have_are_refused_before_anything_is_closed(name, message):
    with pytest.raises(InputError, match=message):
        model_of(OPEN, (*MODULI, name), **TINY, settings=FIELDS).close(np.array([*AT, 1.0]))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_parameter_that_is_not_finite_is_refused(value):
    with pytest.raises(MaterialError, match=r"chord_stiffness.*finite"):
        model_of(CLOSING, (*MODULI, "chord_stiffness"), **TINY).close(np.array([*AT, value]))


def test_the_way_to_other_coefficients_is_measured_in_the_logarithm_of_the_modulus():
    names = ("E_f.anterior", "E_f.posterior", "field.anterior.0")
    model = model_of(
        OPEN, names, **TINY, settings=FIELDS, continuation=True, reach=0.5, largest_change=0.1
    )
    start = np.array([6.0, 4.0, -0.5])
    model.restart(ClosedState(start, model.mesh.nodes))
    # A change of 0.6 of the coefficient is one of 0.4 x 0.6 = 0.24 in log E_f: three parts.
    way = model._way_to(np.array([6.0, 4.0, 0.1]))
    np.testing.assert_allclose(way, [[6, 4, -0.3], [6, 4, -0.1]], rtol=0, atol=1e-12)
    # 0.4 x 1.5 = 0.6 is beyond the reach.
    assert not model._near(np.array([6.0, 4.0, 1.0]))
    assert model._near(np.array([6.6, 4.0, 0.5]))


def test_coordinates_are_logarithms_and_can_be_inverted():
    names = (*MODULI, "field.anterior.1")
    coordinates = Coordinates.of(names, model_of(OPEN, **TINY, settings=FIELDS).settings)
    m, negative = np.array([*AT, -0.7]), np.array([1.0, -1.0, 1.0])
    at = coordinates(m)
    np.testing.assert_allclose(at, [np.log(AT[0]), np.log(AT[1]), -0.28])
    np.testing.assert_allclose(coordinates.parameters(at), m)
    assert coordinates.distance(m, negative) == np.inf
    assert not coordinates.between(m, negative, 0.1)


def test_the_expected_move_is_the_derivative_times_a_small_change_of_every_kind():
    model = model_of(OPEN, NAMES, **TINY, continuation=True, settings=FIELDS)
    m, random = np.array(list(VALUES.values())), np.random.default_rng(3)
    slopes = random.normal(size=(len(m), len(model.mesh.nodes), 3))
    model.restart(ClosedState(m, model.mesh.nodes, slopes=slopes))
    for k, name in enumerate(NAMES):
        change = 1e-7 * m[k] * np.eye(len(m))[k]
        expected = slopes[k] * change[k]
        move = model._coordinates.expected_move(model.closed, m + change)
        np.testing.assert_allclose(move, expected, 1e-6, err_msg=name)
