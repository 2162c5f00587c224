"""How tissue resists: strips with known shares, and derivatives that add up from their parts."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.resistance import (
    WAYS,
    has_one_layer,
    information_shares,
    sensitivity_parts,
    split,
    thickness_mean,
    work_shares,
)
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import linear_solver
from mvest.mechanics.steps import Step
from mvest.mechanics.system import Loads, System
from tests.mechanics.bodies import MATERIALS, block, sandwich

LENGTH, WIDTH, THICKNESS = 6.0, 2.0, 0.5
TENSION, COMPRESSION, ACROSS, BENDING = range(4)


def strip(force, moment, element="hex18", fibre=(1, 0, 0)):
    """A strip in equilibrium under a dead force and couple at its end: system, loads, positions.

    Its other end can shrink freely. The stress is force over area plus a part linear in z.
    """
    mesh = block(element, (6, 2, 1), (LENGTH, WIDTH, THICKNESS), fibre)
    x, y, z = mesh.nodes.T
    held = np.zeros(mesh.nodes.shape, dtype=bool)
    held[:, 0] = x == 0
    held[(x == 0) & (y == 0.5 * WIDTH), 1] = True
    held[(x == 0) & (y == 0.5 * WIDTH) & (z == 0), 2] = True
    # Simpson's rule in two cells across the width, half on each face.
    weight = np.select([np.isin(y, (0, WIDTH)), y == 0.5 * WIDTH], [1 / 12, 2 / 12], 4 / 12)
    side = np.where(z == 0, 0.5 * force - moment / THICKNESS, 0.5 * force + moment / THICKNESS)
    dead = np.zeros(mesh.nodes.shape)
    dead[:, 0] = np.where(x == LENGTH, weight * side, 0.0)
    law = BiotLaw.of((MATERIALS["A"],))
    system, loads = System(Solid(mesh, law), fixed_components=held), Loads(body_force=dead)
    ends = simulate(system, lambda t: loads, [Step(1.0, static=True)])
    assert ends.converged
    return system, loads, ends.frames[-1]


def information(system, loads, x):
    parts = sensitivity_parts(system, x, loads, [Parameter("E_f.tissue", 6.23)], linear_solver())
    return information_shares(parts.reshape(1, len(WAYS), -1))[0]


def test_a_pulled_strip_is_known_by_tension_alone():
    pulled = strip(0.2, 0.0)
    for shares in (information(*pulled), work_shares(pulled[0], pulled[2])[0]):
        assert shares == pytest.approx([1, 0, 0, 0], abs=1e-6)


def test_a_pushed_strip_is_known_by_compression_alone():
    pushed = strip(-0.01, 0.0)
    assert information(*pushed) == pytest.approx([0, 1, 0, 0], abs=1e-6)


def test_a_strip_pulled_across_its_fibres_says_so():
    across = strip(0.05, 0.0, fibre=(0, 1, 0))
    assert work_shares(across[0], across[2])[0] == pytest.approx([0, 0, 1, 0], abs=1e-6)
    assert information(*across) == pytest.approx([0, 0, 1, 0], abs=1e-6)


def test_a_bent_strip_is_known_by_bending_alone():
    bent = strip(0.0, 1e-5)
    assert work_shares(bent[0], bent[2])[0, BENDING] == pytest.approx(1.0, abs=1e-6)
    assert information(*bent)[BENDING] == pytest.approx(1.0, abs=1e-6)


def test_a_strip_pulled_off_its_middle_has_the_energy_of_a_beam():
    # Per length N^2 / 2 E A and M^2 / 2 E I, with I / A = t^2 / 12: at an eccentricity of a sixth
    # of the thickness a third as much in bending as in tension. The deflection is far too small to
    # change the lever of the force.
    force = 1e-7
    system, loads, x = strip(force, force * THICKNESS / 6)
    assert work_shares(system, x)[0] == pytest.approx([0.75, 0, 0, 0.25], abs=1e-4)
    assert information(system, loads, x).sum() == pytest.approx(1.0, abs=1e-12)


def test_the_parts_of_a_derivative_add_up_to_it():
    system, loading = sandwich()
    parameters = (Parameter("E_f.lower", 0.6), Parameter("E_f.upper", 0.5))
    found = simulate(system, loading, [Step(0.06), Step(1.0, static=True)], parameters=parameters)
    assert found.converged
    x, solver = found.frames[-1], linear_solver()
    parts = sensitivity_parts(system, x, loading(1.0), parameters, solver)
    whole = found.sensitivities[-1]
    np.testing.assert_allclose(parts.sum(axis=1), whole, atol=1e-7 * np.abs(whole).max())
    shares = information_shares(parts.reshape(2, len(WAYS), -1))
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, rtol=1e-12)
    # The pressed sheets bend and stretch; neither alone is the whole.
    assert np.all(np.abs(shares).max(axis=1) < 1.0)


def test_parts_and_mean_of_any_stress():
    solid = strip(0.2, 1e-3, "hex27")[0].solid
    rng = np.random.default_rng(3)
    strain, stress = rng.normal(size=(2, *solid.volumes.shape, 6))
    np.testing.assert_allclose(split(solid, strain, stress).sum(axis=0), stress, atol=1e-14)
    # A field of the place in the plane is its own mean; one linear across it has none.
    points = solid.mesh.reference.points
    plane = np.tile(points[:, :1] + 2 * points[:, 1:2], (len(stress), 1, 1))
    across = np.tile(points[:, 2:], (len(stress), 1, 1))
    np.testing.assert_allclose(thickness_mean(solid, plane), plane, atol=1e-14)
    np.testing.assert_allclose(thickness_mean(solid, across), 0.0, atol=1e-12)


@pytest.mark.parametrize(("element", "layers"), [("tet10", 1), ("hex18", 2)])
def test_other_meshes_are_refused(element, layers):
    mesh = block(element, (2, 1, layers))
    assert not has_one_layer(mesh)
    solid = Solid(mesh, BiotLaw.of((MATERIALS["A"],)))
    with pytest.raises(InputError, match=f"{element}.*not one layered element"):
        thickness_mean(solid, np.zeros((*solid.volumes.shape, 6)))
