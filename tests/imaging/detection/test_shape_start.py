"""Shape and tips read off at a pose."""

import numpy as np

from mvest.imaging.detection import pose_search
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.pose_search import MODES, shape_start_samples, starting_shape
from tests.imaging.detection.made_up import (
    NumberedFrame,
    geometry,
    placed,
    poses,
    seen,
    start_oracle,
)


def test_coefficients_and_tips_come_back_as_they_were_learned(shape, monkeypatch):
    # What samples divide by the deviation or subtract is multiplied and added again.
    monkeypatch.setattr(pose_search, "features", geometry)
    b = np.random.default_rng(0).standard_normal(MODES) * shape.std[:MODES]
    true = placed(shape, poses(1, 2), b)
    trees = {"shape": start_oracle([true], shape, MODES)}
    found, tips = starting_shape(NumberedFrame(), trees, true.pose.repeated(2), shape)
    assert found.shape == (2, MODES)
    np.testing.assert_allclose(found[1], b, atol=1e-9)
    np.testing.assert_allclose(tips[1], true.tips, atol=1e-9)


def test_samples_show_the_valve_as_seen_from_a_missed_pose(shape, monkeypatch):
    # Seen from the true pose instead, all samples would say the same.
    monkeypatch.setattr(pose_search, "features", geometry)
    b = np.random.default_rng(0).standard_normal(MODES) * shape.std[:MODES]
    true = placed(shape, poses(1, 2), b)
    x, y = shape_start_samples(NumberedFrame(), true, shape, 25, np.random.default_rng(1))
    assert y.shape == (25, MODES + 6)
    here = Poses(*seen(x)[:3])
    tips = here.world(shape.tips + y[:, MODES:].reshape(-1, 2, 3))
    np.testing.assert_allclose(tips, np.tile(true.tips, (25, 1, 1)), atol=1e-9)
    assert np.std(y[:, MODES:], axis=0).min() > 0.3
    np.testing.assert_allclose(y[:, :MODES].mean(axis=0), b / shape.std[:MODES], atol=1.5)
