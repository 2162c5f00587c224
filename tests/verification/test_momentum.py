"""Free flight and the pendulum: what backward Euler conserves, and with which order."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mvest.mechanics import BiotLaw, Damping, Loads, NewtonSettings, Step, System, simulate
from mvest.mechanics.forces.cables import Cables
from mvest.mechanics.solid import Solid
from mvest.valve.mesh.solid_mesh import Embedding
from tests.mechanics.bodies import MATERIALS, block

OMEGA = np.array([0.0, 0.0, 40.0])  # 1/s
DURATION = 0.01  # s: a turn by 0.4 rad


def flight(n_steps):
    """A spinning, stretched, free body without damping; masses, positions and velocities."""
    mesh = block("hex18", (2, 1, 1), (6.0, 3.0, 1.5), fibre=(0.8, 0.6, 0))
    solid = Solid(mesh, BiotLaw.of((MATERIALS["A"],)))
    centre = solid.lumped_mass @ mesh.nodes / solid.lumped_mass.sum()
    velocity = np.cross(OMEGA, mesh.nodes - centre) + np.array([200.0, -50.0, 30.0])
    dt = DURATION / n_steps
    result = simulate(
        System(solid),
        lambda t: Loads(),
        [Step(dt * (k + 1)) for k in range(n_steps)],
        damping=Damping(0.0, 0.0),
        newton=NewtonSettings(tolerance=1e-13, smallest_move=1e-13),
        initial_velocity=velocity,
    )
    assert result.converged
    x = result.frames
    v = np.concatenate([velocity[None], np.diff(x, axis=0) / dt])
    return solid.lumped_mass, x, v


def test_linear_momentum_is_conserved_exactly():
    # Summed over the body the scheme reads M (v' - v) / dt = 0, since internal forces cancel.
    mass, _, v = flight(10)
    momentum = np.einsum("a,tai->ti", mass, v)
    np.testing.assert_allclose(
        momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-9 * np.abs(momentum).max()
    )


def test_angular_momentum_drifts_as_backward_euler_predicts():
    # L' = x' x M v' with no torque of the internal forces gives L' - L = dt sum v' x M v. For a
    # spin the velocities of two steps enclose the angle omega dt: dL / L = -(omega dt)^2 per step,
    # over the duration -omega^2 T dt: the drift is of the first order, with this constant.
    drifts, sizes = [], (20, 40, 80)
    for n in sizes:
        mass, x, v = flight(n)
        centre = np.einsum("a,tai->ti", mass, x)[:, None] / mass.sum()
        # About the centre, whose own part is conserved.
        spin = np.cross(x - centre, v * mass[:, None]).sum(axis=1)[:, 2]
        drifts.append(1 - spin[-1] / spin[0])
    predicted = OMEGA[2] ** 2 * DURATION * DURATION / np.array(sizes)
    slope = -np.polyfit(np.log(sizes), np.log(drifts), 1)[0]
    assert slope == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(drifts, predicted, rtol=0.1)


LENGTH, STIFFNESS, TOE = 10.0, 1e-6, 0.03  # mm, N
GRAVITY = 9810.0  # mm/s^2
ALPHA = 4.0  # 1/s
SWING = 0.05  # s


def pendulum(n_steps):
    """Path of a small block on a cable that holds it by its centre of mass."""
    mesh = block("tet4", (1, 1, 1), (0.1, 0.1, 0.1))
    mesh = type(mesh)(
        mesh.nodes - 0.05 + [LENGTH, 0, 0], mesh.elements, "tet4", mesh.region,
        mesh.region_names, mesh.fibre, mesh.pressure_faces,
    )  # fmt: skip
    solid = Solid(mesh, BiotLaw.of((MATERIALS["isotropic"],)))
    mass = solid.lumped_mass
    share = mass / mass.sum()
    # Forces in proportion to the masses accelerate all nodes alike: the block neither turns nor
    # deforms, and is the point mass of the textbook.
    centre = Embedding(np.arange(len(mass))[None], share[None], np.array([-1]))
    cables = Cables(centre, np.array([0]), np.array([LENGTH]), np.array([STIFFNESS]), TOE)
    weight = mass[:, None] * np.array([0.0, 0.0, -GRAVITY])
    result = simulate(
        System(solid, cables=cables),
        lambda t: Loads(tips=np.zeros((1, 3)), body_force=weight),
        [Step(SWING * (k + 1) / n_steps) for k in range(n_steps)],
        damping=Damping(ALPHA, 0.1),
        newton=NewtonSettings(tolerance=1e-11, smallest_move=1e-13),
    )
    assert result.converged
    shape = result.frames[-1] - result.frames[-1].mean(axis=0)
    rest = mesh.nodes - mesh.nodes.mean(axis=0)
    np.testing.assert_allclose(shape, rest, atol=1e-7)
    return centre(result.frames[-1])[0], mass.sum(), centre(mesh.nodes)[0]


def reference(mass, start):
    """The same pendulum by an adaptive ODE solver, its force law written out once more."""

    def rate(t, y):
        x, v = y[:3], y[3:]
        span = np.linalg.norm(x)
        e = span / LENGTH - 1
        if e <= 0:
            tension = 0.0
        elif e < TOE:
            tension = STIFFNESS * (e**3 / TOE**2 - e**4 / (2 * TOE**3))
        else:
            tension = STIFFNESS * (e - TOE / 2)
        return np.concatenate([v, -tension * x / span / mass - ALPHA * v + [0.0, 0.0, -GRAVITY]])

    start = np.concatenate([start, np.zeros(3)])
    solution = solve_ivp(rate, (0, SWING), start, method="DOP853", rtol=1e-10, atol=1e-10)
    return solution.y[:3, -1]


def test_pendulum_converges_to_the_ode_with_the_first_order():
    sizes = (300, 600)
    errors = []
    for n in sizes:
        x, mass, start = pendulum(n)
        errors.append(np.linalg.norm(x - reference(mass, start)))
    slope = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert errors[-1] < 0.02 * LENGTH
    assert slope == pytest.approx(1, abs=0.1)
