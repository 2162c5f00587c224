"""A second biomechanical model, a closed formula, in the place of the finite-element one.

A clamped circular plate under uniform pressure q, large deflections (Timoshenko and
Woinowsky-Krieger, Theory of Plates and Shells, 2nd ed. 1959, section 97, for Poisson's ratio 0.3):
the deflection w0 of the centre solves w0 (1 + 0.488 w0²/h²) = q a⁴/(64 D) with the stiffness
D = E h³/(12 (1 - 0.3²)), and w(r) = w0 (1 - r²/a²)². Bending grows like h³ and stretching like h,
so that several pressures tell the modulus E from the thickness h. A scale of the pressure enters
only as pressure/E: these two cannot be told apart, whatever is observed.
"""

import numpy as np
import pytest

from mvest.estimation import (
    Gaussian,
    IteratedFilter,
    Log,
    PaperFilter,
    Prediction,
    identifiability,
)
from tests.estimation.problems import bound

RADIUS = 10.0  # mm
PRESSURES = np.array([0.001, 0.004, 0.016])  # MPa, the last about 120 mmHg
SHAPE = (1.0 - np.linspace(0.0, 0.9, 10) ** 2) ** 2
TRUTH = np.array([6.23, 1.32])  # MPa, mm
PRIOR = Gaussian(np.array([5.0, 1.2]), np.array([[4.0, 0.2], [0.2, 0.04]]))


def centre_deflection(E, h, q):
    """The only real root of w + 0.488 w³/h² = c q/(E h³), and its derivatives in E, h and q."""
    c = 12.0 * (1.0 - 0.3**2) * RADIUS**4 / 64.0
    load = c * q / (E * h**3)
    # Cardano for w³ + p w + r = 0 with p > 0: one real root.
    p, r = h**2 / 0.488, -load * h**2 / 0.488
    s = np.sqrt(r**2 / 4.0 + p**3 / 27.0)
    w = np.cbrt(-r / 2.0 + s) + np.cbrt(-r / 2.0 - s)
    slope = 1.0 + 1.464 * w**2 / h**2
    dw_dE = -load / E / slope
    dw_dh = (0.976 * w**3 / h**3 - 3.0 * load / h) / slope
    dw_dq = load / q / slope
    return w, dw_dE, dw_dh, dw_dq


def plate(m):
    """Deflections (mm) at ten radii under three pressures from m = (E, h)."""
    E, h = m
    if E <= 0.0 or h <= 0.0:
        return Prediction.failed(f"E = {E:g} MPa and h = {h:g} mm must be positive")
    w, dw_dE, dw_dh, _ = centre_deflection(E, h, PRESSURES)
    columns = [np.outer(d, SHAPE).ravel() for d in (dw_dE, dw_dh)]
    return Prediction(np.outer(w, SHAPE).ravel(), np.column_stack(columns))


def scaled_pressure_jacobian(E, h):
    """Jacobian in (E, pressure scale) at scale 1."""
    _, dw_dE, _, dw_dq = centre_deflection(E, h, PRESSURES)
    return np.column_stack([np.outer(d, SHAPE).ravel() for d in (dw_dE, dw_dq * PRESSURES)])


def test_the_plate_solves_its_equation():
    E, h = TRUTH
    w = plate(TRUTH).y.reshape(3, 10)[:, 0]
    D = E * h**3 / (12 * 0.91)
    np.testing.assert_allclose(w * (1 + 0.488 * (w / h) ** 2), PRESSURES * RADIUS**4 / (64 * D))
    assert not plate(-TRUTH).converged
    step = 1e-6
    for i, d in enumerate(step * np.eye(2)):
        difference = (plate(TRUTH + d).y - plate(TRUTH - d).y) / (2 * step)
        np.testing.assert_allclose(plate(TRUTH).jacobian[:, i], difference, rtol=1e-7)


