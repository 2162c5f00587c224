"""Names of parameters: what is known, in one place, and what is refused."""

import pytest

from mvest.errors import InputError
from mvest.mechanics.parameters import (
    KINDS,
    Parameter,
    is_positive,
    kind_of,
)


def test_a_name_is_read_as_kind_region_and_mode():
    mode = Parameter("field.anterior.12", 0.3)
    assert (mode.kind, mode.region, mode.mode) == ("field", "anterior", 12)
    modulus = Parameter("E_f.anterior", 6.0)
    assert (modulus.kind, modulus.region, modulus.part) == ("E_f", "anterior", "anterior")
    assert Parameter("field.anterior", 0.0).mode == -1
    assert Parameter("pressure_scale", 1.0).region == ""


def test_only_coefficients_of_a_field_may_be_negative():
    assert not is_positive("field.anterior.0")
    others = ("E_f.a", "pressure_scale", "chord_stiffness", "damping")
    others += ("c0.a", "c1.a", "c2.a", "mu.a", "kappa.a", "stiffening.a", "prestretch.a")
    assert all(map(is_positive, others))
    # Every kind has been thought of here: a new one must be added above.
    assert {name.partition(".")[0] for name in others} | {"field", "chord_rest_length"} == set(
        KINDS
    )


@pytest.mark.parametrize(
    "name",
    ["luck", "E_f", "damping.anterior", "pressure_scale.tip0", "pressure_scale.", "", "field"],
)
def test_what_is_no_name_is_told_the_known_ones(name):
    with pytest.raises(InputError, match=r"known: E_f\.REGION, field\.REGION\.K"):
        kind_of(name)
