"""Guesses that miss a valve by set amounts."""

import numpy as np
import pytest

from mvest.imaging.detection.shape_model import Misses, TrueValve, missed_poses, missed_shapes
from tests.imaging.detection.made_up import LAYOUT, TIPS, placed, poses
from tests.made_up_sequence import leaflets


def test_no_misses_are_the_truth(shape):
    true = placed(shape, poses(1, 1), 0.7 * shape.std)
    none = Misses(0.0, 0.0, 0.0)
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(missed_poses(true.pose, none, 3, rng).centre[2], true.pose.centre[0])
    guesses = missed_shapes(true, shape, none, 3, rng)
    np.testing.assert_allclose(guesses, np.tile(true.vertices, (3, 1, 1)), atol=1e-9)


def test_misses_have_the_deviations_asked_for():
    # Degrees taken for radians, or one amount for all, are seen here.
    pose = poses(1, 1)
    misses = Misses(2.0, 10.0, 0.05)
    by = pose.repeated(4000).towards(missed_poses(pose, misses, 4000, np.random.default_rng(0)))
    expected = [2.0] * 3 + [np.deg2rad(10.0)] * 3 + [0.05]
    np.testing.assert_allclose(by.std(axis=0), expected, rtol=0.05)
    np.testing.assert_allclose(by.mean(axis=0) / expected, 0, atol=0.06)


def test_shapes_are_missed_in_units_of_each_modes_deviation(shape):
    true = placed(shape, poses(1, 1), np.zeros(3))
    guesses = missed_shapes(true, shape, Misses(0.0, 0.0, 0.0, 0.5), 800, np.random.default_rng(0))
    found = shape.coefficients(true.pose.local(guesses))
    np.testing.assert_allclose(found.std(axis=0), 0.5 * shape.std, rtol=0.12)


def test_a_true_valve_has_the_pose_that_the_model_gives_it(shape):
    by = poses(1, 7)
    x, tips = by.world(leaflets(LAYOUT, 0.4))[0], by.world(TIPS)[0]
    true = TrueValve.of(x, tips, shape)
    annulus = true.pose.local(x[None])[0][LAYOUT.annulus]
    np.testing.assert_allclose(annulus.mean(axis=0), 0, atol=1e-9)
    size = np.sqrt((annulus**2).sum(axis=1).mean())
    assert size == pytest.approx(shape.size_mm)
