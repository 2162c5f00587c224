"""Leaflets that are stretched as they were seen: against the law of the body free of stress."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw
from mvest.mechanics.law.regional import LeafletLaw, prestretch_map, relaxed_map
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import ExponentialTissue, TissueSettings

TISSUE = TissueSettings(2.6)
LINEAR = BiotLaw.of([TISSUE.material(5.0), TISSUE.material(2.0)])
EXPONENTIAL = ExponentialLaw.of([ExponentialTissue(0.06, 4.3, 900.0)] * 2)
RNG = np.random.default_rng(3)
GREEN = RNG.uniform(-0.08, 0.12, (8, 3, 6))
REGION = np.arange(8) % 2
PRESTRETCH, RATIO = np.array([1.06, 0.97]), np.array([1.1, 0.95])
TENSION = BiotLaw.of([replace(TISSUE, compression=0.05).material(E) for E in (5.0, 2.0)])
NONE = np.zeros_like(GREEN)


def prestretched(base=LINEAR, prestretch=PRESTRETCH, region=REGION):
    return LeafletLaw((base,), region, prestretch_map(np.asarray(prestretch), RATIO)[region, None])


def deformation(green):
    """F ``(e, q, 3, 3)``, symmetric, of strains with engineering shear."""
    C = np.zeros((*green.shape[:2], 3, 3))
    for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))):
        C[..., i, j] = C[..., j, i] = 1.0 + 2.0 * green[..., k] if i == j else green[..., k]
    values, vectors = np.linalg.eigh(C)
    return vectors @ (np.sqrt(values)[..., None] * np.swapaxes(vectors, -1, -2))


def six(tensor, shear):
    parts = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
    factor = [1.0, 1.0, 1.0, shear, shear, shear]
    return np.stack([f * tensor[..., i, j] for f, (i, j) in zip(factor, parts, strict=True)], -1)


def cauchy(F, S):
    """Six components of F S F^T / det F."""
    full = np.empty((*S.shape[:2], 3, 3))
    for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))):
        full[..., i, j] = full[..., j, i] = S[..., k]
    J = np.linalg.det(F)[..., None, None]
    return six(F @ full @ np.swapaxes(F, -1, -2) / J, 1.0)


@pytest.mark.parametrize("base", [LINEAR, TENSION, EXPONENTIAL])
def test_cauchy_stress_is_that_of_the_whole_deformation(base):
    # By tensors, from the deformation of the body that is free of stress.
    F = deformation(GREEN)
    stretch = PRESTRETCH[REGION]
    G = np.zeros((8, 1, 3, 3))
    G[:, 0, 0, 0], G[:, 0, 1, 1] = stretch, stretch * RATIO[REGION]
    G[:, 0, 2, 2] = 1 / (stretch**2 * RATIO[REGION])
    whole = F @ G
    green = six(0.5 * (np.swapaxes(whole, -1, -2) @ whole - np.eye(3)), 2.0)
    S0 = base.response(Points(green, REGION, NONE, 0.0))[0]
    S = prestretched(base).response(Points(GREEN, REGION, NONE, 0.0))[0]

    expected = cauchy(whole, S0)
    np.testing.assert_allclose(cauchy(F, S), expected, atol=1e-12 * np.abs(expected).max())


def test_at_rest_it_pulls_and_damping_does_not():
    law = prestretched()
    rest = law.strain(NONE)
    assert np.abs(rest).max() > 0.02
    damped = law.response(Points(NONE, REGION, rest, 0.7))[0]
    still = law.response(Points(NONE, REGION, rest, 0.0))[0]
    np.testing.assert_allclose(damped, still, atol=1e-12)
    longer = REGION == 0
    assert np.all(still[longer][..., :2] > 0)
    assert np.all(still[~longer][..., :2] < 0)


@pytest.mark.parametrize("base", [LINEAR, TENSION, EXPONENTIAL])
def test_derivatives_agree_with_differences(base):
    law, rate, h = prestretched(base), 0.7, 1e-6
    previous = law.strain(0.5 * GREEN)

    def stress(green=GREEN, before=previous, own=law):
        return own.response(Points(green, REGION, before, rate))[0]

    tangent = law.response(Points(GREEN, REGION, previous, rate))[1]
    for i in range(6):
        step = h * np.eye(6)[i]
        by = (stress(GREEN + step) - stress(GREEN - step)) / (2 * h)
        np.testing.assert_allclose(tangent[..., i], by, atol=1e-6 * np.abs(tangent).max())
    change = RNG.standard_normal(GREEN.shape)
    by = (stress(before=previous + h * change) - stress(before=previous - h * change)) / (2 * h)
    found = law.history_stress(Points(GREEN, REGION, GREEN, rate), change)
    np.testing.assert_allclose(found, by, atol=1e-7 * np.abs(by).max())
    by = (law.strain(GREEN + h * change) - law.strain(GREEN - h * change)) / (2 * h)
    np.testing.assert_allclose(law.strain_change(GREEN, change), by, atol=1e-7 * np.abs(by).max())


@pytest.mark.parametrize("base", [LINEAR, TENSION, EXPONENTIAL])
@pytest.mark.parametrize("which", [0, 1])
def test_derivative_by_a_prestretch_agrees_with_differences(base, which):
    h = 1e-6

    def stress(step):
        moved = PRESTRETCH + step * np.eye(2)[which]
        return prestretched(base, moved).response(Points(GREEN, REGION, NONE, 0.0))[0]

    by = (stress(h) - stress(-h)) / (2 * h)
    law = prestretched(base)
    name = Parameter("prestretch.anterior", PRESTRETCH[which])
    given = {"which": which, "stress": stress(0.0)}
    found = law.partial_stress(name, Points(GREEN, REGION, NONE, 0.0), **given)
    np.testing.assert_allclose(found, by, atol=1e-6 * np.abs(by).max())
    assert not found[which != REGION].any()
    with pytest.raises(InputError, match="at an equilibrium only"):
        law.partial_stress(name, Points(GREEN, REGION, NONE, 0.7), **given)


def test_a_relaxed_shape_is_free_of_stress_and_the_cauchy_stress_is_that_from_it():
    relaxed = RNG.uniform(-0.05, 0.08, GREEN.shape)
    own, volume = relaxed_map(relaxed)
    law = LeafletLaw((LINEAR,), REGION, own, volume)
    at_rest = law.response(Points(relaxed, REGION, NONE, 0.0))[0]
    assert np.abs(at_rest).max() < 1e-12
    # By tensors: F = deformation(GREEN) from the imaged shape, F U^-1 from the relaxed one.
    F, U = deformation(GREEN), deformation(relaxed)
    whole = F @ np.linalg.inv(U)
    green = six(0.5 * (np.swapaxes(whole, -1, -2) @ whole - np.eye(3)), 2.0)
    expected = cauchy(whole, LINEAR.response(Points(green, REGION, NONE, 0.0))[0])
    found = cauchy(F, law.response(Points(GREEN, REGION, NONE, 0.0))[0])
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
    # Its tangent, and a modulus, through the map.
    h, tangent = 1e-6, law.response(Points(GREEN, REGION, NONE, 0.0))[1]
    for i in range(6):
        up, down = (
            law.response(Points(GREEN + sign * h * np.eye(6)[i], REGION, NONE, 0.0))[0]
            for sign in (1, -1)
        )
        np.testing.assert_allclose(
            tangent[..., i], (up - down) / (2 * h), atol=1e-6 * np.abs(tangent).max()
        )
    stress = law.response(Points(GREEN, REGION, NONE, 0.0))[0]
    by = law.partial_stress(
        Parameter("E_f.a", 5.0), Points(GREEN, REGION, NONE, 0.0), which=0, stress=stress
    )
    expected = np.where((REGION == 0)[:, None, None], stress / 5.0, 0.0)
    np.testing.assert_allclose(by, expected, atol=1e-12)
