"""A valve whose leaflets are between the linear law and an exponential one.

On the same small valve as in test_model.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from mvest.closure.continuation import STIFFENED, ClosedState, Coordinates
from mvest.mechanics.law.exponential import StiffeningLaw
from mvest.mechanics.law.regional import LeafletLaw
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.valve_system import material_law
from tests.closure.test_model import (
    CLOSING,
    GENTLE,
    OPEN,
    SMALL,
    TINY,
    TISSUE,
    check_closed_derivatives,
    check_moving_derivatives,
    model_of,
)

CURVE = ExponentialTissue(0.06, 4.3, 900.0)
ANTERIOR = replace(TISSUE["anterior"], law="stiffening", exponential=CURVE)
MIXED = {**TISSUE, "anterior": ANTERIOR}
NAMES = ("E_f.anterior", "E_f.posterior", "stiffening.anterior")
AT = np.array([6.23, 2.09, 0.5])


def mixed(protocol, names=NAMES, tissue=MIXED, **changes):
    model = model_of(protocol, names, **changes)
    model.settings = replace(model.settings, tissue=tissue)
    return model


def test_derivatives_of_a_moving_valve_agree_with_differences():
    names, at = (*NAMES, "damping"), np.array([*AT, 0.12])
    check_moving_derivatives(mixed(OPEN, names, **SMALL), at, [1.6e-3] * 4)


def test_derivatives_of_the_closed_valve_agree_with_differences_in_contact():
    check_closed_derivatives(mixed(CLOSING, continuation=True), AT, least=0.05)


def test_each_leaflet_has_its_own_share_and_without_a_value_that_of_its_settings():
    model = mixed(OPEN, **TINY)

    def laws(values, tissue=MIXED):
        settings = replace(model.settings, tissue=tissue)
        law = material_law(model.mesh, settings, values)
        assert isinstance(law, LeafletLaw)
        return law.laws

    values = dict(zip(NAMES, AT, strict=True))
    anterior, _ = laws(values)
    assert isinstance(anterior, StiffeningLaw)
    assert anterior.stiffening == 0.5
    del values["stiffening.anterior"]
    assert laws(values)[0].stiffening == 0.0
    assert laws(values, {**MIXED, "anterior": replace(ANTERIOR, stiffening=2.0)})[0].stiffening == 2
    # Both of them, so that it is not the difference of laws that divides the body.
    both = {**MIXED, "posterior": ANTERIOR}
    assert [law.stiffening for law in laws({**values, "stiffening.posterior": 1.0}, both)] == [0, 1]


def test_a_way_begins_without_any_stiffening():
    coordinates = Coordinates.of(NAMES, mixed(OPEN, **TINY).settings)
    none = np.array([6.23, 2.09, 0.0])
    np.testing.assert_allclose(coordinates(none), [np.log(6.23), np.log(2.09), 0.0])
    np.testing.assert_allclose(coordinates.parameters(coordinates(AT)), AT, rtol=1e-14)
    assert coordinates(AT)[2] == pytest.approx(STIFFENED * np.log(1.5))
    rates = coordinates.expected_move(ClosedState(AT, None, slopes=np.eye(3)), 1.001 * AT)
    np.testing.assert_allclose(rates, 0.001 * AT, rtol=1e-3)
    assert coordinates.distance(AT, np.array([6.23, 2.09, -1.5])) == np.inf


def test_a_closure_begins_with_linear_tissue_and_ends_where_any_other_does():
    # Without contact there is one equilibrium.
    direct = mixed(GENTLE, **SMALL)
    ends = direct.close(AT).simulation
    model = mixed(GENTLE, continuation=True, **SMALL)
    begun, closing = [], model._close

    def followed(m, *given, **more):
        begun.append(m[2])
        return closing(m, *given, **more)

    model._close = followed
    found = model.close(AT).simulation
    assert begun[0] == 0.0
    assert begun[-1] == AT[2]
    np.testing.assert_allclose(found.frames[-1], ends.frames[-1], atol=1e-7)
    # From there on it is gone on from.
    model.close(AT * [1.0, 1.0, 1.1])
    assert 0.0 not in begun[1:]
    linear = mixed(GENTLE, **SMALL).close(AT * [1.0, 1.0, 0.0]).simulation
    assert np.abs(linear.frames[-1] - ends.frames[-1]).max() > 0.01
