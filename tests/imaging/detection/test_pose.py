"""Poses: there and back, and from a valve that is turned, moved and scaled."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.imaging.detection.pose import pose_of, rotation_grid
from mvest.imaging.detection.shape_model import Misses
from tests.imaging.detection.made_up import LAYOUT, TIPS, labelled, placed, poses
from tests.made_up_sequence import leaflets


def angle(a, b):
    """Degrees between rotations."""
    return np.rad2deg(Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).magnitude())


def test_world_is_scaled_then_turned_then_moved():
    # Axes in rows instead of columns, or a scale that moves the centre, fail here.
    some = poses(5)
    p = np.array([1.0, -2.0, 3.0])
    for k in range(5):
        expected = some.centre[k] + np.exp(some.log_scale[k]) * (some.rotation[k] @ p)
        np.testing.assert_allclose(some.world(p[None])[k, 0], expected, atol=1e-12)


def test_moved_by_towards_arrives():
    # A turn applied from the wrong side, or a shift in world axes on one way only, does not.
    some, other = poses(6, 1), poses(6, 2)
    there = some.moved(some.towards(other))
    np.testing.assert_allclose(there.centre, other.centre, atol=1e-9)
    np.testing.assert_allclose(there.rotation, other.rotation, atol=1e-9)
    np.testing.assert_allclose(there.log_scale, other.log_scale, atol=1e-12)


def test_shifts_and_turns_are_along_the_valves_own_axes():
    some = poses(3, 4)
    moved = some.moved(np.tile([0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0], (3, 1)))
    np.testing.assert_allclose(moved.centre - some.centre, 5 * some.rotation[:, :, 2], atol=1e-12)
    moved = some.moved(np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0], (3, 1)))
    np.testing.assert_allclose(moved.rotation[:, :, 2], some.rotation[:, :, 2], atol=1e-12)
    turned = np.cos(0.3) * some.rotation[:, :, 0] + np.sin(0.3) * some.rotation[:, :, 1]
    np.testing.assert_allclose(moved.rotation[:, :, 0], turned, atol=1e-12)
    np.testing.assert_array_equal(moved.centre, some.centre)


@pytest.mark.parametrize("closure", [0.0, 1.0])
def test_the_pose_of_a_template_valve_is_along_its_own_axes(closure):
    # z to the atrium although the annulus alone does not tell, y anterior, x to phi = 0.
    found = pose_of(leaflets(LAYOUT, closure), TIPS, LAYOUT)
    assert angle(found.rotation[0], np.eye(3)) < 3
    size = np.exp(found.log_scale[0])
    assert 10 < size < 20


@pytest.mark.parametrize("seed", range(4))
def test_the_pose_of_a_valve_follows_a_known_similarity(seed):
    # A mirrored frame (determinant -1) or a size that is not one fails here.
    x = leaflets(LAYOUT, 0.6)
    before = pose_of(x, TIPS, LAYOUT, 15.0)
    by = poses(1, seed, 50.0)
    after = pose_of(by.world(x)[0], by.world(TIPS)[0], LAYOUT, 15.0)
    np.testing.assert_allclose(after.centre[0], by.world(before.centre)[0, 0], atol=1e-9)
    np.testing.assert_allclose(after.rotation[0], by.rotation[0] @ before.rotation[0], atol=1e-9)
    assert after.log_scale[0] == pytest.approx(before.log_scale[0] + by.log_scale[0], abs=1e-10)
    assert np.linalg.det(after.rotation[0]) == pytest.approx(1.0)
    np.testing.assert_allclose(after.local(by.world(x)), before.local(x[None]), atol=1e-9)


def test_a_grid_of_rotations_covers_all_orientations():
    # Quaternions q and -q are the same turn; were they not taken so, half would be left out.
    grid = rotation_grid(300)
    np.testing.assert_allclose(np.linalg.det(grid), 1.0, atol=1e-9)
    np.testing.assert_allclose(grid @ np.swapaxes(grid, 1, 2), np.tile(np.eye(3), (300, 1, 1)),
                               atol=1e-9)  # fmt: skip
    some = Rotation.random(600, rng=np.random.default_rng(5)).as_matrix()

    def gap(of):
        trace = np.einsum("aij,bij->ab", some, of)
        return np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1))).min(axis=1).max()

    # Drawn at random as many leave gaps of 40 to 48 degrees.
    assert gap(grid) < 34
    np.testing.assert_array_equal(grid, rotation_grid(300))


# -- guesses that miss a valve by set amounts -----------------------------------------------------
def test_misses_have_the_requested_deviations(shape):
    # Degrees taken for radians, or one amount for all, fail here.
    true = placed(shape, poses(1, 1), 0.7 * shape.std)
    misses = Misses(2.0, 10.0, 0.05)
    found = labelled(true, shape).missed_poses(misses, 4000)
    by = true.pose.repeated(4000).towards(found)
    expected = [2.0] * 3 + [np.deg2rad(10.0)] * 3 + [0.05]
    np.testing.assert_allclose(by.std(axis=0), expected, rtol=0.05)
    np.testing.assert_allclose(by.mean(axis=0) / expected, 0, atol=0.06)


def test_shapes_are_missed_in_units_of_each_modes_deviation(shape):
    true = placed(shape, poses(1, 1), np.zeros(3))
    guesses = labelled(true, shape).missed_shapes(Misses(0.0, 0.0, 0.0, 0.5), 800)
    found = shape.coefficients(true.pose.local(guesses))
    np.testing.assert_allclose(found.std(axis=0), 0.5 * shape.std, rtol=0.12)
