"""Tangents against differences of the forces, with the observed second-order decay of the error.

Each part separately, then all together. A wrong tangent shows as an error that stops falling; a
tangent that is right to a per cent would still converge, only slowly, which is why the order and
the final size are asserted rather than a loose tolerance.
"""

import numpy as np
import pytest

from mvest.mechanics.assembly import SparsityPattern, add_forces, adjacency
from mvest.mechanics.body import outer_faces
from mvest.mechanics.forces.contact import BARRIER
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.solid import Solid
from mvest.mechanics.system import Loads, System
from tests.mechanics.bodies import ELEMENT_NAMES, MATERIALS, SIDE, block, sandwich

STEPS = (2e-3, 1e-3, 1e-5)


def check(residual, tangent_times_direction, x, direction, final=1e-7, steps=STEPS):
    """Central differences along `direction` (mm, largest entry 1) approach the tangent as h^2."""
    errors = []
    for h in steps:
        difference = (residual(x + h * direction) - residual(x - h * direction)) / (2 * h)
        size = np.linalg.norm(tangent_times_direction)
        errors.append(np.linalg.norm(difference - tangent_times_direction) / size)
    assert errors[2] < final
    if (
        errors[0] > 1e-8
    ):  # below, the force is linear along the direction and only round-off is left
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)
    return errors


def directions(shape, seed=5):
    d = np.random.default_rng(seed).uniform(-1, 1, shape)
    return d / np.abs(d).max()


def check_system(system, x, loads, *, previous=None, rate=0.0, pairs=None, final=1e-7, steps=STEPS):
    solid = system.solid
    previous = solid.initial_strain() if previous is None else previous

    def residual(at):
        return system.evaluate(at, loads, pairs, previous, rate, tangent=False).residual.ravel()

    blocks = system.evaluate(x, loads, pairs, previous, rate, tangent=True).blocks
    matrix = system.pattern.matrix(blocks)
    d = directions(x.shape)
    check(residual, matrix @ d.ravel(), x, d, final, steps)
    return matrix.tobsr()


def moved(mesh, amount=0.08, seed=1):
    """Node positions with a finite rotation, a stretch and noise."""
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    noise = np.random.default_rng(seed).uniform(-1, 1, mesh.nodes.shape)
    return (mesh.nodes * [1.1, 0.95, 1.05]) @ turn.T + amount * noise


@pytest.mark.parametrize("element_type", ELEMENT_NAMES)
@pytest.mark.parametrize(("rate", "material"), [(0.0, "C"), (10.0, "A")])
def test_material(element_type, rate, material):
    mesh = block(element_type, (2, 2, 1), fibre=(0.8, 0.6, 0), distortion=(0.2, 0.2, 0.2))
    system = System(Solid(mesh, BiotLaw.of((MATERIALS[material],))))
    previous = 0.05 * directions(system.solid.initial_strain().shape, seed=2)
    matrix = check_system(system, moved(mesh), Loads(), previous=previous, rate=rate)
    # The forces derive from an energy of the step, so the tangent is symmetric.
    assert abs(matrix - matrix.T).max() < 1e-10 * abs(matrix).max()


@pytest.mark.parametrize("element_type", ["tet4", "tet10", "hex18", "wedge12"])
def test_follower_load(element_type):
    # Forces are quadratic in the positions on a face: central differences are exact. The rim of
    # what is loaded has a corner cut out.
    mesh = block(element_type, (3, 3, 2), (3.0, 3.0, 2.0))
    every = outer_faces(mesh.elements, element_type)
    top = every[np.all(mesh.nodes[every][:, :, 2] == 2.0, axis=1)]
    load = PressureLoad(top[1:], mesh.reference.face)
    x, n = moved(mesh), len(mesh.nodes)
    d = directions(x.shape)
    pattern = SparsityPattern.of(adjacency(n, [load.faces]), load.rim())
    assert 0 < 2 * len(pattern.skew) < adjacency(n, [load.faces]).nnz
    blocks = pattern.zeros()
    load.add_tangent(x, 1.7, pattern.within(load.faces), pattern.within_skew(load.faces), blocks)

    def forces(at):
        out = np.zeros_like(at)
        add_forces(out, load.faces, 1.7 * load.forces(at))
        return out.ravel()

    difference = (forces(x + 1e-2 * d) - forces(x - 1e-2 * d)) / 2e-2
    product = pattern.matrix(blocks) @ d.ravel()
    np.testing.assert_allclose(difference, product, atol=1e-12)
    whole = pattern.matrix(blocks).tobsr()
    assert abs(whole - whole.T).max() > 0.01


