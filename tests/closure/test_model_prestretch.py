"""A valve whose open leaflets are stretched already: the small valve of test_model.py."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.law.regional import LeafletLaw
from mvest.mechanics.valve_system import material_law
from tests.closure.test_model import (
    CLOSING,
    OPEN,
    SMALL,
    TINY,
    TISSUE,
    check_closed_derivatives,
    model_of,
)

NAMES = ("E_f.anterior", "E_f.posterior", "prestretch.anterior")
AT = np.array([6.23, 2.09, 1.03])


def test_derivatives_of_the_closed_valve_agree_with_differences_in_contact():
    check_closed_derivatives(model_of(CLOSING, NAMES, continuation=True), AT, step=1.6e-3)


def test_a_moving_valve_has_no_derivative_by_it():
    model = model_of(OPEN, NAMES, **SMALL)
    with pytest.raises(InputError, match="at an equilibrium only"):
        model.close(AT)


def test_parameters_go_before_settings_and_without_either_the_law_is_as_it_was():
    model = model_of(OPEN, NAMES, **TINY)
    longer = {**TISSUE, "anterior": replace(TISSUE["anterior"], prestretch=1.1)}

    def law(values, tissue=TISSUE):
        return material_law(model.mesh, replace(model.settings, tissue=tissue), values)

    moduli = dict(zip(NAMES[:2], AT[:2], strict=True))
    assert not isinstance(law(moduli), LeafletLaw)
    np.testing.assert_array_equal(law(moduli, longer).prestretch, [1.1, 1.0])
    stated = {**moduli, "prestretch.posterior": 0.98}
    np.testing.assert_array_equal(law(stated, longer).prestretch, [1.1, 0.98])
    with pytest.raises(InputError, match="expected > 0"):
        law({**moduli, "prestretch.posterior": -1.0})
