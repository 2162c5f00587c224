"""Places rated whatever the orientation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.imaging.detection import position
from mvest.imaging.detection.frame import standard_frame
from mvest.imaging.detection.position import PositionDetector, position_samples
from tests.imaging.detection.made_up import (
    NumberedFrame,
    Oracle,
    ball_volume,
    placed,
    poses,
    position_oracle,
    use_geometry,
)

POINT = np.array([3.0, -7.0, 50.0])


@pytest.fixture(scope="module")
def frame():
    direction = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    shape = (56, 60, 58)
    origin = POINT - direction @ (0.8 * np.array([26.0, 31.0, 28.0]))
    return standard_frame(ball_volume([0.8] * 3, direction, origin, shape, [POINT], 5.0), 0)


def test_the_best_place_is_first_and_others_are_apart(shape, monkeypatch):
    # Without suppression all places crowd about the first.
    true = placed(shape, poses(1, 2), np.zeros(2))
    use_geometry(monkeypatch, [true])
    places, ratings = PositionDetector(position_oracle([true]))(NumberedFrame(), 6)
    assert places.shape == (6, 3)
    gap = np.linalg.norm(places - true.pose.centre, axis=1)
    assert np.argmin(gap) == 0
    assert gap[0] < 6.0
    assert np.all(np.diff(ratings) <= 0)
    between = np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(6, dtype=bool)]
    assert between.min() >= 0.8 * position.NEAR_MM


def test_fewer_places_than_asked_for_are_all_there_are(monkeypatch):
    monkeypatch.setattr(position, "_places", lambda frame: np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    monkeypatch.setattr(position, "_shell_features", lambda frame, points: points)
    flat = Oracle(1, lambda x: x[:, :1])
    places, ratings = PositionDetector(flat)(NumberedFrame(), 5)
    np.testing.assert_array_equal(places, [[1.0, 0, 0]])
    np.testing.assert_array_equal(ratings, [1.0])


def test_nowhere_to_look_gives_no_places(monkeypatch):
    monkeypatch.setattr(position, "_places", lambda frame: np.zeros((0, 3)))
    places, ratings = PositionDetector(Oracle(1, lambda x: x[:, :1]))(NumberedFrame(), 5)
    assert places.shape == (0, 3)
    assert ratings.shape == (0,)


def test_places_are_voxels_of_the_field_of_view(frame):
    places = position._places(frame)
    assert len(places) > 50
    index = (places - frame.origin) @ frame.to_index.T
    assert np.all(index > -0.5)
    assert np.all(index < frame.shapes[0] - 0.5 + 4)
    level = frame.level(position.GRID_LEVEL)
    assert len(places) <= level.size / 8 * 1.5


def test_a_place_looks_alike_from_all_sides(frame):
    # Shells about the middle of a ball: the same whatever the axes of the volume are.
    turned = ball_volume(
        [0.8] * 3, np.eye(3), POINT - 0.8 * np.array([27.5, 28.0, 29.0]), (56, 60, 58), [POINT], 5.0
    )
    a = position._shell_features(frame, POINT[None])
    b = position._shell_features(standard_frame(turned, 0), POINT[None])
    off = position._shell_features(frame, POINT[None] + [8.0, 0, 0])
    assert np.abs(a - b).mean() < 0.3 * np.abs(a - off).mean()


def test_samples_are_rated_by_their_distance(shape, frame, monkeypatch):
    true = placed(shape, poses(1, 2), np.zeros(2))
    centred = type(true)(true.vertices, true.tips, type(true.pose)(
        POINT[None], true.pose.rotation, true.pose.log_scale))  # fmt: skip
    monkeypatch.setattr(position, "_shell_features", lambda frame, points: points)
    points, y = position_samples(frame, centred, 100, np.random.default_rng(0))
    assert y.shape == (100, 1)
    gap = np.linalg.norm(points - POINT, axis=1)
    order = np.argsort(gap)
    assert np.all(np.diff(y[order, 0]) <= 1e-12)
    assert y[gap < 2.0].min() > 0.8
    assert y[gap > 20.0].max() < 0.05
    assert np.any(gap > 15.0)
