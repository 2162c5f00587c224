"""Fibres that bear tension only: moduli on both sides, energy, stress, tangent, derivatives."""

import numpy as np
import pytest
from scipy.integrate import quad

from mvest.errors import InputError, MaterialError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw, as_stiff, biaxial_stress
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import ExponentialTissue, TissueSettings

E_F, K, TOE, NU = 5.0, 0.05, 0.03, 0.488
TISSUE = TissueSettings(2.6, compression=K, toe=TOE)
MATERIAL = TISSUE.material(E_F)
LAW = BiotLaw.of([MATERIAL, TissueSettings(1.2).material(2.0)])
RNG = np.random.default_rng(5)
GREEN = RNG.uniform(-0.06, 0.06, (6, 3, 6))
# Below, in and beyond the toe.
GREEN[..., 0] = np.array([-0.05, -0.01, 0.01, 0.02, 0.05, 0.08])[:, None]
REGION, NONE = np.zeros(6, dtype=np.int64), np.zeros_like(GREEN)


def response(green, law=LAW, region=REGION):
    return law.response(Points(green, region, NONE, 0.0))


def along_the_fibres(strain):
    """Biot stress T_11, and T_22, under a contraction by NU across the fibres."""
    stretch = 1 + np.array([strain, -NU * strain, -NU * strain, 0, 0, 0])
    green = np.zeros((1, 1, 6))
    green[0, 0, :3] = 0.5 * (stretch[:3] ** 2 - 1)
    return (response(green, region=REGION[:1])[0][0, 0] * stretch)[:2]


@pytest.mark.parametrize("strain", [-0.2, -0.01])
def test_the_modulus_in_compression_is_the_share_of_E_f(strain):
    np.testing.assert_allclose(along_the_fibres(strain), [K * E_F * strain, 0], atol=1e-12)


@pytest.mark.parametrize("strain", [0.031, 0.1])
def test_beyond_the_toe_the_modulus_is_E_f(strain):
    # The toe delays the fibres by half of it.
    expected = E_F * (strain - (1 - K) * TOE / 2)
    np.testing.assert_allclose(along_the_fibres(strain), [expected, 0], atol=1e-12)


def test_the_matrix_is_positive_definite_and_other_leaflets_stay_linear():
    C, matrix = MATERIAL.stiffness, LAW.stiffness[0]
    assert np.linalg.eigvalsh(matrix).min() > 0
    assert np.linalg.det(matrix) / np.linalg.det(C) == pytest.approx(K)
    linear = BiotLaw.of([TissueSettings(1.2).material(2.0)])
    assert linear.fibres is None
    for ours, theirs in zip(
        response(GREEN, region=REGION + 1), response(GREEN, linear), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


def energy(green):
    """W (MPa) at one point, from its definition; the toe's energy by quadrature."""
    C = np.empty((3, 3))
    for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))):
        C[i, j] = C[j, i] = 1 + 2 * green[k] if i == j else green[k]
    values, vectors = np.linalg.eigh(C)
    eps = vectors @ np.diag(np.sqrt(values) - 1) @ vectors.T
    six = np.array([*np.diag(eps), 2 * eps[1, 2], 2 * eps[0, 2], 2 * eps[0, 1]])

    def force(e):
        return e - TOE / 2 if e >= TOE else e**3 / TOE**2 - e**4 / (2 * TOE**3)

    x = np.sqrt(C[0, 0]) - 1
    fibre = quad(force, 0, x, points=[min(x, TOE)], epsabs=1e-15)[0] if x > 0 else 0.0
    excess = (1 - K) * E_F
    whole = MATERIAL.stiffness
    return 0.5 * six @ whole @ six - 0.5 * excess * six[0] ** 2 + excess * fibre


def test_stress_and_tangent_are_derivatives_of_the_energy_to_second_order():
    stress, tangent = response(GREEN)
    direction = RNG.standard_normal(6)
    slopes, curves = [], []
    for h in (4e-4, 2e-4, 1e-4):
        up, down = (np.apply_along_axis(energy, 2, GREEN + s * h * direction) for s in (1, -1))
        slopes.append(np.abs((up - down) / (2 * h) - stress @ direction).max())
        up, down = (response(GREEN + s * h * direction)[0] for s in (1, -1))
        curves.append(np.abs((up - down) / (2 * h) - tangent @ direction).max())
    for errors in (slopes, curves):
        assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)
        assert errors[1] / errors[2] == pytest.approx(4, rel=0.2)


def test_derivatives_by_the_modulus_and_by_the_history():
    before = RNG.uniform(-0.05, 0.05, GREEN.shape)
    at = Points(GREEN, REGION, before, 0.7)
    stress = LAW.response(at)[0]
    softer, stiffer = (
        BiotLaw.of([TISSUE.material(E_F + h)]).response(at)[0] for h in (-1e-4, 1e-4)
    )
    by = LAW.partial_stress(Parameter("E_f.a", E_F), at, which=0, stress=stress)
    np.testing.assert_allclose(by, (stiffer - softer) / 2e-4, atol=1e-8)
    change = RNG.standard_normal(GREEN.shape)
    moved = LAW.response(at._replace(previous=before + change))[0] - stress
    np.testing.assert_allclose(LAW.history_stress(at, change), moved, atol=1e-11)


@pytest.mark.parametrize("prestretch", [1.0, 1.2])
def test_exponential_tissue_bears_what_linear_tissue_of_its_modulus_bears_when_closed(prestretch):
    linear = TissueSettings(2.6, prestretch=prestretch, prestretch_ratio=1.1)
    curve = as_stiff(ExponentialTissue(4e-5, 4.3, 900.0), linear, E_F)
    before = prestretch * np.array([1.0, 1.1])
    closed = np.array([[1.0, 1.11]])
    expected = biaxial_stress(BiotLaw.of([linear.material(E_F)]), closed).mean()
    # Per area of the imaged leaflet: force over length times thickness, of a constant volume.
    own = before * biaxial_stress(ExponentialLaw.of([curve]), before * closed)
    assert own.mean() == pytest.approx(expected)
    # All of its stress is proportional to the modulus.
    twice = as_stiff(ExponentialTissue(4e-5, 4.3, 900.0), linear, 2 * E_F)
    one, two = (ExponentialLaw.of([c] * 2) for c in (curve, twice))
    at = Points(0.5 * GREEN, REGION, NONE, 0.7)
    stress = one.response(at)[0]
    by = one.partial_stress(Parameter("E_f.a", E_F), at, which=0, stress=stress)
    np.testing.assert_allclose(by, (two.response(at)[0] - stress) / E_F, atol=1e-10)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"compression": 0.0}, InputError, "compression = 0.0, expected > 0"),
        ({"toe": -0.01}, InputError, "toe = -0.01, expected > 0"),
        ({"compression": 1.5}, MaterialError, "compression = 1.5 and toe = 0.02"),
        ({"compression": 0.5, "law": "corotational"}, InputError, "compression of a tissue: the"),
        ({"prestretch_ratio": 1.1, "law": "corotational"}, InputError, "prestretch_ratio of a tis"),
    ],
)
def test_inadmissible_fibres_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        TissueSettings(2.6, **change).material(E_F)
