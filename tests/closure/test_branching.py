"""A closing valve whose chordae branch: balance, derivatives, and what displaces its geometry."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.mechanics.forces.trees import SUPPORT
from mvest.mechanics.valve_system import boundary_loading
from tests.closure.branching import branched
from tests.closure.test_model import AT, CLOSING, MODULI, continued, model_of, step_study
from tests.closure.test_rest_geometry import study

VALUES = {
    **dict(zip(MODULI, AT, strict=True)),
    "chord_stiffness": 0.9,
    "chord_stiffness.marginal": 1.1,
    "chord_stiffness.tip1": 1.05,
    "chord_rest_length": 0.98,
    "chord_rest_length.basal": 0.99,
    "chord_rest_length.tip0": 0.99,
}
M = np.array(list(VALUES.values()))


def branching_model(**changes):
    model = model_of(CLOSING, **changes)
    return replace(model, valve=branched(model.valve), contact_valve=branched(model.contact_valve))


@pytest.fixture(scope="module")
def closed():
    model = branching_model(names=tuple(VALUES), continuation=True)
    result = model.close(M)
    assert result.simulation.converged
    return model, result


def state_of(model, result):
    """Positions, loads and cables of the closed valve."""
    system, x = result.system, result.simulation.frames[-1]
    loads = boundary_loading(system, model.valve, model.contact_valve, model.settings)(1e3)
    return system, x, loads, system.cables.state(x, loads.tips, *system.factors.chordae)


def test_the_open_valve_is_free_of_stress(closed):
    model, result = closed
    system, nodes = result.system, model.mesh.nodes
    state = system.cables.state(nodes, model.valve.papillary_tips)
    assert state.strain.max() < 0
    c = len(model.valve.chordae.insertion)
    np.testing.assert_allclose(state.end[c:], model.valve.chordae.junction, atol=1e-9)
    assert np.all(system.cables.forces(nodes, model.valve.papillary_tips)[0] == 0)


def test_pressure_is_carried_by_chordae_and_annulus(closed):
    # The nodal forces of each add up to zero: p A = chordae + annulus. Those of contact and tissue
    # cancel. The chordae pull at the tips as at the leaflets, but for the junctions' springs.
    model, result = closed
    system, x, loads, state = state_of(model, result)
    thrust = (loads.pressure * system.pressure.forces(x)).sum(axis=(0, 1))
    pull, _ = system.cables.forces(x, loads.tips, *system.factors.chordae)
    support = system.hinge.forces(x, loads.hinge)
    assert np.linalg.norm(thrust) > 3.0
    np.testing.assert_allclose(pull.sum(axis=0) + support.sum(axis=0), thrust, atol=1e-9)
    c, cables = len(pull), system.cables
    hung = loads.tips[cables.tip[c:]] + cables.place
    springs = SUPPORT * (state.end[c:] - hung)
    root = cables.parent < 0
    at_tips = (state.tension[:, None] * state.direction)[root].sum(axis=0)
    np.testing.assert_allclose(pull.sum(axis=0) - springs.sum(axis=0), at_tips, atol=1e-9)
    # Most trees are taut, some branches are slack.
    assert np.count_nonzero(state.tension[root] > 0.02) > 0.6 * np.count_nonzero(root)
    assert np.count_nonzero(state.strain < 0) > 2
    assert np.abs(springs).max() < 2e-4


def test_ends_of_a_tree_feel_each_other(closed):
    # Pulling one leaflet end of a tree moves its junction, and so the force on its neighbours.
    model, result = closed
    system, x, loads, _ = state_of(model, result)
    cables = system.cables
    blocks = cables.forces(x, loads.tips, *system.factors.chordae)[1]
    assert len(blocks) > len(cables.patches)
    assert np.abs(blocks[len(cables.patches) :]).max() > 0.1
    # The tangent is the difference of the residual along a smooth move of all nodes.
    pairs = system.search_contact(x)
    still = system.solid.initial_strain()
    move = np.sin(x[:, [1, 2, 0]] / 5.0)
    h = 1e-5
    ahead, behind = (
        system.evaluate(x + s * move, loads, pairs, still, 0.0, tangent=False).residual
        for s in (h, -h)
    )
    evaluation = system.evaluate(x, loads, pairs, still, 0.0, tangent=True)
    along = (system.pattern.matrix(evaluation.blocks) @ move.ravel()).reshape(-1, 3)
    difference = (ahead - behind) / (2 * h)
    assert np.linalg.norm(along - difference) < 1e-6 * np.linalg.norm(difference)


@pytest.mark.parametrize("name", VALUES)
def test_sensitivities_agree_with_differences_of_closures(closed, name):
    model, result = closed
    k = list(VALUES).index(name)
    start = result.simulation.frames[-1]
    exact = model.observed(result.simulation.sensitivities[-1][k])

    def run(m):
        return model.observed(continued(model, start, m).frames[-1])

    coarse = {"chord_rest_length": 2e-4}.get(name.partition(".")[0], 4e-3)
    errors = step_study(exact, run, M, k, coarse)
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.15)
    assert errors[2] < 1e-5


@pytest.fixture(scope="module")
def geometry_closed():
    model = branching_model(continuation=True)
    assert model.close(AT).simulation.converged
    return model


@pytest.mark.parametrize("kind", ["shape", "tips", "rest_lengths", "insertions"])
def test_the_closed_valve_moves_with_its_geometry_as_displaced_valves_do(geometry_closed, kind):
    # Rest lengths change by steps of a fifteenth of the toe at most.
    steps = {"rest_lengths": 1e-3}
    coarse, fine, best = study(geometry_closed, kind, steps.get(kind, 2e-3))
    assert coarse / fine == pytest.approx(16, rel=0.15)
    assert best < 1e-5
