"""Ties: their law, their tangent, and what they do to a body."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.forces.cables import TiedPoints, Ties
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.solid import Solid
from mvest.mechanics.steps import NewtonSettings, Step
from mvest.mechanics.system import Loads, System
from mvest.valve.mesh.solid_mesh import Embedding
from tests.mechanics.bodies import GAP, block, sandwich
from tests.mechanics.test_tangents import check_system, moved


def test_a_tie_pulls_with_its_stretch_times_its_stiffness():
    # d = (3, 4, 0), |d| = 5, L = 2, k = 10: f = 10 * 3 * (0.6, 0.8, 0) on the first point, and the
    # opposite on the second. Longer than the span, it pushes: L = 6 gives -10 * (0.6, 0.8, 0).
    spans = Embedding(np.array([[0, 1]]), np.array([[1.0, -1.0]]), np.array([-1]))
    ties = Ties(spans, 10.0)
    x = np.array([[4.0, 5.0, 1.0], [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(ties.lengths(x), [5.0])
    np.testing.assert_allclose(ties.forces(x, np.array([2.0]))[0], [[18.0, 24.0, 0.0]])
    np.testing.assert_allclose(ties.forces(x, np.array([6.0]))[0], [[-6.0, -8.0, 0.0]])


@pytest.mark.parametrize("length", [0.7, 4.0], ids=["taut", "pushing"])
def test_the_tangent_is_the_derivative_of_the_residual(length):
    mesh = block("hex18", (2, 2, 1))
    soft = Solid(mesh, BiotLaw(np.zeros((1, 6, 6))), enhanced=False)
    first = np.array([[1.0, 1.0, 1.0], [3.0, 2.0, 1.5]])
    second = np.array([[3.0, 1.2, 0.4], [0.5, 2.5, 1.0]])
    ties = TiedPoints(first, second, 1.0, 20.0).within(mesh)
    system = System(soft, ties=ties)
    loads = Loads(tie_lengths=np.full(2, length))
    matrix = check_system(system, moved(mesh), loads)
    # From an energy, so symmetric; and of inner forces, so that a translation gives none.
    assert abs(matrix - matrix.T).max() < 1e-12 * abs(matrix).max()
    assert np.abs(matrix @ np.tile([1.0, 2.0, 3.0], system.n)).max() < 1e-12 * abs(matrix).max()


def test_tied_sheets_come_together_and_their_ties_carry_no_net_force():
    free, loading = sandwich(contact=False, samples=5)
    mesh = free.solid.mesh
    lower = np.array([[3.0, 4.5, 0.5], [6.0, 4.5, 0.5]])
    upper = lower + np.array([0.0, 0.0, GAP])
    ties = TiedPoints(upper, lower, 1.5, 60.0).within(mesh)
    system = System(
        free.solid,
        pressure=free.pressure,
        cables=free.cables,
        hinge=free.hinge,
        fixed_nodes=free.fixed_nodes,
        ties=ties,
    )
    rest = ties.lengths(mesh.nodes)
    np.testing.assert_allclose(rest, GAP)

    def tied(t):
        loads = loading(0.0)
        share = min(t / 0.06, 1.0)
        length = (1 - share) * rest + share * 1.5
        return Loads(tips=loads.tips, hinge=loads.hinge, fixed=loads.fixed, tie_lengths=length)

    steps = [Step(0.03), Step(0.06), Step(1.0, static=True)]
    result = simulate(system, tied, steps, newton=NewtonSettings(tolerance=1e-10))
    assert result.converged
    x = result.frames[-1]
    force, _ = ties.forces(x, np.full(2, 1.5))
    stretch = ties.lengths(x) - 1.5
    # Stiff: what is left is the force over the stiffness, which is less than a tenth of a mm.
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), 60.0 * stretch, rtol=1e-9)
    assert np.all((stretch > 0) & (stretch < 0.1))
    # In balance: all forces but the ties' are what the ties carry, without resultant or moment.
    zero = system.solid.initial_strain()
    loads = tied(1.0)
    whole = system.evaluate(x, loads, None, zero, 0.0, tangent=False).residual
    bare = Loads(tips=loads.tips, hinge=loads.hinge, fixed=loads.fixed)
    others = system.evaluate(x, bare, None, zero, 0.0, tangent=False).residual
    by_ties = whole - others
    moving = np.setdiff1d(np.arange(system.n), system.fixed_nodes)
    assert np.linalg.norm(whole[moving]) < 1e-7 * np.linalg.norm(by_ties)
    assert np.linalg.norm(by_ties.sum(axis=0)) < 1e-10
    assert np.linalg.norm(np.cross(x, by_ties).sum(axis=0)) < 1e-9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stiffness": np.inf}, "ties stiffness = inf"),
        ({"second": np.zeros((2, 3))}, r"\(1, 3\) and \(2, 3\)"),
    ],
)
def test_inadmissible_ties_are_refused(change, message):
    good = {"first": np.zeros((1, 3)), "second": np.ones((1, 3)), "length": 1.0, "stiffness": 1.0}
    with pytest.raises(InputError, match=message):
        TiedPoints(**{**good, **change})
