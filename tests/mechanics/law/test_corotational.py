"""The usual corotational tetrahedron and the paper's single linear solves."""

import numpy as np
import pytest
from scipy.linalg import polar

from mvest.errors import InputError
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import ClosureProtocol
from mvest.mechanics.solid import Solid
from mvest.mechanics.steps import Damping, NewtonSettings, Step
from mvest.mechanics.system import Loads, System
from tests.mechanics.bodies import block, rotation

E_F = 6.23


def tissue(young=E_F):
    return TransverselyIsotropic.from_ratio(young, 2.651, 0.488, PoissonReading.LITERAL)


def solid(element="tet4", young=E_F):
    mesh = block(element, (3, 2, 1), fibre=(0.8, 0.6, 0), distortion=(0.2, 0.2, 0.1))
    return Solid(mesh, BiotLaw.of([tissue(young)], corotational=True))


def forces(body, x):
    """Nodal forces of every element ``(e, 4, 3)``."""
    return body.forces(body.evaluate(x, body.initial_strain(), 0.0))


def literal_force(body, x):
    """``R K (R^T x - X)`` element by element, from the definition."""
    mesh, out = body.mesh, []
    stiffness = tissue().stiffness
    fibre_frames = body.evaluate(mesh.nodes, body.initial_strain(), 0.0).deformation
    for e, nodes in enumerate(mesh.elements):
        X, now = mesh.nodes[nodes], x[nodes]
        R = polar((now[1:] - now[0]).T)[0] @ polar((X[1:] - X[0]).T)[0].T
        Q = fibre_frames[e, 0]
        gradients = np.linalg.inv(np.column_stack([np.ones(4), X]))[1:].T  # (4, 3), dN/dX
        B = np.zeros((6, 12))
        g = gradients @ Q
        for a in range(4):
            for row, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)]):
                B[row, 3 * a : 3 * a + 3] += g[a, i] * Q[:, j]
                if i != j:
                    B[row, 3 * a : 3 * a + 3] += g[a, j] * Q[:, i]
        volume = np.linalg.det((X[1:] - X[0]).T) / 6
        K = volume * B.T @ stiffness @ B
        out.append((K @ (now @ R - X).ravel()).reshape(4, 3) @ R.T)
    return np.array(out)


def test_force_is_linear_elasticity_in_the_frame_of_the_edges():
    body = solid()
    rng = np.random.default_rng(1)
    x = body.mesh.nodes @ rotation((1, 2, 3), 1.0).T
    x = x + 0.15 * rng.standard_normal(x.shape)
    np.testing.assert_allclose(forces(body, x), literal_force(body, x), atol=1e-10)


@pytest.mark.parametrize("angle", [np.pi, 2.5])
def test_rigid_motion_costs_nothing(angle):
    body = solid()
    x = body.mesh.nodes @ rotation((1, -1, 2), angle).T + [3.0, 2.0, 1.0]
    assert np.abs(forces(body, x)).max() < 1e-12


def test_it_is_a_law_of_linear_tetrahedra_only():
    with pytest.raises(InputError, match="linear tetrahedra"):
        solid("tet10")


def pressed(pressure, young=E_F, parameters=()):
    """A block on three nodes, pressed for ten steps of one linear solve each."""
    body = solid(young=young)
    low = np.flatnonzero(body.mesh.nodes[:, 0] < 1e-9)
    load = PressureLoad(body.mesh.pressure_faces, body.mesh.reference.face)
    system = System(body, pressure=load, fixed_nodes=low)
    held = body.mesh.nodes[low]
    return simulate(
        system,
        lambda t: Loads(pressure=pressure * t / 0.1, fixed=held),
        [Step(0.01 * (k + 1)) for k in range(10)],
        damping=Damping(0.1, 0.01),
        newton=NewtonSettings(single_solve=True),
        parameters=parameters,
    )


@pytest.mark.parametrize(("pressure", "low", "high"), [(1e-5, 0.0, 1e-3), (0.3, 3e-3, 0.5)])
def test_derivative_at_fixed_stiffness_is_exact_only_where_nothing_turns(pressure, low, high):
    result = pressed(pressure, parameters=[Parameter("E_f.tissue", E_F)])
    h = 1e-4 * E_F
    ends = [pressed(pressure, E_F + sign * h).frames[-1] for sign in (1, -1)]
    difference = (ends[0] - ends[1]) / (2 * h)
    error = np.linalg.norm(result.sensitivities[-1, 0] - difference) / np.linalg.norm(difference)
    assert low <= error < high


def test_one_solve_a_step_starts_where_the_body_is_and_is_exact():
    # From rest: M v / dt + (1 + beta / dt) K d = p f(X), without load stiffness.
    body = solid()
    low = np.flatnonzero(body.mesh.nodes[:, 0] < 1e-9)
    load = PressureLoad(body.mesh.pressure_faces, body.mesh.reference.face)
    system = System(body, pressure=load, fixed_nodes=low)
    loads = Loads(pressure=0.1, fixed=body.mesh.nodes[low])
    run = simulate(
        system,
        lambda t: loads,
        [Step(0.01)],
        damping=Damping(0.1, 0.05),
        newton=NewtonSettings(single_solve=True),
    )
    rate, mass = 0.05 / 0.01, 1 / 0.01**2 + 0.1 / 0.01
    at_rest = system.evaluate(
        body.mesh.nodes, loads, None, body.initial_strain(), rate, tangent=False
    )
    blocks = system.tangent(body.mesh.nodes, loads, None, at_rest.solid, load_stiffness=False)
    at_rest.residual[system.held] = 0.0
    matrix = system.matrix(blocks, mass).tobsr().toarray()
    expected = -np.linalg.solve(matrix, at_rest.residual.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(run.frames[1] - run.frames[0], expected, rtol=0, atol=1e-12)


def test_pressure_follows_its_curve_and_the_boundary_its_own_way():
    curve = ((0.0, 0.1), (0.1, 0.5), (0.3, 1.0))
    protocol = ClosureProtocol(pressure_mmHg=100.0, ramp=0.2, curve=curve)
    assert [protocol.pressure(t) for t in (-1.0, 0.1, 0.3, 9.0)] == pytest.approx(
        [10, 50, 100, 100]
    )
    assert 10 < protocol.pressure(0.05) < 50
    assert protocol.phase(0.1) == pytest.approx(0.5)
    assert ClosureProtocol(pressure_mmHg=80.0, ramp=0.2).pressure(0.1) == pytest.approx(40.0)

    with pytest.raises(InputError, match="pressure curve"):
        ClosureProtocol(curve=((0.0, 0.1), (0.0, 1.0)))
