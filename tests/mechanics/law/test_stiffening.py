"""The law between the linear and the exponential one: its limits and its derivatives."""

import numpy as np
import pytest

from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import (
    CLOSED_STRETCHES,
    ExponentialLaw,
    StiffeningLaw,
    as_stiff,
    biaxial_stress,
)
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import ExponentialTissue, TissueSettings

E = 5.0
CURVE = ExponentialTissue(0.06, 4.3, 900.0)
TISSUE = TissueSettings(2.6, law="stiffening", exponential=CURVE)
RNG = np.random.default_rng(3)
GREEN = RNG.uniform(-0.08, 0.12, (7, 3, 6))
REGION = np.zeros(7, dtype=np.int64)
PREVIOUS = RNG.uniform(-0.1, 0.1, GREEN.shape)
RATE = 0.7


def stress(stiffening, E_f=E, green=GREEN, previous=PREVIOUS, rate=RATE):
    law = StiffeningLaw.of(TISSUE, E_f, stiffening)
    return law.response(Points(green, REGION, previous, rate))[0]


def partial(name, stiffening, value):
    law = StiffeningLaw.of(TISSUE, E, stiffening)
    found = law.response(Points(GREEN, REGION, PREVIOUS, RATE))[0]
    by = Parameter(name, value)
    return law.partial_stress(by, Points(GREEN, REGION, PREVIOUS, RATE), which=0, stress=found)


def test_without_stiffening_it_is_the_linear_law():
    linear = BiotLaw.of([TISSUE.material(E)])
    law = StiffeningLaw.of(TISSUE, E, 0.0)
    for one, other in zip(
        law.response(Points(GREEN, REGION, PREVIOUS, RATE)),
        linear.response(Points(GREEN, REGION, PREVIOUS, RATE)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


def test_its_limit_is_the_exponential_law():
    exponential = ExponentialLaw.of([as_stiff(CURVE, TISSUE, E)])
    wanted = exponential.response(Points(GREEN, REGION, GREEN, 0.0))[0]
    # Of the linear law a millionth is left.
    np.testing.assert_allclose(stress(1e6, rate=0.0), wanted, atol=2e-6 * np.abs(wanted).max())


@pytest.mark.parametrize("stiffening", [0.3, 20.0])
def test_closed_leaflets_are_as_stiff_whatever_the_share(stiffening):
    at = np.array([CLOSED_STRETCHES])
    linear = biaxial_stress(BiotLaw.of([TISSUE.material(E)]), at).sum()
    found = biaxial_stress(StiffeningLaw.of(TISSUE, E, stiffening), at).sum()
    # Both parts are stress-free across the thickness only each at its own thickness.
    assert found == pytest.approx(linear, rel=0.05)


@pytest.mark.parametrize("stiffening", [0.0, 5.0])
def test_derivatives_agree_with_differences(stiffening):
    law = StiffeningLaw.of(TISSUE, E, stiffening)
    _, tangent = law.response(Points(GREEN, REGION, PREVIOUS, RATE))
    h = 1e-6
    for i in range(6):
        step = h * np.eye(6)[i]
        by = (stress(stiffening, green=GREEN + step) - stress(stiffening, green=GREEN - step)) / (
            2 * h
        )
        np.testing.assert_allclose(tangent[..., i], by, atol=1e-6 * np.abs(tangent).max())
    by_E = (stress(stiffening, E + h) - stress(stiffening, E - h)) / (2 * h)
    scale = np.abs(by_E).max()
    np.testing.assert_allclose(partial("E_f.anterior", stiffening, E), by_E, atol=1e-7 * scale)
    by_share = (stress(stiffening + h) - stress(stiffening)) / h
    scale = np.abs(by_share).max()
    found = partial("stiffening.anterior", stiffening, stiffening)
    np.testing.assert_allclose(found, by_share, atol=1e-5 * scale)


@pytest.mark.parametrize("stiffening", [0.3, 50.0])
def test_damping_is_that_of_the_linear_law(stiffening):
    linear = BiotLaw.of([TISSUE.material(E)])
    alone = (
        linear.response(Points(GREEN, REGION, PREVIOUS, RATE))[0]
        - linear.response(Points(GREEN, REGION, PREVIOUS, 0.0))[0]
    )
    damped = stress(stiffening) - stress(stiffening, rate=0.0)
    np.testing.assert_allclose(damped, alone, atol=1e-10 * np.abs(alone).max())
    change = RNG.standard_normal(GREEN.shape)
    law = StiffeningLaw.of(TISSUE, E, stiffening)
    by = (stress(stiffening, previous=PREVIOUS + change) - stress(stiffening)).ravel()
    np.testing.assert_allclose(
        law.history_stress(Points(GREEN, REGION, GREEN, RATE), change).ravel(),
        by,
        atol=1e-9 * np.abs(by).max(),
    )
