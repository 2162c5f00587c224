"""The exponential law: its derivatives, its limits and the curves that can be had by hand."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import MaterialError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import MAX_EXPONENT, ExponentialLaw, biaxial_stress
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import ExponentialTissue

TISSUES = (ExponentialTissue(0.06, 4.3, 900.0), ExponentialTissue(0.04, 4.8, 305.0, kappa=2.0))
LAW = ExponentialLaw.of(TISSUES)
RNG = np.random.default_rng(3)
GREEN = RNG.uniform(-0.12, 0.2, (10, 3, 6))
REGION = np.arange(10) % 2
PREVIOUS = RNG.uniform(-0.1, 0.1, GREEN.shape)
NONE = np.zeros_like(GREEN)


def stress(law, green=GREEN, region=REGION, previous=NONE, rate=0.0):
    return law.response(Points(green, region, previous, rate))[0]


def energy(green):
    """W ``(10, 3)`` MPa of the docstring of `mvest.mechanics.law.exponential`."""
    C = np.eye(3) + green[..., [[0, 5, 4], [5, 1, 3], [4, 3, 2]]] * (1 + np.eye(3))
    J2 = np.linalg.det(C)
    c0, c1, c2, mu, kappa, _ = LAW.coefficients[REGION].T[..., None]
    a = np.trace(C, axis1=-2, axis2=-1) * J2 ** (-1 / 3) - 3
    x = np.maximum(np.sqrt(C[..., 0, 0]) - 1, 0)
    exponential = c0 * np.expm1(c1 * a**2 + c2 * x**4)
    return exponential + 0.5 * mu * a + 0.25 * kappa * (J2 - 1 - np.log(J2))


def fourth_order(function, h):
    """Central difference without its h^2 error: (16 D(h/4) - D(h)) / 15."""
    coarse, fine = ((function(s) - function(-s)) / (2 * s) for s in (h, h / 4))
    return (16 * fine - coarse) / 15


def test_stress_is_the_derivative_of_the_energy_and_the_tangent_that_of_the_stress():
    # Fibres in tension and in compression, and shear of every kind, are among the strains.
    assert GREEN[..., 0].min() < -0.05 < 0.05 < GREEN[..., 0].max()
    found, tangent = LAW.response(Points(GREEN, REGION, NONE, 0.0))
    for i in range(6):
        e = np.eye(6)[i]
        by_energy = fourth_order(lambda s, e=e: energy(GREEN + s * e), 2e-3)
        by_stress = fourth_order(lambda s, e=e: stress(LAW, GREEN + s * e), 2e-3)
        np.testing.assert_allclose(by_energy, found[..., i], atol=1e-7 * np.abs(found).max())
        np.testing.assert_allclose(by_stress, tangent[..., i], atol=1e-7 * np.abs(tangent).max())
    np.testing.assert_array_equal(tangent, np.swapaxes(tangent, 2, 3))


def test_damping_is_in_the_tangent_and_in_the_change_of_history():
    rate = 0.7
    _, tangent = LAW.response(Points(GREEN, REGION, PREVIOUS, rate))
    direction = RNG.standard_normal(GREEN.shape)
    by_strain = fourth_order(
        lambda s: stress(LAW, GREEN + s * direction, REGION, PREVIOUS, rate), 2e-4
    )
    expected = np.einsum("eqij,eqj->eqi", tangent, direction)
    np.testing.assert_allclose(by_strain, expected, atol=1e-7 * np.abs(expected).max())
    # Linear in the previous strain: any step is exact.
    by_history = stress(LAW, GREEN, REGION, PREVIOUS + direction, rate) - stress(
        LAW, GREEN, REGION, PREVIOUS, rate
    )
    np.testing.assert_allclose(
        LAW.history_stress(Points(GREEN, REGION, GREEN, rate), direction), by_history, atol=1e-12
    )
    np.testing.assert_array_equal(LAW.strain_change(GREEN, direction), direction)


@pytest.mark.parametrize("kind", ["c0", "c1", "c2", "mu", "kappa"])
def test_derivatives_by_the_coefficients(kind):
    which = 1
    value = getattr(TISSUES[which], kind)

    def at(relative):
        tissues = list(TISSUES)
        tissues[which] = replace(TISSUES[which], **{kind: value * (1 + relative)})
        return stress(ExponentialLaw.of(tuple(tissues)))

    exact = by_parameter(f"{kind}.leaflet", which)
    difference = fourth_order(at, 4e-3) / value
    np.testing.assert_allclose(difference, exact, atol=1e-8 * np.abs(exact).max())
    assert np.all(exact[which != REGION] == 0)
    taut = (which == REGION)[:, None] & (GREEN[..., 0] > 0)
    assert np.abs(exact).max(axis=-1)[taut].min() > 0


def by_parameter(name, which):
    return LAW.partial_stress(
        Parameter(name, 1.0), Points(GREEN, REGION, PREVIOUS, 0.7), which=which, stress=NONE
    )


def test_at_rest_there_is_no_stress_and_the_stiffness_of_ground_and_penalty():
    # The exponential starts with the fourth power of the strain, so that mu and kappa alone are
    # left: lambda = kappa - 2 mu / 3, as in isotropic elasticity.
    rest = np.zeros((2, 1, 6))
    found, tangent = LAW.response(Points(rest, np.array([0, 1]), rest, 0.0))
    np.testing.assert_array_equal(found, 0.0)
    for tissue, d in zip(TISSUES, tangent[:, 0], strict=True):
        expected = np.zeros((6, 6))
        expected[:3, :3] = tissue.kappa - 2 * tissue.mu / 3
        expected += tissue.mu * np.diag([2, 2, 2, 1, 1, 1])
        np.testing.assert_allclose(d, expected, atol=1e-12)
        assert np.linalg.eigvalsh(d).min() > 0


def test_far_beyond_tissue_the_law_stays_finite_and_smooth():
    # Fibres at twice their length would give e^900. Either side of the last exponent, stress and
    # tangent are the same.
    limit = 1 + (MAX_EXPONENT / 900.0) ** 0.25
    green = np.zeros((3, 1, 6))
    green[:, 0, 0] = 0.5 * (np.array([limit - 1e-9, limit + 1e-9, 2.0]) ** 2 - 1)
    # The other stretches keep the isochoric invariant where its share of Q is zero: c1 = 0.
    law = ExponentialLaw.of((ExponentialTissue(0.06, 0.0, 900.0),))
    found, tangent = law.response(Points(green, np.zeros(3, dtype=int), np.zeros_like(green), 0.0))
    assert np.isfinite(found).all()
    assert np.isfinite(tangent).all()
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)
    np.testing.assert_allclose(tangent[0], tangent[1], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c0": 0.0}, "c0 = 0.0 of the exponential law, expected > 0"),
        ({"c1": -1.0}, "c1 = -1.0 .* expected >= 0"),
    ],
)
def test_inadmissible_coefficients_are_rejected_with_their_values(change, message):
    with pytest.raises(MaterialError, match=message):
        replace(TISSUES[0], **change)


def incompressible(tissue, stretches):
    """Nominal stresses of a sheet of constant volume.

    From W(l1, l2) with I1 = l1^2 + l2^2 + 1 / (l1 l2)^2: P_i = dW/dl_i, where dI1/dl1 is
    2 (l1 - 1 / (l1^3 l2^2)), and the same with 1 and 2 exchanged.
    """
    l1, l2 = stretches.T
    a = l1**2 + l2**2 + (l1 * l2) ** -2.0 - 3
    x = np.maximum(l1 - 1, 0)
    scale = tissue.c0 * np.exp(tissue.c1 * a**2 + tissue.c2 * x**4)
    shared = scale * 2 * tissue.c1 * a + tissue.mu / 2
    along = shared * 2 * (l1 - l1**-3.0 * l2**-2.0) + scale * 4 * tissue.c2 * x**3
    return np.column_stack([along, shared * 2 * (l2 - l2**-3.0 * l1**-2.0)])


CURVES = {
    "both": np.array([[1.06, 1.06], [1.1, 1.1]]),
    "slack": np.array([[0.92, 1.15]]),
}


@pytest.mark.parametrize("curve", ["both", "slack"])
def test_biaxial_stress_tends_to_the_formula_of_constant_volume(curve):
    # The volume changes by about stress / kappa: ten times the penalty, a tenth of the error.
    expected = incompressible(TISSUES[0], CURVES[curve])
    errors = [
        np.abs(
            biaxial_stress(ExponentialLaw.of((replace(TISSUES[0], kappa=k),)), CURVES[curve])
            - expected
        ).max()
        for k in (1e3, 1e4)
    ]
    assert errors[0] < 2e-3 * np.abs(expected).max()
    assert errors[0] / errors[1] == pytest.approx(10, rel=0.05)


def test_biaxial_stress_of_the_linear_law():
    # Plane stress of the Biot law: T = Q (l - 1), Q = [[E_f, nu E_p], [nu E_p, E_p]] / (1 - nu^2
    # E_p / E_f), and P = T where stretches lie along the axes.
    material = TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.LITERAL)
    e_f, e_p, nu = material.E_f, material.E_p, material.nu_fp
    plane = np.array([[e_f, nu * e_p], [nu * e_p, e_p]]) / (1 - nu**2 * e_p / e_f)
    stretches = np.array([[1.05, 1.02], [0.98, 1.1]])
    found = biaxial_stress(BiotLaw.of((material,)), stretches)
    np.testing.assert_allclose(found, (stretches - 1) @ plane, rtol=1e-9)
