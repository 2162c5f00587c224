"""Derivatives of a closed valve by its geometry, against equilibria of displaced valves.

A displaced valve is a system of its own, with another mesh, other contact samples and other
targets. Only the embeddings stay. Central differences fall as h^2, see
`tests.closure.test_model.step_study`.
"""

from dataclasses import replace

import numpy as np
import pytest

from mvest.closure.continuation import ClosedState
from mvest.closure.rest_geometry import RestGeometry
from mvest.errors import InputError
from mvest.mechanics.forces.contact import Contact
from mvest.mechanics.integrate import simulate
from mvest.mechanics.reference import RestVariation
from mvest.mechanics.solid import Solid
from mvest.mechanics.steps import Step
from mvest.mechanics.valve_system import boundary_loading, build_system, patch_members
from mvest.valve.mesh.solid_mesh import embed
from tests.closure.displaced import displaced as displaced_model
from tests.closure.test_model import AT, CLOSING, OPEN, model_of

PARTS = {
    "shape": lambda at, model: np.stack(
        [np.sin(at[0] + at[1]), np.cos(at[1] - at[2]), np.sin(at[2])], axis=-1
    ),
    "thickness": lambda at, model: 1.0 + 0.3 * np.sin(at[0]),
    "fibres": lambda at, model: np.array([1.0, -0.5]),
    "annulus": lambda at, model: 0.1 * model.contact_valve.motion.annulus[-1][:, [1, 2, 0]],
    "tips": lambda at, model: np.array([[0.5, 0.7, -0.3], [-0.2, 0.4, 0.9]]),
    "rest_lengths": lambda at, model: np.linspace(-1, 1, len(model.valve.chordae)),
    "insertions": lambda at, model: 0.5 * np.roll(model.valve.chordae.insertion / 20, 1, 1),
}
"""Smooth changes of each part, of about 1 mm, 1 or 1 rad."""


def variation_of(geometry, part):
    """A smooth change of one part, as the geometry's derivative has it."""
    move = PARTS[part](geometry.surface.vertices.T / 10.0, geometry.model)
    return geometry.variation({part: move[None]})


def displaced(model, variation, h, start):
    """The equilibrium ``(n, 3)`` of the valve displaced by ``h`` of a variation, from a start."""
    values = model._values(AT)
    system = build_system(model.valve, model.contact_valve, model.mesh, model.settings, values)
    loads = boundary_loading(system, model.valve, model.contact_valve, model.settings)(1e3)

    def part(name):
        own = getattr(variation, name)
        return 0.0 if own is None else h * own[0]

    mesh = replace(model.mesh, nodes=model.mesh.nodes + part("nodes"))
    if variation.fibre is not None:
        mesh = replace(mesh, fibre=mesh.fibre + part("fibre"))
    system.solid = Solid(mesh, system.solid.law, density=model.settings.density)
    points, surface = system.contact.points, model.contact_valve.surface
    system.contact = Contact(
        points,
        points(mesh.nodes),
        surface.areas + part("areas"),
        surface.thickness + part("thickness"),
        surface.triangles,
        model.settings.contact,
    )
    if variation.patches is not None:
        members, weights, _ = patch_members(
            model.contact_valve, model.settings.patch_radius, model.valve.chordae.insertion
        )
        surface = model.contact_valve.surface
        embedded = embed(model.mesh, surface.vertices)
        patches = embedded.average(weights + part("patches"), members)
        system.cables = replace(system.cables, patches=patches)
        system._build_pattern(np.zeros((0, 2), dtype=np.int64))
    rest_length = system.cables.rest_length * (1 + part("rest_length"))
    system.cables = replace(system.cables, rest_length=rest_length)
    loads = replace(loads, hinge=loads.hinge + part("supports"), tips=loads.tips + part("tips"))
    result = simulate(
        system,
        lambda _: loads,
        [Step(1.0, static=True)],
        newton=model.settings.newton,
        initial_positions=start,
    )
    assert result.converged
    return result.frames[-1]


