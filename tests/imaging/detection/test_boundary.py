"""The midsurface along normals: axes on a known valve, gaps, and a detector that is told."""

import numpy as np
import pytest

from mvest.imaging.detection import leaflets as module
from mvest.imaging.detection.leaflets import boundary_samples, find_boundary, leaflet_axes
from mvest.imaging.detection.shape_model import TrueValve
from mvest.imaging.layout import ValveLayout
from tests.imaging.detection.made_up import (
    LAYOUT,
    TIPS,
    NumberedFrame,
    Oracle,
    boundary_oracle,
    geometry,
    placed,
    poses,
    seen,
)
from tests.made_up_sequence import leaflets

FINE = ValveLayout(64, 15)


def normals(x, layout):
    return leaflet_axes(x, layout)[:, :, 2]


@pytest.mark.parametrize("closure", [0.0, 0.5])
def test_axes_are_orthonormal_and_normals_those_of_the_triangles(closure):
    # Normals to the atrium, or along phi the other way round, are seen here.
    x = leaflets(FINE, closure)
    axes = leaflet_axes(x, FINE)
    np.testing.assert_allclose(
        np.swapaxes(axes, 1, 2) @ axes, np.tile(np.eye(3), (FINE.size, 1, 1)), atol=1e-9
    )
    a, b, c = (x[FINE.triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros((FINE.size, 3))
    for k in range(3):
        np.add.at(total, FINE.triangles[:, k], face)
    total /= np.linalg.norm(total, axis=1, keepdims=True)
    assert np.median((total * axes[:, :, 2]).sum(axis=1)) > 0.99
    assert np.mean((total * axes[:, :, 2]).sum(axis=1) > 0) > 0.99


def test_normals_point_to_the_ventricle_and_along_to_the_free_edge():
    x = leaflets(FINE, 0.0)
    axes = leaflet_axes(x, FINE)
    inner = FINE.s < 0.6
    assert axes[inner, 2, 2].mean() < 0
    row = np.arange(FINE.size - FINE.columns)
    onwards = x[row + FINE.columns] - x[row]
    assert np.all((axes[row][:, :, 1] * onwards).sum(axis=1) > 0)
    around = np.roll(x[FINE.annulus], -1, 0) - x[FINE.annulus]
    assert np.all((axes[FINE.annulus][:, :, 0] * around).sum(axis=1) > 0)


def test_axes_turn_with_the_valve():
    x, by = leaflets(FINE, 0.3), poses(1, 4)
    np.testing.assert_allclose(
        leaflet_axes(by.world(x)[0], FINE), by.rotation[0] @ leaflet_axes(x, FINE), atol=1e-9
    )


@pytest.mark.parametrize("distance", [2.0, -3.0])
def test_the_gap_to_an_offset_surface_is_the_offset(distance):
    # Gaps along the true normals' opposite, or to another leaflet, are seen here.
    x = leaflets(FINE, 0.0)
    n = normals(x, FINE)
    inner = np.flatnonzero((FINE.s > 0.15) & (FINE.s < 0.85))
    true = TrueValve(x + distance * n, TIPS, poses(1))
    gap = module._gap(x[inner], n[inner], inner, true, FINE)
    assert np.median(np.abs(gap - distance)) < 0.05
    # Near the commissures an offset surface folds.
    assert np.mean(np.abs(gap - distance) < 0.4) > 0.9


def test_the_gap_is_along_the_guess_normal_not_the_shortest():
    # A plane seen at 45 degrees is farther away by the square root of two.
    u, v = np.meshgrid(np.arange(16.0), np.arange(7.0))
    grid = np.stack([u, v, np.zeros_like(u)], -1).reshape(-1, 3)
    true = TrueValve(grid, TIPS, poses(1))
    at = np.array([LAYOUT.columns * 3 + 8])
    facing = normals(grid, LAYOUT)[at]
    slanted = (facing + np.array([[1.0, 0, 0]])) / np.sqrt(2)
    start = grid[at] - 1.0 * facing
    gap = module._gap(start, slanted, at, true, LAYOUT)
    assert gap[0] == pytest.approx(np.sqrt(2), abs=1e-9)


@pytest.mark.parametrize("reach", [6.0, 4.0, 3.3])
def test_the_leaflets_are_found_along_their_normals(shape, reach, monkeypatch):
    # A sign, a step or a vertex lost between places and offsets is seen here; what is believed less
    # the farther it is comes out a little short.
    monkeypatch.setattr(module, "features", geometry)
    guess = placed(shape, poses(1, 3), np.zeros(2))
    n = normals(guess.vertices, LAYOUT)
    by = np.random.default_rng(0).uniform(-0.3 * reach, 0.3 * reach, LAYOUT.size)
    true = TrueValve(guess.vertices + by[:, None] * n, guess.tips, guess.pose)
    trees = {"boundary": boundary_oracle([true], LAYOUT)}
    found, offset, std, confidence = find_boundary(
        NumberedFrame(), trees, guess.vertices, LAYOUT, reach
    )
    np.testing.assert_allclose(found, n, atol=1e-12)
    assert np.abs(offset - by).max() < 0.25
    assert np.all(confidence > 0.9)
    assert np.all((std > 0.1) & (std < 1.0))


@pytest.mark.parametrize("reach", [6.0, 3.3])
def test_what_sees_nothing_pulls_nowhere_and_is_unsure(shape, reach, monkeypatch):
    # Places that reach farther to one side than to the other pull to that side.
    monkeypatch.setattr(module, "features", geometry)
    guess = placed(shape, poses(1, 3), np.zeros(2))
    blind = {"boundary": Oracle(1, lambda x: np.full((len(x), 1), 0.02))}
    _, offset, std, confidence = find_boundary(
        NumberedFrame(), blind, guess.vertices, LAYOUT, reach
    )
    np.testing.assert_allclose(offset, 0, atol=1e-9)
    assert np.all(std > 0.3 * reach)
    np.testing.assert_allclose(confidence, 0.02)


def test_samples_are_rated_by_their_distance_from_the_true_leaflet(shape, monkeypatch):
    monkeypatch.setattr(module, "features", geometry)
    true = placed(shape, poses(1, 5), 0.5 * shape.std[:6])
    x, y = boundary_samples(NumberedFrame(), true, shape, 720, np.random.default_rng(0))
    assert y.shape == (len(x), 1)
    assert y.min() >= 0
    assert y.max() <= 1
    points = seen(x)[0]
    gap = np.linalg.norm(points[:, None] - true.vertices, axis=2).min(axis=1)
    # Far from every vertex is off the leaflet; about half of all places are near it.
    assert y[gap > 6.0].mean() < 0.15
    assert y[gap < 0.5].mean() > 0.6
    assert 0.28 < np.mean(y > 0.3) < 0.5
