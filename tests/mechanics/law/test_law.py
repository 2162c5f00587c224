"""The law: which moduli are admissible, and that it gives back the moduli it was made of."""

import numpy as np
import pytest

from mvest.errors import MaterialError
from mvest.mechanics.forces.cables import Hinge
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.mechanics.solid import Solid
from mvest.mechanics.steps import NewtonSettings, Step
from mvest.mechanics.system import Loads, System
from tests.mechanics.bodies import ELEMENT_NAMES, MATERIALS, block, point_masses, rotation

READING_A, READING_C = PoissonReading.LITERAL, PoissonReading.NEARLY_INCOMPRESSIBLE
ANTERIOR, POSTERIOR = (6.23, 2.35, 2.09), (2.09, 1.89, 0.70)


@pytest.mark.parametrize(
    ("E_f", "ratio", "reading", "bulk"),
    [
        (6.23, 6.23 / 2.35, READING_A, 1.5),
        (2.09, 2.09 / 1.89, READING_C, 14.4),
    ],
)
def test_bulk_modulus_of_both_readings(E_f, ratio, reading, bulk):
    # Under uniform pressure p the volume changes by -p sum_ij S_ij (i, j <= 3), so K = 1 / sum S.
    material = TransverselyIsotropic.from_ratio(E_f, ratio, 0.488, reading)
    modulus = 1 / material.compliance[:3, :3].sum()
    assert modulus / material.E_p == pytest.approx(bulk, abs=0.06)
    assert np.linalg.eigvalsh(material.stiffness).min() > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"E_f": 0.0}, "E_f = 0.0 MPa, expected > 0"),
        ({"G": float("nan")}, "G = nan MPa"),
        ({"nu_pp": 1.0}, "nu_pp = 1.0, expected -1 < nu_pp < 1"),
        ({"nu_fp": float("nan")}, "not positive definite"),
    ],
)
def test_inadmissible_moduli_are_rejected_with_their_values(change, message):
    values = {"E_f": 6.23, "E_p": 2.35, "G": 2.09, "nu_fp": 0.488, "nu_pp": 0.488} | change
    with pytest.raises(MaterialError, match=message):
        TransverselyIsotropic(**values)


def stretched(mesh, material, stress, expected):
    """Deformation gradient of a body under the nominal stress P ``(3, 3)`` on its whole surface.

    Nodal loads of tractions P N on the surface are ``f_a = int P grad N_a dV`` by the divergence
    theorem. Springs at three corners hold the rigid motions; their ends are where the `expected`
    Biot strain puts the corners, so that they are slack if, and only if, the moduli come out right.
    """
    reference = mesh.reference
    x_e = mesh.nodes[mesh.elements]
    derivative = reference.gradient(reference.points)
    jacobian = np.einsum("eai,qaj->eqij", x_e, derivative)
    gradient = np.einsum("qaj,eqji->eqai", derivative, np.linalg.inv(jacobian))
    volume = np.linalg.det(jacobian) * reference.weights
    loads = np.zeros_like(mesh.nodes)
    np.add.at(loads, mesh.elements, np.einsum("ij,eqaj,eq->eai", stress, gradient, volume))
    corners = [int(np.argmin(mesh.nodes @ d)) for d in ([1, 1, 1], [-3, 1, 1], [1, -3, 1])]
    points = point_masses(len(mesh.nodes))
    hold = type(points)(points.nodes[corners], points.weights[corners], points.host[corners])
    system = System(Solid(mesh, BiotLaw.of((material,))), hinge=Hinge(hold, np.full(3, 1e-3)))
    target = mesh.nodes[corners] @ (np.eye(3) + expected)
    result = simulate(
        system,
        lambda t: Loads(body_force=loads, hinge=target),
        [Step(1.0, static=True)],
        newton=NewtonSettings(tolerance=1e-12),
    )
    assert result.converged
    x = result.frames[-1] - result.frames[-1].mean(axis=0)
    centred = mesh.nodes - mesh.nodes.mean(axis=0)
    f = np.linalg.lstsq(centred, x, rcond=None)[0].T
    np.testing.assert_allclose(x, centred @ f.T, atol=1e-9)  # homogeneous
    return f


def principal(f):
    """Biot strain U - I of a deformation gradient."""
    values, vectors = np.linalg.eigh(f.T @ f)
    return vectors @ np.diag(np.sqrt(values)) @ vectors.T - np.eye(3)


@pytest.mark.parametrize("element_type", ELEMENT_NAMES)
@pytest.mark.parametrize(("angle", "reading"), [(0.0, "C"), (0.7, "A")])
def test_tension_along_the_fibre_recovers_E_f_and_nu_fp(element_type, angle, reading):
    # Uniaxial tension: F = U is diagonal in the fibre frame, P = T (Biot), so that
    # T_11 = E_f (lambda - 1) exactly and the other strains are -nu_fp (lambda - 1), at any stretch.
    material, q = MATERIALS[reading], rotation((0, 0, 1), angle)
    mesh = block(element_type, (2, 2, 1), fibre=q[:, 0], distortion=(0.2, 0.2, 0))
    stress = 0.6
    expected = q @ np.diag([1, -0.488, -0.488]) @ q.T * stress / 6.23
    loaded = stretched(mesh, material, q @ np.diag([stress, 0, 0]) @ q.T, expected)
    strain = q.T @ principal(loaded) @ q
    assert stress / strain[0, 0] == pytest.approx(6.23, rel=1e-6)
    assert -strain[1, 1] / strain[0, 0] == pytest.approx(0.488, rel=1e-6)
    assert -strain[2, 2] / strain[0, 0] == pytest.approx(0.488, rel=1e-6)


