"""Orientations are rated at places and refined: with ratings that are right, to the true pose.

Places rated whatever the orientation. Shape and tips read off at a pose.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.imaging.detection import pose_search
from mvest.imaging.detection.frame import standard_frame
from mvest.imaging.detection.pose import Poses
from tests.imaging.detection import made_up as made


@pytest.fixture
def true(shape, monkeypatch):
    monkeypatch.setattr(pose_search, "features", made.geometry)
    b = np.random.default_rng(0).standard_normal(pose_search.MODES) * shape.std[: pose_search.MODES]
    return made.placed(shape, made.poses(1, 2), b)


def search(shape, true, share=0.8):
    rating, refinement = made.rating_oracle([true], shape), made.refinement_oracle([true], share)
    steps = {f"pose_refine_{k}": refinement for k in range(len(pose_search.REFINEMENTS))}
    return {"pose_coarse": rating, "pose_fine": rating, **steps}


@pytest.mark.parametrize("step", range(len(pose_search.REFINEMENTS)))
def test_what_samples_of_refinement_say_takes_them_back(true, step):
    x, y = pose_search.refinement_samples(made.labelled(true, None, step), step, 30)
    back = Poses(*made.seen(x)[:3]).moved(y)
    np.testing.assert_allclose(back.centre, np.tile(true.pose.centre, (30, 1)), atol=1e-9)
    np.testing.assert_allclose(back.rotation, np.tile(true.pose.rotation, (30, 1, 1)), atol=1e-9)
    shift = np.linalg.norm(y[:, :3], axis=1)
    assert shift.mean() == pytest.approx(1.6 * pose_search.REFINEMENTS[step].shift_mm, rel=0.3)


def test_mistakes_are_learned_from_with_the_rating_they_deserve(shape, true):
    # A search's mistakes rated as it rated them would be learned as right.
    away = np.zeros((3, 7))
    away[:, 0] = [0.0, 6.0, 60.0]
    mistaken = true.pose.repeated(3).moved(away)
    x, y = pose_search.fine_samples(made.labelled(true, shape), 60, mistaken)
    assert len(x) == len(y) == 63
    np.testing.assert_allclose(made.seen(x)[0][-3:], mistaken.centre)
    np.testing.assert_allclose(y[-3:, 0], np.exp(-np.array([0.0, 6.0, 60.0]) / 6.0), atol=1e-9)


POINT = np.array([3.0, -7.0, 50.0])


@pytest.fixture(scope="module")
def frame():
    direction = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    shape = (56, 60, 58)
    origin = POINT - direction @ (0.8 * np.array([26.0, 31.0, 28.0]))
    return standard_frame(made.ball_volume([0.8] * 3, direction, origin, shape, [POINT], 5.0), 0)


def test_the_best_place_is_first_and_others_are_apart(true, monkeypatch):
    # Without suppression all places crowd about the first.
    made.use_geometry(monkeypatch, [true])
    places = pose_search.likely_places(
        made.NumberedFrame(), {"position": made.position_oracle([true])}, 6
    )
    assert places.shape == (6, 3)
    gap = np.linalg.norm(places - true.pose.centre, axis=1)
    assert np.argmin(gap) == 0
    assert gap[0] < 6.0
    between = np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(6, dtype=bool)]
    assert between.min() >= 0.8 * pose_search.NEAR_MM


def test_coefficients_and_tips_come_back_as_they_were_learned(shape, true):
    # What samples divide by the deviation or subtract is multiplied and added again.
    b = shape.coefficients(true.pose.local(true.vertices[None]))[0, : pose_search.MODES]
    trees = {"shape": made.start_oracle([true], shape)}
    found, tips = pose_search.starting_shape(
        made.NumberedFrame(), trees, true.pose.repeated(2), shape
    )
    assert found.shape == (2, pose_search.MODES)
    np.testing.assert_allclose(found[1], b, atol=1e-9)
    np.testing.assert_allclose(tips[1], true.tips, atol=1e-9)
    # Seen from the true pose instead, all samples would say the same.
    x, y = pose_search.shape_start_samples(made.labelled(true, shape, 1), 25)
    assert y.shape == (25, pose_search.MODES + 6)
    here = Poses(*made.seen(x)[:3])
    tips = here.world(shape.tips + y[:, pose_search.MODES :].reshape(-1, 2, 3))
    np.testing.assert_allclose(tips, np.tile(true.tips, (25, 1, 1)), atol=1e-9)
    assert np.std(y[:, pose_search.MODES :], axis=0).min() > 0.3
    np.testing.assert_allclose(
        y[:, : pose_search.MODES].mean(axis=0), b / shape.std[: pose_search.MODES], atol=1.5
    )


def error(found, true, shape):
    return pose_search.pose_error(found, true.pose, shape)


def searched(shape, true, places, count, monkeypatch, share=0.8):
    monkeypatch.setattr(pose_search, "likely_places", lambda frame, trees, count: places)
    return pose_search.search_poses(made.NumberedFrame(), search(shape, true, share), count)


def test_the_search_finds_the_pose_from_places_nearby(shape, true, monkeypatch):
    # Orientations tied to the wrong places, or the coarse rating taken upside down.
    rng = np.random.default_rng(0)
    places = true.pose.centre + np.array([[30.0, 0, 0], [3.0, -2.0, 2.0], [0, -25.0, 9.0]])
    found, ratings = searched(shape, true, places, 4, monkeypatch)
    assert len(found) == 4
    assert np.all(np.diff(ratings) <= 0)
    assert error(found, true, shape)[0] < 1.0
    again, _ = searched(shape, true, places[rng.permutation(3)], 1, monkeypatch)
    assert error(again, true, shape)[0] < 1.0
    # Without refinement what the grid of orientations has: the best rated, not the worst.
    found, _ = searched(shape, true, places[:2], 10, monkeypatch, 0.0)
    assert np.all(error(found, true, shape) < 16.0)
    assert error(found, true, shape)[0] < 8.0
    found, ratings = searched(shape, true, np.zeros((0, 3)), 3, monkeypatch)
    assert len(found) == len(ratings) == 0


def test_samples_are_rated_by_their_distance(shape, true, frame, monkeypatch):
    centred = true._replace(pose=replace(true.pose, centre=POINT[None]))
    monkeypatch.setattr(pose_search, "_shell_features", lambda frame, points: points)
    points, y = pose_search.position_samples(made.labelled(centred, shape, frame=frame), 100)
    assert y.shape == (100, 1)
    gap = np.linalg.norm(points - POINT, axis=1)
    order = np.argsort(gap)
    assert np.all(np.diff(y[order, 0]) <= 1e-12)
    assert y[gap < 2.0].min() > 0.8
    assert y[gap > 20.0].max() < 0.05
    assert np.any(gap > 15.0)
