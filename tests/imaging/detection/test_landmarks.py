"""Landmarks: candidates about a guess vote for the point, each with trees of its own.

Where votes agree.
"""

import numpy as np
import pytest

from mvest.imaging.detection import leaflets as module
from mvest.imaging.detection.leaflets import (
    consensus,
    find_landmarks,
    landmark_points,
    landmark_samples,
)
from mvest.imaging.valve_sequence import LANDMARKS, landmark_vertices
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
    monkeypatch.setattr(module, "features", geometry)
    true = placed(shape, poses(1, 2), np.zeros(2))
    trees = {f"landmark_{k}": landmark_oracle([true], LAYOUT, k) for k in range(len(LANDMARKS))}
    rng = np.random.default_rng(0)
    pose = true.pose.moved(np.array([[2.0, 1.0, -1.0, 0.1, 0.1, -0.1, 0.1]]))
    right = landmark_points(true, LAYOUT)
    which = np.array([7, 0, 11, 4])
    guess = right[which] + 4.0 * rng.standard_normal((4, 3))
    before = guess.copy()
    found, spread = find_landmarks(NumberedFrame(), trees, pose, guess, which)
    np.testing.assert_allclose(found, right[which], atol=1e-6)
    np.testing.assert_allclose(spread, 0, atol=1e-6)
    np.testing.assert_array_equal(guess, before)


def test_a_second_round_takes_back_what_the_first_left(shape, monkeypatch):
    # Votes that see three quarters of the way: one round leaves a quarter, two a sixteenth.
    monkeypatch.setattr(module, "features", geometry)
    true = placed(shape, poses(1, 2), np.zeros(2))
    exact = landmark_oracle([true], LAYOUT, 3)
    short = {"landmark_3": Oracle(3, lambda x: 0.75 * exact(x))}
    right = landmark_points(true, LAYOUT)[3]
    guess = right[None] + np.array([[4.0, 0, 0]])
    found, _ = find_landmarks(NumberedFrame(), short, true.pose, guess, np.array([3]))
    assert np.linalg.norm(found[0] - right) < 4.0 / 16 + 0.05


def test_samples_say_where_the_landmark_is_in_the_valves_axes(shape, monkeypatch):
    monkeypatch.setattr(module, "features", geometry)
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


def test_votes_that_all_agree_are_believed():
    point = np.array([[3.0, -1.0, 7.0], [0.0, 2.0, 5.0]])
    found, spread = consensus(np.repeat(point[:, None], 9, 1))
    np.testing.assert_allclose(found, point, atol=1e-12)
    np.testing.assert_allclose(spread, 0, atol=1e-9)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_third_of_outliers_does_not_count(dimensions):
    # The mean is drawn 3 mm away by them.
    rng = np.random.default_rng(0)
    right = np.array([4.0, -2.0, 1.0])[:dimensions]
    votes = right + 0.3 * rng.standard_normal((50, dimensions))
    votes[:15] = right + 10.0 + rng.standard_normal((15, dimensions))
    found, _ = consensus(votes[None])
    assert np.linalg.norm(found[0] - right) < 0.3
    assert np.linalg.norm(votes.mean(axis=0) - right) > 3


def test_points_are_voted_for_apart():
    # Weights or a median taken over points as well as votes mix them.
    rng = np.random.default_rng(1)
    a = rng.standard_normal((1, 40, 3))
    b = 50 + 3.0 * rng.standard_normal((1, 40, 3))
    both, spread = consensus(np.concatenate([a, b]))
    np.testing.assert_allclose(both[0], consensus(a)[0][0])
    np.testing.assert_allclose(both[1], consensus(b)[0][0])
    assert spread[1] > spread[0]


def test_spread_is_the_distance_of_votes_that_agree_little():
    # Votes on a sphere about the point: their root mean square distance is its radius.
    rng = np.random.default_rng(2)
    ray = rng.standard_normal((1, 200, 3))
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    votes = 2.0 * np.concatenate([ray, -ray], axis=1)
    found, spread = consensus(votes)
    np.testing.assert_allclose(found, 0, atol=1e-6)
    assert spread[0] == pytest.approx(2.0, rel=1e-6)
    wider = consensus(2 * votes)[1]
    assert wider[0] == pytest.approx(4.0, rel=1e-6)
