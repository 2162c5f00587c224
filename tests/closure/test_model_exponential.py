"""A valve with tissue of the exponential law, and one leaflet of each law.

On the same small valve as in test_model.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError, MaterialError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw
from mvest.mechanics.law.regional import LeafletLaw
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import EXPONENTIAL_KINDS, ExponentialTissue, TissueSettings
from mvest.mechanics.valve_system import material_law
from tests.closure.test_model import (
    CLOSING,
    OPEN,
    SMALL,
    TINY,
    TISSUE,
    check_closed_derivatives,
    check_moving_derivatives,
    model_of,
)

STIFF = ExponentialTissue(0.2, 4.3, 1400.0)
LINEAR = TISSUE["posterior"]
# Both laws in one valve, so that what one leaflet's law makes of the other's elements is seen.
MIXED = {"anterior": TissueSettings(2.651, law="exponential", exponential=STIFF),
         "posterior": LINEAR}  # fmt: skip
BOTH = {**MIXED, "posterior": MIXED["anterior"]}
VALUES = {
    "c0.anterior": 0.2,
    "c1.anterior": 4.3,
    "c2.anterior": 1400.0,
    "mu.anterior": 0.05,
    "kappa.anterior": 5.0,
    "E_f.posterior": 4.0,
    "damping": 0.12,
}
NAMES = tuple(VALUES)
AT = np.array(list(VALUES.values()))


def mixed(protocol, names=NAMES, **changes):
    model = model_of(protocol, names, **changes)
    model.settings = replace(model.settings, tissue=MIXED)
    return model


def test_derivatives_of_a_moving_valve_agree_with_differences():
    # Nearly linear in a coefficient: large steps keep the error above the round-off.
    steps = [1.6e-3 if name == "damping" else 1.6e-2 for name in NAMES]
    check_moving_derivatives(mixed(OPEN, **SMALL), AT, steps)


def test_derivatives_of_the_closed_valve_agree_with_differences_in_contact():
    names = ("c0.anterior", "c2.anterior", "E_f.posterior")
    own = np.array([VALUES[name] for name in names])
    check_closed_derivatives(mixed(CLOSING, names, continuation=True), own)


def law_of(tissue, values):
    model = model_of(OPEN, **TINY)
    model.settings = replace(model.settings, tissue=tissue)
    return material_law(model.mesh, model.settings, values), model.mesh


def test_each_region_follows_its_own_law():
    values = {**VALUES, "E_f.anterior": 6.0}
    law, mesh = law_of(MIXED, values)
    assert isinstance(law, LeafletLaw)
    assert set(law.kinds) >= {*EXPONENTIAL_KINDS, "E_f"}
    coefficients = {kind: VALUES[f"{kind}.anterior"] for kind in EXPONENTIAL_KINDS}
    expected = (
        ExponentialLaw.of([MIXED["anterior"].coefficients(coefficients)] * 2),
        BiotLaw.of([LINEAR.material(4.0)] * 2),
    )
    rng = np.random.default_rng(0)
    green, before, change = rng.uniform(-0.05, 0.1, (3, len(mesh.elements), 4, 6))
    found = law.response(Points(green, mesh.region, before, 0.3))
    for which, other in enumerate(expected):
        own = mesh.region == which
        there = other.response(Points(green, mesh.region, before, 0.3))
        for ours, theirs in (
            *zip(found, there, strict=True),
            (law.strain(green), other.strain(green)),
            (law.strain_change(green, change), other.strain_change(green, change)),
            (
                law.history_stress(Points(green, mesh.region, green, 0.3), change),
                other.history_stress(Points(green, mesh.region, green, 0.3), change),
            ),
        ):
            np.testing.assert_array_equal(ours[own], theirs[own])

    def partial(name, which):
        at = Points(green, mesh.region, before, 0.3)
        by = Parameter(name, values[name])
        return law.partial_stress(by, at, which=which, stress=found[0])

    assert np.all(partial("c0.anterior", 0)[mesh.region == 1] == 0)
    assert np.all(partial("E_f.posterior", 1)[mesh.region == 0] == 0)
    with pytest.raises(InputError, match=r"the law of its leaflet knows c0\.REGION"):
        partial("E_f.anterior", 0)


def test_one_law_for_all_is_not_divided():
    assert isinstance(law_of(BOTH, {})[0], ExponentialLaw)
    linear = {"E_f.anterior": 6.0, "E_f.posterior": 4.0}
    assert isinstance(law_of(TISSUE, linear)[0], BiotLaw)
    # What is no parameter is taken from the settings.
    law, _ = law_of(BOTH, {"c0.posterior": 0.3})
    np.testing.assert_array_equal(law.coefficients[:, 0], [0.2, 0.3])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("E_f.anterior",), r"'anterior' follows the exponential law, which has c0, c1, c2"),
        (("E_f.posterior", "c0.posterior"), r"'posterior' follows the biot law, which has E_f"),
    ],
)
def test_parameters_of_the_other_law_are_refused_before_anything_is_closed(names, message):
    model = mixed(OPEN, names, **TINY)
    with pytest.raises(InputError, match=message):
        model.close(np.ones(len(names)))


def test_settings_name_the_law_and_bring_its_coefficients():
    with pytest.raises(InputError, match="'hyper', expected biot, corotational, expon"):
        TissueSettings(1.0, law="hyper")
    with pytest.raises(InputError, match="coefficients are missing"):
        TissueSettings(1.0, law="exponential")
    with pytest.raises(InputError, match="no coefficients"):
        LINEAR.coefficients({})
    with pytest.raises(MaterialError, match="c1 = -1"):
        MIXED["anterior"].coefficients({"c1": -1.0})
