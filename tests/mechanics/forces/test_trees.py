"""Branching chordae: junctions in equilibrium, forces at the leaflets, and their derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from mvest.mechanics.forces.cables import Cables
from mvest.mechanics.forces.trees import SUPPORT
from tests.mechanics.bodies import point_masses

TOE = 0.02
TIP = np.zeros((1, 3))


def fork(half=4.0, height=10.0, stiffness=20.0, rest=(4.5, 5.0)):
    """Two equal branches to (+-half, 0, height) mm, and a trunk from the origin."""
    ends = np.array([[-half, 0.0, height], [half, 0.0, height]])
    cables = Cables(
        point_masses(2), np.zeros(3, int), np.array([rest[0], rest[0], rest[1]]),
        np.full(3, stiffness), TOE, {}, np.array([0, 0, -1]), np.array([[0.0, 0.0, 4.0]]),
    )  # fmt: skip
    return cables, ends


def tree(scale, seed=3):
    """Five leaflet ends: four on a tree of two levels, one on a straight chord of another tip.

    Its rest lengths are ``scale`` times those that fit roughly.
    """
    rng = np.random.default_rng(seed)
    ends = np.column_stack([rng.uniform(-6, 6, (5, 2)), rng.uniform(18, 22, 5)])
    cables = Cables(
        point_masses(5),
        np.array([0, 0, 0, 0, 1, 0, 0]),
        scale * np.array([6.0, 6.5, 10.0, 11.0, 20.0, 10.0, 4.0]),
        np.array([20.0, 18.0, 16.0, 20.0, 15.0, 40.0, 30.0]),
        TOE,
        {"first": np.array([True, False] * 3 + [True])},
        # Junction 1, which has two ends, hangs on junction 0.
        np.array([1, 1, 0, 0, -1, -1, 0]),
        np.array([[0.0, 0.0, 10.0], [0.5, 0.3, 14.0]]),
    )
    return cables, ends, np.array([[0.3, -0.2, 0.1], [2.0, 1.0, 0.0]])


CASES = {"taut": 0.8, "partly slack": 1.0, "barely taut": 1.1, "wholly slack": 1.6}


@pytest.mark.parametrize("load", [1e-3, 0.5, 3.0])
def test_a_symmetric_fork_is_in_balance_as_by_hand(load):
    # The trunk carries T along z at strain e_T. Each branch carries N at the angle a from z with
    # 2 N cos(a) = T (the spring's 1e-5 N/mm is added to T). So the tension T and the angle a give
    # all lengths: trunk 5 (1 + e(T)), branch 4.5 (1 + e(N)), half = branch sin(a), height = trunk +
    # branch cos(a). Beyond the toe e = N/EA + e_t/2; within it, by inverting the law.
    angle, stiffness = 0.6, 20.0

    def strain(tension):
        share = tension / stiffness
        if share >= TOE / 2:
            return share + TOE / 2
        roots = np.roots([-1 / (2 * TOE**3), 1 / TOE**2, 0, 0, -share])
        real = roots[np.abs(roots.imag) < 1e-9].real
        return real[(real >= 0) & (real <= TOE)].min()

    trunk = 5.0 * (1 + strain(load))
    pull = load + SUPPORT * (trunk - 4.0)
    branch = 4.5 * (1 + strain(pull / (2 * np.cos(angle))))
    cables, ends = fork(branch * np.sin(angle), trunk + branch * np.cos(angle), stiffness)
    state = cables.state(ends, TIP)
    np.testing.assert_allclose(state.end[2], [0, 0, trunk], atol=1e-9)
    np.testing.assert_allclose(state.tension[2], load, rtol=1e-8)
    half = 0.5 * pull
    force, _ = cables.forces(ends, TIP)
    expected = [[-half * np.tan(angle), 0, half], [half * np.tan(angle), 0, half]]
    np.testing.assert_allclose(force, expected, rtol=1e-8, atol=1e-12)


def energy(cables, ends, tips, y):
    """Energy of all segments and springs, written out once more by integrating the law."""
    points, at = np.concatenate([ends, y]), tips[cables.tip]
    total = 0.5 * SUPPORT * np.sum((y - at[len(ends) :] - cables.place) ** 2)
    for s, p in enumerate(cables.parent):
        start = at[s] if p < 0 else y[p]
        e = np.linalg.norm(points[s] - start) / cables.rest_length[s] - 1
        lower = np.clip(e, 0, TOE)
        per_rest = np.polyval(np.polyint([-1 / (2 * TOE**3), 1 / TOE**2, 0, 0, 0]), lower)
        if e > TOE:
            per_rest += np.polyval(np.polyint([1, -TOE / 2]), e)
            per_rest -= np.polyval(np.polyint([1, -TOE / 2]), TOE)
        total += cables.axial_stiffness[s] * cables.rest_length[s] * per_rest
    return total


@pytest.mark.parametrize("scale", CASES.values(), ids=CASES)
def test_junctions_minimise_the_energy_of_a_tree_of_two_levels(scale):
    cables, ends, tips = tree(scale)
    found = cables.state(ends, tips).end[5:]
    least = energy(cables, ends, tips, found)
    for start in (np.zeros((2, 3)), np.array([[3.0, -4.0, 25.0], [-5.0, 2.0, 7.0]])):
        best = minimize(
            lambda y: energy(cables, ends, tips, y.reshape(2, 3)), start.ravel(), method="BFGS",
            options={"gtol": 1e-9},
        )  # fmt: skip
        assert least <= best.fun + 1e-12
        # A spring of 1e-5 N/mm alone holds a slack junction: 1e-9 N are 1e-4 mm.
        np.testing.assert_allclose(best.x.reshape(2, 3), found, atol=3e-3)
    # The forces at the ends, the springs and the tip are in balance.
    state = cables.state(ends, tips)
    pull = state.tension[:, None] * state.direction
    springs = SUPPORT * (found - tips[0] - cables.place)
    at_tip = pull[np.flatnonzero(cables.parent < 0)].sum(axis=0)
    np.testing.assert_allclose(pull[:5].sum(axis=0) - springs.sum(axis=0), at_tip, atol=1e-12)


def test_a_slack_tree_pulls_nothing_and_hangs_in_its_place():
    cables, ends, tips = tree(CASES["wholly slack"])
    force, stiffness = cables.forces(ends, tips)
    assert np.all(force == 0)
    assert np.all(stiffness == 0)
    np.testing.assert_allclose(cables.state(ends, tips).end[5:], tips[0] + cables.place, rtol=1e-15)


def test_the_same_positions_give_the_same_forces_to_the_last_bit():
    cables, ends, tips = tree(1.0)
    first = cables.forces(ends, tips)[0]
    cables.forces(ends + 1.0, tips)
    np.testing.assert_array_equal(cables.forces(ends, tips)[0], first)


@pytest.mark.parametrize("scale", np.linspace(0.5, 1.7, 13))
def test_junctions_are_found_wherever_ends_and_tips_are(scale):
    for seed in range(20):
        cables, ends, tips = tree(scale, seed)
        for stretch in (0.2, 1.0, 2.0):
            state = cables.state(stretch * ends, tips)
            pull = state.tension[:, None] * state.direction
            net = cables.trees.net(pull) + SUPPORT * (state.end[5:] - tips[0] - cables.place)
            assert np.abs(net).max() < 1e-13 * max(1.0, state.tension.max())


def dense(cables, blocks):
    """The stiffness ``(3 c, 3 c)`` of all leaflet ends."""
    c = len(cables.patches)
    out = np.zeros((c, 3, c, 3))
    for (a, b), block in zip(cables.trees.pairs, blocks, strict=True):
        out[a, :, b] += block
    return out.reshape(3 * c, 3 * c)


def moves(cables, rng):
    """One change of each kind."""
    k, c = len(cables.tip), len(cables.patches)
    return {
        "ends": rng.normal(size=(c, 3)),
        "tips": rng.normal(size=(2, 3)),
        "stiffness": rng.normal(size=k),
        "length": 0.3 * rng.normal(size=k),
    }


@pytest.mark.parametrize("kind", ["ends", "tips", "stiffness", "length"])
@pytest.mark.parametrize("scale", list(CASES.values())[:3], ids=list(CASES)[:3])
def test_changes_of_the_forces_are_their_differences(scale, kind):
    # Central differences err by h^2: by 16 less from h to h/4, and by nothing when extrapolated.
    cables, ends, tips = tree(scale)
    move = moves(cables, np.random.default_rng(1))[kind]
    factors = np.full(7, 0.9), np.full(7, 0.98)

    def force(h):
        at = {"ends": ends, "tips": tips, "stiffness": factors[0], "length": factors[1]}
        at[kind] = at[kind] + h * move
        return cables.forces(*at.values())[0]

    exact = cables.change(cables.state(ends, tips, *factors), **{kind: move})
    size = np.linalg.norm(exact)
    assert size > 0
    # Steps stay within the toe, where the force has the least derivatives.
    h = 1e-2 if scale < 1.0 or kind == "stiffness" else 1e-4 if kind == "length" else 1e-3
    coarse, fine = ((force(s) - force(-s)) / (2 * s) for s in (h, h / 4))
    errors = [np.linalg.norm(d - exact) / size for d in (coarse, fine, (16 * fine - coarse) / 15)]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.15)
    assert errors[2] < 1e-5


@pytest.mark.parametrize("scale", list(CASES.values())[:3], ids=list(CASES)[:3])
def test_the_stiffness_is_symmetric_and_that_of_small_displacements(scale):
    cables, ends, tips = tree(scale)
    matrix = dense(cables, cables.forces(ends, tips)[1])
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())
    # Convex: no negative eigenvalue.
    values = np.linalg.eigvalsh(matrix)
    assert values[0] > -1e-12 * values[-1]
    state = cables.state(ends, tips)
    for column in np.eye(15):
        change = cables.change(state, ends=column.reshape(5, 3))
        np.testing.assert_allclose(change.ravel(), matrix @ column, atol=1e-12 * values[-1])
    # The straight chord belongs to no tree.
    assert np.all(matrix[12:, :12] == 0)


def test_a_cable_in_two_segments_is_the_cable_of_both():
    # Two segments in series, half the length each, are one cable (but for the spring's force).
    whole = Cables(point_masses(1), np.zeros(1, int), np.array([9.0]), np.array([20.0]), TOE)
    halves = Cables(
        point_masses(1), np.zeros(2, int), np.full(2, 4.5), np.full(2, 20.0), TOE, {},
        np.array([0, -1]), np.array([[0.0, 3.0, 4.0]]),
    )  # fmt: skip
    end = np.array([[0.0, 6.0, 8.0]])
    one, two = whole.forces(end, TIP), halves.forces(end, TIP)
    np.testing.assert_allclose(two[0], one[0], rtol=1e-6)
    np.testing.assert_allclose(two[1], one[1], atol=1e-5)


def test_factors_of_families_and_tips_act_on_segments():
    cables, *_ = tree(1.0)
    values = {"chord_stiffness": 2.0, "chord_stiffness.first": 3.0, "chord_stiffness.tip1": 5.0}
    expected = [6, 2, 6, 2, 6 * 5, 2, 6]
    np.testing.assert_allclose(cables.factor("chord_stiffness", values), expected)
    assert replace(cables, rest_length=cables.rest_length).trees.pairs.shape == (5 + 12, 2)