def study(model, kind, coarse=2e-3):
    """Errors, over the derivative's size, of differences at two steps, and extrapolated."""
    geometry = RestGeometry(model)
    variation = variation_of(geometry, kind)
    start = model.close(AT, sensitivities=False).simulation.frames[-1]
    exact = geometry.change(AT, variation)[1, ..., 0]
    size = np.linalg.norm(exact)
    differences = [
        model.observed(
            displaced(model, variation, h, start) - displaced(model, variation, -h, start)
        )
        / (2 * h)
        for h in (coarse, coarse / 4)
    ]
    best = (16 * differences[1] - differences[0]) / 15
    return [float(np.linalg.norm(d - exact) / size) for d in (*differences, best)]


@pytest.fixture(scope="module")
def closed():
    model = model_of(CLOSING, continuation=True)
    assert model.close(AT).simulation.converged
    return model


@pytest.mark.parametrize("kind", PARTS)
def test_the_closed_valve_moves_with_its_geometry_as_displaced_valves_do(closed, kind):
    coarse, fine, best = study(closed, kind)
    assert coarse / fine == pytest.approx(16, rel=0.15)
    assert best < 1e-5


def test_quantities_together_are_what_each_is_alone(closed):
    geometry = RestGeometry(closed)
    parts = [variation_of(geometry, kind) for kind in PARTS]
    together = geometry.change(AT, RestVariation.joined(parts))
    assert together.shape == (2, len(closed.valve.surface.vertices), 3, len(PARTS))
    for k in (0, 2, 4):
        alone = geometry.change(AT, parts[k])[..., 0]
        np.testing.assert_allclose(together[..., k], alone, atol=1e-9 * np.abs(alone).max())


@pytest.mark.parametrize("part", PARTS)
def test_a_valve_with_another_geometry_closes_as_its_derivative_says(closed, part):
    # Built anew: embeddings, patches, areas and supports are its own. What the derivative leaves
    # out, as how a hinge's share of the annulus grows, is below 1 %; chordae that stay in space
    # while the leaflets move would be off by a half.
    geometry = RestGeometry(closed)
    move = PARTS[part](geometry.surface.vertices.T / 10.0, closed)
    start = closed.close(AT, sensitivities=False).simulation.frames[-1]
    exact = geometry.change(AT, geometry.variation({part: move[None]}))[1, ..., 0]
    ends = []
    for step in (2e-3, -2e-3):
        model = displaced_model(geometry, {part: step * move})
        model.restart(ClosedState(AT, start))
        simulation = model.close(AT, sensitivities=False).simulation
        assert simulation.converged
        ends.append(closed.observed(simulation.frames[-1]))
    difference = (ends[0] - ends[1]) / 4e-3
    assert np.linalg.norm(difference - exact) < 0.01 * np.linalg.norm(exact)


def test_a_leaflet_is_thicker_on_both_faces_and_moves_as_a_whole(closed):
    # Contact is sampled on the surface itself, as in a case.
    geometry = RestGeometry(replace(closed, valve=closed.contact_valve))
    n = len(geometry.surface.vertices)
    nodes = closed.mesh.nodes
    thicker = geometry.thickness(np.ones((1, n))).nodes[0]
    # Faces move apart by their distance from the surface, about half the thickness of 1.3 mm.
    # (The mesh is of the template itself, of which these few vertices cut the corners.)
    assert 0.4 < np.median(np.linalg.norm(thicker, axis=1)) < 0.75
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    turned = geometry.shape((geometry.surface.vertices @ turn.T)[None])
    np.testing.assert_allclose(turned.nodes[0], nodes @ turn.T, atol=1e-6)
    np.testing.assert_allclose(turned.areas[0], 0.0, atol=1e-6)


def test_a_valve_that_still_moves_has_no_derivative_by_its_geometry():
    with pytest.raises(InputError, match="ends in equilibrium"):
        RestGeometry(model_of(OPEN))
