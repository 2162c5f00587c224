"""Where votes agree."""

import numpy as np
import pytest

from mvest.imaging.detection.votes import consensus


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
