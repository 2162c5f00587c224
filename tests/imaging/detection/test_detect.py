"""One frame: with detectors that know the answer the fit arrives there, and hands decide."""

import numpy as np
import pytest

from mvest.imaging.detection.detect import fit_frame
from tests.imaging.detection.made_up import (
    NumberedFrame,
    oracle_model,
    placed,
    poses,
    use_geometry,
)

MISSED = np.array([[2.0, -1.5, 1.0, 0.1, -0.08, 0.1, 0.04]])


def mean_gap(a, b):
    return np.linalg.norm(a - b, axis=1).mean()


@pytest.fixture
def true(shape, monkeypatch):
    b = np.random.default_rng(3).standard_normal(8) * shape.std[:8]
    found = placed(shape, poses(1, 2), b)
    use_geometry(monkeypatch, [found])
    return found


def fitted(shape, true, pose=None, **more):
    return fit_frame(NumberedFrame(), oracle_model(shape, [true]), pose or true.pose, **more)


def test_the_fit_arrives_at_the_true_valve(shape, true):
    # Pulls along wrong normals, or coefficients lost between rounds, stop short of it.
    found = fitted(shape, true, true.pose.moved(MISSED))
    assert mean_gap(found.vertices, true.vertices) < 0.3
    np.testing.assert_allclose(found.tips, true.tips, atol=1e-3)
    # Of the modes of each round so many as the small model has.
    assert len(found.coefficients) == len(shape.std)
    assert found.confidence > 0.9
    assert np.all(found.vertex_confidence > 0.8)
    # Vertices are those of pose and coefficients up to the free displacement.
    shown = found.pose.world(shape.shape(found.coefficients[None]))[0]
    assert mean_gap(found.vertices, shown) < 0.3


def test_the_confidence_is_what_is_seen_of_leaflets_and_part_of_the_pose_rating(shape, true):
    found = [
        fit_frame(NumberedFrame(), oracle_model(shape, [true], best=best, seen=0.8), true.pose)
        for best in (0.0, 0.4)
    ]
    seen = [valve.vertex_confidence.mean() for valve in found]
    strange = [
        max(0.0, ((valve.coefficients / shape.std[: len(valve.coefficients)]) ** 2).mean() - 1.0)
        for valve in found
    ]
    assert found[0].confidence == pytest.approx(seen[0] - 0.15 * strange[0])
    rating = (found[1].confidence + 0.15 * strange[1] - seen[1]) / 0.3
    assert 0.3 < rating <= 0.4


def test_a_shape_that_no_valve_has_is_believed_less(shape, monkeypatch):
    # Seen as well as any, but three deviations from the mean along every mode.
    believed = []
    for far in (0.0, 3.0):
        strained = placed(shape, poses(1, 2), far * shape.std[:8])
        use_geometry(monkeypatch, [strained])
        believed.append(fitted(shape, strained).confidence)
    assert believed[1] < believed[0] - 0.3