@pytest.mark.parametrize("element_type", ["hex18", "tet10"])
@pytest.mark.parametrize("reading", ["A", "C"])
def test_tension_across_the_fibre_recovers_E_p(element_type, reading):
    # T_22 = E_p (lambda - 1); contraction nu_pp across and nu_fp E_p / E_f along the fibre.
    material = MATERIALS[reading]
    expected = np.diag([-0.488 / 2.651, 1, -material.nu_pp]) * 0.3 / material.E_p
    mesh = block(element_type, (2, 2, 1))
    strain = principal(stretched(mesh, material, np.diag([0, 0.3, 0.0]), expected))
    assert 0.3 / strain[1, 1] == pytest.approx(material.E_p, rel=1e-6)
    assert -strain[2, 2] / strain[1, 1] == pytest.approx(material.nu_pp, rel=1e-6)
    assert -strain[0, 0] / strain[1, 1] == pytest.approx(0.488 / 2.651, rel=1e-6)


def mean_stress(mesh, material, f):
    """Mean nominal stress P of the deformation F: ``V P = sum_a f_a x X_a`` (virial theorem)."""
    solid = Solid(mesh, BiotLaw.of((material,)))
    state = solid.evaluate(mesh.nodes @ f.T, solid.initial_strain(), 0.0)
    moment = np.einsum("eai,eaj->ij", solid.forces(state), mesh.nodes[mesh.elements])
    return moment / solid.volumes.sum()


@pytest.mark.parametrize("element_type", ELEMENT_NAMES)
@pytest.mark.parametrize("plane", [(0, 1), (0, 2), (1, 2)])
def test_shear_recovers_G(element_type, plane):
    # Pure shear U = I + g/2 (e_i e_j + e_j e_i): the Biot strain is g/2 off the diagonal, the
    # stress G g commutes with U, so P_ij = G g exactly. Simple shear F = I + g e_i e_j gives the
    # same up to the square of g (its rotation and normal strains are of higher order).
    material, mesh = MATERIALS["A"], block(element_type, (2, 2, 1), distortion=(0.2, 0.2, 0))
    i, j = plane
    expected = material.G if i == 0 else material.E_p / (2 * (1 + material.nu_pp))
    simple = np.zeros((3, 3))
    simple[i, j] = 1.0
    pure = 0.5 * (simple + simple.T)
    stress = mean_stress(mesh, material, np.eye(3) + 0.2 * pure)
    assert stress[i, j] / 0.2 == pytest.approx(expected, rel=1e-9)
    errors = [
        abs(mean_stress(mesh, material, np.eye(3) + g * simple)[i, j] / g / expected - 1)
        for g in (4e-2, 2e-2, 5e-4)
    ]
    assert errors[2] < 1e-6
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)


def energy(law, green):
    e = law.strain(green)
    return 0.5 * np.einsum("eqi,ij,eqj->eq", e, law.stiffness[0], e)


def test_stress_is_the_derivative_of_the_energy_also_for_coinciding_stretches():
    law = BiotLaw.of((MATERIALS["A"],))
    green = np.random.default_rng(0).uniform(-0.15, 0.15, (4, 3, 6))
    green[0, 0] = 0.0  # three equal stretches
    green[0, 1] = [0.1, 0.1, 0.0, 0, 0, 0]  # two equal
    region = np.zeros(4, dtype=int)
    stress, _ = law.response(Points(green, region, np.zeros_like(green), 0.0))
    errors = []
    for h in (1e-2, 5e-3):
        difference = np.empty_like(stress)
        for i in range(6):
            step = h * np.eye(6)[i]
            difference[..., i] = (energy(law, green + step) - energy(law, green - step)) / (2 * h)
        errors.append(np.abs(difference - stress).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)


def test_biot_strain_is_the_square_root_of_the_deformation():
    law = BiotLaw.of((MATERIALS["A"],))
    f = np.eye(3) + np.random.default_rng(1).uniform(-0.3, 0.3, (3, 3))
    g = 0.5 * (f.T @ f - np.eye(3))
    six = np.array([g[0, 0], g[1, 1], g[2, 2], 2 * g[1, 2], 2 * g[0, 2], 2 * g[0, 1]])
    e = principal(f)
    np.testing.assert_allclose(
        law.strain(six[None, None])[0, 0],
        [e[0, 0], e[1, 1], e[2, 2], 2 * e[1, 2], 2 * e[0, 2], 2 * e[0, 1]],
        atol=1e-14,
    )
