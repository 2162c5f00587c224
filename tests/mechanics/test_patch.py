"""Patch test and rigid motions: what every element must do exactly."""

import numpy as np
import pytest

from mvest.mechanics.integrate import simulate
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.solid import Solid
from mvest.mechanics.steps import NewtonSettings, Step
from mvest.mechanics.system import Loads, System
from tests.mechanics.bodies import ELEMENT_NAMES, MATERIALS, block, boundary, rotation

AFFINE = np.eye(3) + np.array([[0.06, 0.03, -0.02], [-0.01, -0.05, 0.03], [0.02, 0.01, 0.04]])


def invariants(stress):
    """Trace and norm of stresses ``(..., 6)``, equal in every frame."""
    trace = stress[..., :3].sum(axis=-1)
    return trace, np.sqrt((stress[..., :3] ** 2).sum(-1) + 2 * (stress[..., 3:] ** 2).sum(-1))


def patch(mesh, material):
    """Positions of all nodes when the boundary follows AFFINE, and the state there."""
    solid = Solid(mesh, BiotLaw.of((material,)))
    fixed = boundary(mesh.nodes)
    assert len(fixed) < len(mesh.nodes)
    target = mesh.nodes @ AFFINE.T
    way = target - mesh.nodes
    # In small steps: while only the boundary has moved, strains beside it are many times larger.
    result = simulate(
        System(solid, fixed_nodes=fixed),
        lambda t: Loads(fixed=(mesh.nodes + t * way)[fixed]),
        [Step(t, static=True) for t in (0.25, 0.5, 0.75, 1.0)],
        newton=NewtonSettings(tolerance=1e-13, smallest_move=1e-14),
    )
    assert result.converged
    x = result.frames[-1]
    return x, target, solid.evaluate(x, solid.initial_strain(), 0.0)


@pytest.mark.parametrize("element_type", ELEMENT_NAMES)
@pytest.mark.parametrize("material", ["isotropic", "C"])
def test_affine_displacement_is_reproduced_on_a_distorted_mesh(element_type, material):
    # Inner nodes solved for from the boundary must lie on the affine map, and the stress be
    # constant. Layered elements keep the fibre within the layer, so only tetrahedra and the
    # isotropic law admit an arbitrary distortion; the others are distorted in the plane, with the
    # fibre turned in it.
    tetrahedra = element_type.startswith("tet")
    fibre = (0.7, 0.5, 0.4) if tetrahedra else (0.8, 0.6, 0.0)
    across = 0.25 if tetrahedra or material == "isotropic" else 0.0
    mesh = block(element_type, (3, 3, 2), fibre=fibre, distortion=(0.25, 0.25, across))
    x, target, state = patch(mesh, MATERIALS[material])
    assert np.abs(x - target).max() < 1e-10
    for value in invariants(state.stress):
        assert np.ptp(value) < 1e-10 * np.abs(value).max()


@pytest.mark.parametrize("element_type", ELEMENT_NAMES)
def test_rigid_rotation_gives_no_force(element_type):
    mesh = block(element_type, fibre=(0.8, 0.6, 0), distortion=(0.2, 0.2, 0.2))
    solid = Solid(mesh, BiotLaw.of((MATERIALS["C"],)))
    x = mesh.nodes @ rotation((1, 2, -1), np.pi).T + [3.0, -2.0, 5.0]
    state = solid.evaluate(x, solid.initial_strain(), 10.0)
    # Round-off of F^T F is 1e-15; damping multiplies it by 1 + 10, then come the stiffness (about
    # 45 MPa for C) and areas of mm^2.
    assert np.abs(solid.forces(state)).max() < 1e-13 * solid.law.stiffness.max()


@pytest.mark.parametrize("element_type", ["hex18", "tet10"])
def test_rigid_rotation_of_a_deformed_body_turns_its_forces(element_type):
    # Objectivity: f(R x) = R f(x).
    mesh = block(element_type, fibre=(0.8, 0.6, 0))
    solid = Solid(mesh, BiotLaw.of((MATERIALS["A"],)))
    x = mesh.nodes + np.random.default_rng(0).uniform(-0.05, 0.05, mesh.nodes.shape)
    q = rotation((0.3, -1, 0.5), 2.0)
    here = solid.forces(solid.evaluate(x, solid.initial_strain(), 0.0))
    there = solid.forces(solid.evaluate(x @ q.T, solid.initial_strain(), 0.0))
    np.testing.assert_allclose(there, here @ q.T, atol=1e-12 * np.abs(here).max() + 1e-13)


@pytest.mark.parametrize("element_type", ["hex18", "tet10"])
def test_rigid_rotation_between_two_steps_dissipates_nothing(element_type):
    # Damping acts on the rate of the Biot strain, which a rotation of the deformed body leaves
    # alone: with the strain of the start of the step as history the damped force is the elastic
    # one.
    mesh = block(element_type, fibre=(0.8, 0.6, 0))
    solid = Solid(mesh, BiotLaw.of((MATERIALS["A"],)))
    x = mesh.nodes @ AFFINE.T
    previous = solid.law.strain(solid.evaluate(x, solid.initial_strain(), 0.0).green)
    turned = x @ rotation((1, -1, 2), 1.2).T
    elastic = solid.forces(solid.evaluate(turned, solid.initial_strain(), 0.0))
    damped = solid.forces(solid.evaluate(turned, previous, 10.0))
    assert np.abs(elastic).max() > 1e-3
    np.testing.assert_allclose(damped, elastic, atol=1e-11)
    # ... while a stretch is resisted.
    stretched = solid.forces(solid.evaluate(1.01 * x, previous, 10.0))
    unresisted = solid.forces(solid.evaluate(1.01 * x, previous, 0.0))
    assert np.abs(stretched - unresisted).max() > 1e-3


@pytest.mark.parametrize("element_type", ELEMENT_NAMES)
def test_lumped_mass_is_positive_and_sums_to_the_mass(element_type):
    mesh = block(element_type, size=(4.0, 3.0, 2.0), distortion=(0.2, 0.2, 0.2))
    mass = Solid(mesh, BiotLaw.of((MATERIALS["A"],)), density=1.04e-9).lumped_mass
    assert np.all(mass > 0)
    assert mass.sum() == pytest.approx(1.04e-9 * 24.0, rel=1e-12)
