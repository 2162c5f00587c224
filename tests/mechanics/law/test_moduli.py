"""Moduli of a leaflet as functions of what is estimated, against differences and by hand."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError, MaterialError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.moduli import LeafletModuli, PoissonReading
from mvest.mechanics.parameters import Parameter

READINGS = tuple(PoissonReading)


def moduli_of(reading, G=1.7):
    return LeafletModuli(6.23, 2.651, 0.488, reading, G)


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("kind", ["E_f", "ratio", "G"])
def test_derivatives_of_the_stiffness_agree_with_differences(reading, kind):
    moduli = moduli_of(reading)
    value, exact = getattr(moduli, kind), moduli.stiffness_by(kind)
    differences = []
    for h in (4e-3 * value, 1e-3 * value):
        ahead, behind = (
            replace(moduli, **{kind: value + s * h}).material.stiffness for s in (1, -1)
        )
        differences.append((ahead - behind) / (2 * h))
    best = (16 * differences[1] - differences[0]) / 15
    np.testing.assert_allclose(best, exact, rtol=0, atol=1e-8 * np.abs(exact).max())
    assert np.abs(exact).max() > 0.1


def test_a_shear_modulus_of_its_own_is_not_scaled_with_E_f():
    own, follows = moduli_of(PoissonReading.LITERAL), moduli_of(PoissonReading.LITERAL, None)
    assert own.material.G == 1.7
    np.testing.assert_allclose(follows.material.G, 6.23 / (2 * 1.488))
    # C44 = 1/s44 = G: it is G, or E_f / (2 (1 + nu)).
    assert own.stiffness_by("E_f")[4, 4] == pytest.approx(0, abs=1e-14)
    assert own.stiffness_by("G")[4, 4] == pytest.approx(1)
    assert follows.stiffness_by("E_f")[4, 4] == pytest.approx(1 / (2 * 1.488))


def test_tension_across_the_fibre_goes_with_the_ratio():
    # One element under uniaxial stress T across the fibre: strain e = T r / E_f, so at fixed strain
    # the modulus is E_f / r, and by the ratio -E_f / r^2; the other strains stay stress-free.
    moduli = moduli_of(PoissonReading.LITERAL)
    c, by = moduli.material.stiffness, moduli.stiffness_by("ratio")
    free = [0, 2, 3, 4, 5]

    def modulus(stiffness):
        inner = stiffness[np.ix_(free, free)]
        return stiffness[1, 1] - stiffness[1, free] @ np.linalg.solve(inner, stiffness[free, 1])

    assert modulus(c) == pytest.approx(6.23 / 2.651)
    # Differentiated along a small change of C; its second-order remainder is of the step's size.
    slope = (modulus(c + 1e-6 * by) - modulus(c - 1e-6 * by)) / 2e-6
    assert slope == pytest.approx(-6.23 / 2.651**2, rel=1e-7)


def test_what_cannot_be_differentiated_by_is_refused():
    with pytest.raises(InputError, match="G follows E_f here"):
        moduli_of(PoissonReading.LITERAL, None).stiffness_by("G")
    with pytest.raises(InputError, match="known: E_f, ratio, G"):
        moduli_of(PoissonReading.LITERAL).stiffness_by("nu")
    with pytest.raises(MaterialError, match=r"G = -1\.0 MPa"):
        BiotLaw.of_moduli([moduli_of(PoissonReading.LITERAL, -1.0)])


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("kind", ["E_f", "ratio", "G"])
def test_derivatives_of_the_stress_agree_with_differences_under_damping(reading, kind):
    rng = np.random.default_rng(3)
    green, previous = 0.1 * rng.standard_normal((2, 4, 3, 6))
    region = np.array([0, 1, 0, 1])
    both = [moduli_of(reading, None), moduli_of(reading)]
    value = getattr(both[1], kind)

    def stress(change):
        changed = replace(both[1], **{kind: value + change})
        law = BiotLaw.of_moduli([both[0], changed])
        return law.response(Points(green, region, previous, 2.0))[0]

    law = BiotLaw.of_moduli(both)
    exact = law.partial_stress(
        Parameter(f"{kind}.b", value),
        Points(green, region, previous, 2.0),
        which=1,
        stress=stress(0.0),
    )
    h = 1e-3 * value
    differences = [(stress(s) - stress(-s)) / (2 * s) for s in (4 * h, h)]
    best = (16 * differences[1] - differences[0]) / 15
    np.testing.assert_allclose(best, exact, rtol=0, atol=1e-7 * np.abs(exact).max())
    assert np.all(exact[region == 0] == 0)


def test_a_law_says_what_it_knows():
    law = BiotLaw.of_moduli([moduli_of(PoissonReading.LITERAL)])
    zeros = np.zeros((1, 1, 6))
    with pytest.raises(InputError, match=r"knows E_f\.REGION, ratio\.REGION, G\.REGION"):
        law.partial_stress(
            Parameter("field.a.0", 0.0),
            Points(zeros, np.zeros(1, int), zeros, 0.0),
            which=0,
            stress=zeros,
        )