@pytest.mark.parametrize("transform", [None, Log()])
@pytest.mark.parametrize(
    "method", [PaperFilter(Q=np.array([0.01, 1e-4])), IteratedFilter()], ids=["paper", "iterated"]
)
def test_both_modes_recover_the_truth(method, transform):
    # Deflections to 1 µm: the prior's weight is 1e-5 of the data's and the truth is found.
    estimate = method(
        plate, PRIOR, plate(TRUTH).y, 1e-6, names=["E", "thickness"], transform=transform
    )
    assert estimate.converged
    np.testing.assert_allclose(estimate.mean, TRUTH, rtol=1e-4)
    assert estimate.forward_solves <= 10
    residual = plate(TRUTH).y - estimate.prediction.y
    assert np.max(np.abs(residual)) < 1e-4
    if isinstance(method, IteratedFilter) and transform is None:
        # The covariance is the Cramér-Rao bound with the prior, at the estimate.
        least = bound(estimate.prediction.jacobian, 1e-6, PRIOR)
        np.testing.assert_allclose(estimate.covariance, least, rtol=1e-7)


def test_modulus_and_thickness_are_correlated():
    # Without a prior, the bound is the inverse of H'R^-1 H at the truth.
    H = plate(TRUTH).jacobian
    np.testing.assert_allclose(bound(H, 0.01), 0.01 * np.linalg.inv(H.T @ H), rtol=1e-9)
    report = identifiability(plate(TRUTH).jacobian, 0.01**2, TRUTH, names=["E", "thickness"])
    # More thickness and less modulus deflect nearly alike.
    assert report.correlation[0, 1] < -0.9
    assert 10.0 < report.condition_number < 1e6
    assert report.flat() == ()
    # With noise of 0.1 mm the worst combination is not known to half its size any more: it goes
    # from more E and less h to the reverse, and the report says so.
    blurred = identifiability(plate(TRUTH).jacobian, 0.1**2, TRUTH, names=["E", "thickness"])
    (words,) = blurred.flat()
    assert words == "0.93 E -0.37 thickness: known to ±62.2 %"


def test_modulus_and_pressure_cannot_be_told_apart():
    # w depends on q/E only: the relative combination (E, q) = (1, 1)/sqrt 2 changes nothing.
    E, h = TRUTH
    H = scaled_pressure_jacobian(E, h)
    report = identifiability(H, 0.01, np.array([E, 1.0]), names=["E", "pressure_scale"])
    assert report.flat() in (
        ("0.71 E +0.71 pressure_scale: not determined at all",),
        ("0.71 pressure_scale +0.71 E: not determined at all",),
    )
    assert report.condition_number == np.inf
    assert np.all(np.isinf(report.std))
    assert np.all(np.isnan(report.correlation))
    # A prior of 10 % on the pressure makes the modulus known to no better than 10 %.
    prior = Gaussian(np.array([E, 1.0]), np.diag([100.0**2, 0.1**2]))
    known = identifiability(H, 1e-6, np.array([E, 1.0]), prior=prior)
    assert known.std[0] / E == pytest.approx(0.1, rel=1e-2)
    assert known.correlation[0, 1] == pytest.approx(1.0, abs=1e-3)


def test_identifiability_by_hand():
    # H = diag(2, 1), R = 1/4: information diag(16, 4), standard deviations 1/4 and 1/2. In units of
    # (10, 1): 1600 and 4, the worst combination is the second parameter.
    report = identifiability(np.diag([2.0, 1.0]), 0.25, np.array([10.0, 1.0]))
    np.testing.assert_allclose(report.std, [0.25, 0.5])
    np.testing.assert_allclose(report.eigenvalues, [4.0, 1600.0])
    np.testing.assert_allclose(np.abs(report.eigenvectors[:, 0]), [0.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(report.information, np.diag([1600.0, 4.0]), atol=1e-10)
    assert report.condition_number == pytest.approx(400.0)
    # A parameter that is seen stays known beside one that is not.
    blind = identifiability(np.array([[2.0, 0.0], [0.0, 0.0]]), 1.0, np.ones(2))
    assert blind.std[0] == pytest.approx(0.5)
    assert blind.std[1] == np.inf
