"""Rims: axes on a known valve, and candidates that vote for the true rim."""

import numpy as np
import pytest

from mvest.imaging.detection import leaflets as module
from mvest.imaging.detection.leaflets import RIMS, find_rim, rim_axes, rim_samples
from mvest.imaging.detection.shape_model import TrueValve
from mvest.imaging.layout import ValveLayout
from tests.imaging.detection.made_up import (
    LAYOUT,
    TIPS,
    NumberedFrame,
    Oracle,
    geometry,
    placed,
    poses,
    rim_oracle,
    seen,
)
from tests.made_up_sequence import leaflets


@pytest.mark.parametrize("row", [0, -1])
@pytest.mark.parametrize("closure", [0.0, 0.5])
def test_axes_run_along_the_rim_and_away_from_the_leaflet(row, closure):
    # Towards the leaflet at one of the rims, or against phi, is seen here.
    x = leaflets(LAYOUT, closure)
    grid = x.reshape(LAYOUT.rows, LAYOUT.columns, 3)
    axes = rim_axes(x, LAYOUT, row % LAYOUT.rows)
    np.testing.assert_allclose(
        np.swapaxes(axes, 1, 2) @ axes, np.tile(np.eye(3), (LAYOUT.columns, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    rim = grid[row]
    onwards = np.roll(rim, -1, 0) - rim
    assert np.all((axes[:, :, 0] * onwards).sum(axis=1) > 0)
    into = grid[1 if row == 0 else -2] - rim
    assert np.all((axes[:, :, 1] * into).sum(axis=1) < 0)


def test_the_annulus_side_away_from_the_leaflet_is_outside_the_orifice():
    axes = rim_axes(leaflets(LAYOUT, 0.0), LAYOUT, 0)
    middle = LAYOUT.column(90.0)
    assert axes[middle, 1, 1] > 0.2  # towards the anterior side
    edge = rim_axes(leaflets(LAYOUT, 0.0), LAYOUT, LAYOUT.rows - 1)
    assert edge[middle, 2, 1] < -0.2  # towards the ventricle


def test_away_is_the_direction_in_which_the_leaflet_ends():
    # Closed leaflets hang down where they touch, whatever their direction at the annulus.
    fine = ValveLayout(64, 15)
    edge = rim_axes(leaflets(fine, 1.0), fine, fine.rows - 1)
    for phi in (90.0, 270.0):
        assert edge[fine.column(phi), 2, 1] < -0.95
        assert rim_axes(leaflets(fine, 1.0), fine, 0)[fine.column(phi), 2, 1] < 0.9


@pytest.mark.parametrize("rim", RIMS)
def test_the_rim_moves_to_where_votes_say_it_is(shape, rim, monkeypatch):
    # Offsets taken along the wrong axes, or added twice in the second round, miss it.
    monkeypatch.setattr(module, "features", geometry)
    guess = placed(shape, poses(1, 3), np.zeros(2))
    by = 2.0 * np.random.default_rng(0).standard_normal((LAYOUT.size, 3))
    true = TrueValve(guess.vertices + by, guess.tips, guess.pose)
    row = RIMS[rim]
    trees = {rim: rim_oracle([true], LAYOUT, row)}
    axes, offset, spread = find_rim(NumberedFrame(), trees, rim, guess.vertices, LAYOUT, 0.0)
    at = LAYOUT.annulus if row == 0 else LAYOUT.free_edge
    expected = np.einsum("cij,ci->cj", axes[:, :, 1:], by[at])
    np.testing.assert_allclose(offset, expected, atol=1e-6)
    np.testing.assert_allclose(spread, 0, atol=1e-6)
    np.testing.assert_allclose(axes, rim_axes(guess.vertices, LAYOUT, row % LAYOUT.rows))


def test_a_second_round_takes_back_what_the_first_left(shape, monkeypatch):
    # Votes that see three quarters of the way: one round leaves a quarter, two a sixteenth.
    monkeypatch.setattr(module, "features", geometry)
    guess = placed(shape, poses(1, 3), np.zeros(2))
    axes = rim_axes(guess.vertices, LAYOUT, 0)
    vertices = guess.vertices.copy()
    vertices[LAYOUT.annulus] += 3.0 * axes[:, :, 1]
    right = rim_oracle([TrueValve(vertices, guess.tips, guess.pose)], LAYOUT, 0)
    short = {"annulus": Oracle(2, lambda x: 0.75 * right(x))}
    _, offset, _ = find_rim(NumberedFrame(), short, "annulus", guess.vertices, LAYOUT, 0.0)
    np.testing.assert_allclose(offset[:, 0], 3.0, atol=3.0 / 16 + 0.05)


def test_some_wrong_votes_are_outvoted_and_told_by_the_spread(shape, monkeypatch):
    monkeypatch.setattr(module, "features", geometry)
    guess = placed(shape, poses(1, 3), np.zeros(2))
    right = rim_oracle([guess], LAYOUT, 0)
    rng = np.random.default_rng(1)

    def answer(x):
        said = right(x)
        wrong = rng.random(len(x)) < 0.2
        return said + wrong[:, None] * np.array([9.0, 9.0])

    trees = {"annulus": Oracle(2, answer)}
    _, offset, spread = find_rim(NumberedFrame(), trees, "annulus", guess.vertices, LAYOUT, 0.0)
    assert np.linalg.norm(offset, axis=1).mean() < 0.35
    assert np.all(spread > 0.2)


@pytest.mark.parametrize("rim", RIMS)
def test_samples_say_where_the_true_rim_is(shape, rim, monkeypatch):
    # Learning from candidates of one rim towards the other, or in world axes, is seen here.
    monkeypatch.setattr(module, "features", geometry)
    true = placed(shape, poses(1, 5), 0.5 * shape.std[:6])
    rng = np.random.default_rng(0)
    x, y = rim_samples(NumberedFrame(), true, shape, rim, 240, rng)
    assert y.shape == (len(x), 2)
    points, rotation, _, _ = seen(x)
    aim = points + np.einsum("pij,pj->pi", rotation[:, :, 1:], y)
    there = true.vertices.reshape(LAYOUT.rows, LAYOUT.columns, 3)[RIMS[rim]]
    # The aim is abreast of the true rim's vertex: off it along the rim only.
    gap = there - aim[:, None]
    off = np.linalg.norm(np.einsum("pij,pci->pcj", rotation[:, :, 1:], gap), axis=2).min(axis=1)
    assert np.all(np.abs(y) <= 8.0)
    free = np.abs(y).max(axis=1) < 8.0
    assert off[free].max() < 1e-6
    assert np.linalg.norm(points[:, None] - there, axis=2).min(axis=1).mean() < 6.0


def test_the_valves_own_tips_play_no_part(shape, monkeypatch):
    monkeypatch.setattr(module, "features", geometry)
    x = leaflets(LAYOUT, 0.3)
    a, b = TrueValve.of(x, TIPS, shape), TrueValve.of(x, TIPS - np.array([0, 0, 1.0]), shape)
    found = [
        rim_samples(NumberedFrame(), true, shape, "annulus", 60, np.random.default_rng(2))[1]
        for true in (a, b)
    ]
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)
