"""Shapes that all tests of detectors share."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.imaging.detection.frame import standard_frame
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.shape_model import fit_shape_model
from mvest.imaging.detection.trained_model import STAGES, DetectionAccuracy, DetectionModel
from mvest.imaging.learning.boosting import BoostSettings
from mvest.imaging.learning.training import (
    SampleCounts,
    TrainingSettings,
    draw_samples,
    train_stage,
)
from tests.imaging.detection.made_up import ball_volume, labelled, moving_valve, placed

TURN = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()


@pytest.fixture(scope="session")
def shape():
    """A small shape model with 14 modes."""
    return fit_shape_model([moving_valve(k) for k in range(8)], 14)


@pytest.fixture(scope="session")
def seen_valve(shape):
    """A small noisy frame and the valve in it."""
    true = placed(shape, Poses(np.array([[4.0, -6.0, 30.0]]), TURN[None], np.zeros(1)), np.zeros(4))
    points = np.concatenate([true.vertices[::3], true.tips])
    volume = ball_volume([1.6] * 3, np.eye(3), points.min(axis=0) - 8, (34, 34, 34), points)
    return standard_frame(volume, 0), true


@pytest.fixture(scope="session")
def settings():
    """Training that is over at once."""
    return TrainingSettings(
        modes=14,
        samples=SampleCounts(*(24 for _ in fields(SampleCounts))),
        boosting=BoostSettings(trees=3, leaves=4, min_leaf_samples=3, share_features=0.2),
        many_trees=4,
        volumes=2,
    )


@pytest.fixture(scope="session")
def trained(shape, seen_valve, settings):
    """A detection model of a few small trees that learned from a few samples."""
    frame, true = seen_valve
    found = draw_samples(labelled(true, shape, frame=frame), settings.samples)
    boosters = {name: train_stage(name, *found[name], settings, 5) for name in STAGES}
    n = shape.layout.size
    rng = np.random.default_rng(1)
    accuracy = DetectionAccuracy(
        rng.uniform(0.5, 2, n), 6.5, rng.standard_normal((3, 2, n, 3)),
        rng.standard_normal((3, 2, 2, 3)),
        shapes=rng.standard_normal((3, 2, n, 3)), tip_shapes=rng.standard_normal((3, 2, 2, 3)),
    )  # fmt: skip
    return DetectionModel(shape, boosters, {"seed": 5, "valves": ["a", "b"]}, accuracy)