def test_follower_load_pushes_against_the_normal_and_sums_to_pressure_times_area():
    mesh = block("hex18", (3, 2, 1), (4.0, 3.0, 2.0))
    top = mesh.pressure_faces[np.all(mesh.nodes[mesh.pressure_faces][:, :, 2] > 1.9, axis=1)]
    force = PressureLoad(top, "quad9").forces(mesh.nodes).sum(axis=(0, 1))
    np.testing.assert_allclose(force, [0, 0, -12.0], atol=1e-12)


def pressed(system, loading, seed=3, depth=0.7):
    """Positions in which the two sheets are bulged into contact, and the candidate pairs."""
    nodes = system.solid.mesh.nodes
    bulge = np.sin(np.pi * nodes[:, 0] / SIDE) * np.sin(np.pi * nodes[:, 1] / SIDE)
    x = nodes.copy()
    x[:, 2] += np.where(nodes[:, 2] < 1.5, depth, -0.05 - depth) * bulge
    x += 0.02 * np.random.default_rng(seed).uniform(-1, 1, x.shape)
    pairs = system.search_contact(x)
    if pairs is not None:
        assert system.contact.active(pairs, system.contact.points(x)) > 30
    return x, pairs


def test_contact():
    system, loading = sandwich()
    law = BiotLaw(np.zeros((2, 6, 6)))
    alone = System(Solid(system.solid.mesh, law, enhanced=False), contact=system.contact)
    x, pairs = pressed(alone, loading)
    matrix = check_system(alone, x, Loads(), pairs=pairs)
    assert abs(matrix - matrix.T).max() < 1e-12 * abs(matrix).max()


def test_contact_beyond_the_barrier():
    # With a constant force there, but the tangent of the barrier, Newton's method could not leave.
    system, loading = sandwich()
    law = BiotLaw(np.zeros((2, 6, 6)))
    alone = System(Solid(system.solid.mesh, law, enhanced=False), contact=system.contact)
    x, pairs = pressed(alone, loading, depth=0.9)
    y = alone.contact.points(x)
    distance = np.linalg.norm(y[pairs.first] - y[pairs.second], axis=1)
    assert np.sum(distance < BARRIER * pairs.reference) > 10
    # Short steps: at the barrier the force changes its slope within a micrometre.
    check_system(alone, x, Loads(), pairs=pairs, steps=(1e-6, 5e-7, 1e-7))


def test_contact_between_neighbours():
    # A sheet pressed to half its width touches itself, also across elements that share nodes.
    system, _ = sandwich()
    law = BiotLaw(np.zeros((2, 6, 6)))
    alone = System(Solid(system.solid.mesh, law, enhanced=False), contact=system.contact)
    elements = alone.solid.mesh.elements
    x = alone.solid.mesh.nodes * [0.55, 1.0, 1.0]
    x += 0.02 * np.random.default_rng(3).uniform(-1, 1, x.shape)
    pairs = alone.search_contact(x)
    touching = pairs.hosts[alone.contact.touching(pairs, alone.contact.points(x))]
    shared = [len(np.intersect1d(elements[a], elements[b])) for a, b in touching]
    assert {6, 18} <= set(shared)  # with a side in common, and with itself
    check_system(alone, x, Loads(), pairs=pairs)


@pytest.mark.parametrize("element_type", ["hex18", "tet10"])
def test_all_together(element_type):
    system, loading = sandwich(element_type=element_type, samples=9)
    x, pairs = pressed(system, loading)
    previous = 0.02 * directions(system.solid.initial_strain().shape, seed=4)
    check_system(system, x, loading(0.06), previous=previous, rate=5.0, pairs=pairs)
