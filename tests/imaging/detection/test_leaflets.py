"""Landmarks and rims that candidates vote for, and the midsurface along normals."""

import numpy as np
import pytest

from mvest.imaging.detection import leaflets as module
from mvest.imaging.layout import ValveLayout
from tests.imaging.detection import made_up as made
from tests.made_up_sequence import leaflets


@pytest.fixture
def true(shape, monkeypatch):
    """A valve of the mean shape; features are geometry."""
    monkeypatch.setattr(module, "features", made.geometry)
    return made.placed(shape, made.poses(1, 3), np.zeros(2))


@pytest.fixture
def other(shape, true):
    return made.placed(shape, made.poses(1, 5), 0.5 * shape.std[:6])


# -- votes ---------------------------------------------------------------------------------------


def test_a_third_of_outliers_does_not_count():
    # The mean is drawn 3 mm away by them.
    rng = np.random.default_rng(0)
    right = np.array([4.0, -2.0, 1.0])
    votes = right + 0.3 * rng.standard_normal((50, 3))
    votes[:15] = right + 10.0 + rng.standard_normal((15, 3))
    found, _ = module.consensus(votes[None])
    assert np.linalg.norm(found[0] - right) < 0.3
    assert np.linalg.norm(votes.mean(axis=0) - right) > 3


# -- rims ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("closure", [0.0, 0.5])
def test_axes_run_around_the_valve_away_from_the_leaflet_and_along_its_normal(closure):
    # A rim's axis towards the leaflet, an axis against phi, or a normal to the atrium fails here.
    layout = ValveLayout(64, 15)
    x = leaflets(layout, closure)
    grid = x.reshape(layout.rows, layout.columns, 3)
    for row, inner in ((0, 1), (layout.rows - 1, layout.rows - 2)):
        axes, rim = module.rim_axes(x, layout, row), grid[row]
        np.testing.assert_allclose(np.linalg.det(axes), 1.0)
        assert np.all((axes[:, :, 0] * (np.roll(rim, -1, 0) - rim)).sum(axis=1) > 0)
        assert np.all((axes[:, :, 1] * (grid[inner] - rim)).sum(axis=1) < 0)
    axes = module.leaflet_axes(x, layout)
    np.testing.assert_allclose(np.abs(np.linalg.det(axes)), 1.0)
    a, b, c = (x[layout.triangles[:, k]] for k in range(3))
    normal = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    assert np.mean((normal * axes[layout.triangles.ravel(), :, 2]).sum(axis=1) > 0) > 0.99


@pytest.mark.parametrize("rim", module.RIMS)
def test_samples_say_where_the_true_rim_is(shape, other, rim):
    # Learning from candidates of one rim towards the other, or in world axes, fails here.
    x, y = module.rim_samples(made.labelled(other, shape), rim, 240)
    assert y.shape == (len(x), 2)
    points, rotation, _, _ = made.seen(x)
    aim = points + np.einsum("pij,pj->pi", rotation[:, :, 1:], y)
    there = other.vertices.reshape(made.LAYOUT.rows, made.LAYOUT.columns, 3)[module.RIMS[rim]]
    # The aim is abreast of the true rim's vertex: off it along the rim only.
    gap = there - aim[:, None]
    off = np.linalg.norm(np.einsum("pij,pci->pcj", rotation[:, :, 1:], gap), axis=2).min(axis=1)
    assert np.all(np.abs(y) <= 8.0)
    assert off[np.abs(y).max(axis=1) < 8.0].max() < 1e-6
    assert np.linalg.norm(points[:, None] - there, axis=2).min(axis=1).mean() < 6.0


# -- leaflets ------------------------------------------------------------------------------------


def test_votes_spread_by_their_distance():
    # Votes on spheres about two points: their root mean square distances are the radii.
    ray = np.random.default_rng(1).standard_normal((1, 200, 3))
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    sphere = np.concatenate([ray, -ray], axis=1)
    found, spread = module.consensus(np.concatenate([2.0 * sphere, 50.0 + 4.0 * sphere]))
    np.testing.assert_allclose(found, [[0.0] * 3, [50.0] * 3], atol=1e-6)
    np.testing.assert_allclose(spread, [2.0, 4.0], rtol=1e-6)


def test_trees_that_see_nothing_pull_nowhere_and_are_unsure(true):
    # Places that reach farther to one side than to the other pull to that side.
    blind = {"boundary": made.Oracle(1, lambda x: np.full((len(x), 1), 0.02))}
    _, offset, std, confidence = module.find_boundary(
        made.NumberedFrame(), blind, true.vertices, made.LAYOUT, 3.3
    )
    np.testing.assert_allclose(offset, 0, atol=1e-9)
    assert np.all(std > 1.0)
    np.testing.assert_allclose(confidence, 0.02)


def points_of(true):
    return module.landmark_points(true.vertices, true.tips, made.LAYOUT)


def test_samples_say_where_the_landmark_is_in_the_valves_axes(shape, true):
    for which in (0, 5, 10, 11):
        x, y = module.landmark_samples(made.labelled(true, shape, which), which, 40)
        points, rotation, _, _ = made.seen(x)
        aim = points + np.einsum("pij,pj->pi", rotation, y)
        np.testing.assert_allclose(aim, np.tile(points_of(true)[which], (40, 1)), atol=1e-9)
        assert 2.0 < np.linalg.norm(y, axis=1).mean() < 15.0


def test_samples_are_rated_by_their_distance_from_the_true_leaflet(shape, other):
    x, y = module.boundary_samples(made.labelled(other, shape), 720)
    assert y.shape == (len(x), 1)
    assert y.min() >= 0
    assert y.max() <= 1
    gap = np.linalg.norm(made.seen(x)[0][:, None] - other.vertices, axis=2).min(axis=1)
    # Far from every vertex is off the leaflet; about half of all places are near it.
    assert y[gap > 6.0].mean() < 0.15
    assert y[gap < 0.5].mean() > 0.6
    assert 0.28 < np.mean(y > 0.3) < 0.5
