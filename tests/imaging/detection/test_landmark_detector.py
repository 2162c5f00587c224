"""Landmarks: candidates about a guess vote for the point, each with trees of its own."""

import numpy as np

from mvest.imaging.detection import landmark_detector
from mvest.imaging.detection.landmark_detector import (
    LandmarkDetector,
    landmark_points,
    landmark_samples,
)
from mvest.imaging.landmarks import LANDMARKS, landmark_vertices
from tests.imaging.detection.made_up import (
    LAYOUT,
    NumberedFrame,
    Oracle,
    geometry,
    landmark_oracle,
    placed,
    poses,
    seen,
)


def test_points_are_in_the_order_of_their_names(shape):
    true = placed(shape, poses(1, 2), np.zeros(2))
    points = landmark_points(true, LAYOUT)
    assert len(points) == len(LANDMARKS)
    by_name = dict(zip(LANDMARKS, points, strict=True))
    for name, vertex in landmark_vertices(LAYOUT).items():
        np.testing.assert_array_equal(by_name[name], true.vertices[vertex])
    np.testing.assert_array_equal(by_name["tip_0"], true.tips[0])
    np.testing.assert_array_equal(by_name["tip_180"], true.tips[1])


def test_each_landmark_is_found_by_its_own_trees(shape, monkeypatch):
    # Trees of a neighbour in the list, votes in world axes, or a scaled vote are seen here.
    monkeypatch.setattr(landmark_detector, "features", geometry)
    true = placed(shape, poses(1, 2), np.zeros(2))
    detector = LandmarkDetector(
        tuple(landmark_oracle([true], LAYOUT, k) for k in range(len(LANDMARKS)))
    )
    rng = np.random.default_rng(0)
    pose = true.pose.moved(np.array([[2.0, 1.0, -1.0, 0.1, 0.1, -0.1, 0.1]]))
    right = landmark_points(true, LAYOUT)
    which = np.array([7, 0, 11, 4])
    guess = right[which] + 4.0 * rng.standard_normal((4, 3))
    before = guess.copy()
    found, spread = detector(NumberedFrame(), pose, guess, which)
    np.testing.assert_allclose(found, right[which], atol=1e-6)
    np.testing.assert_allclose(spread, 0, atol=1e-6)
    np.testing.assert_array_equal(guess, before)


def test_a_second_round_takes_back_what_the_first_left(shape, monkeypatch):
    # Votes that see three quarters of the way: one round leaves a quarter, two a sixteenth.
    monkeypatch.setattr(landmark_detector, "features", geometry)
    true = placed(shape, poses(1, 2), np.zeros(2))
    exact = landmark_oracle([true], LAYOUT, 3)
    short = LandmarkDetector((Oracle(3, lambda x: 0.75 * exact(x)),) * 4)
    right = landmark_points(true, LAYOUT)[3]
    guess = right[None] + np.array([[4.0, 0, 0]])
    found, _ = short(NumberedFrame(), true.pose, guess, np.array([3]))
    assert np.linalg.norm(found[0] - right) < 4.0 / 16 + 0.05


def test_samples_say_where_the_landmark_is_in_the_valves_axes(shape, monkeypatch):
    monkeypatch.setattr(landmark_detector, "features", geometry)
    true = placed(shape, poses(1, 2), np.zeros(2))
    for which in (0, 5, 10, 11):
        x, y = landmark_samples(
            NumberedFrame(), true, LAYOUT, which, 40, np.random.default_rng(which)
        )
        points, rotation, _, _ = seen(x)
        aim = points + np.einsum("pij,pj->pi", rotation, y)
        np.testing.assert_allclose(
            aim, np.tile(landmark_points(true, LAYOUT)[which], (40, 1)), atol=1e-9
        )
        assert 2.0 < np.linalg.norm(y, axis=1).mean() < 15.0
