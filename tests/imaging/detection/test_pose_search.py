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
from mvest.imaging.detection.pose_search import (
    MODES,
    REFINEMENTS,
    coarse_samples,
    fine_samples,
    likely_places,
    pose_error,
    position_samples,
    refined,
    refinement_samples,
    search_poses,
    shape_start_samples,
    starting_shape,
)
from tests.imaging.detection.made_up import (
    NumberedFrame,
    Oracle,
    ball_volume,
    geometry,
    labelled,
    placed,
    poses,
    position_oracle,
    rating_oracle,
    refinement_oracle,
    seen,
    start_oracle,
    use_geometry,
)


@pytest.fixture
def true(shape, monkeypatch):
    monkeypatch.setattr(pose_search, "features", geometry)
    b = np.random.default_rng(0).standard_normal(MODES) * shape.std[:MODES]
    return placed(shape, poses(1, 2), b)


def error(found, true, shape):
    return pose_error(found, true.pose, shape)


def search(shape, true, share=0.8):
    rating, refinement = rating_oracle([true], shape), refinement_oracle([true], share)
    steps = {f"pose_refine_{k}": refinement for k in range(len(REFINEMENTS))}
    return {"pose_coarse": rating, "pose_fine": rating, **steps}


def test_the_error_of_a_pose_is_how_far_it_lays_points_astray(shape, true):
    assert error(true.pose, true, shape)[0] == pytest.approx(0.0, abs=1e-9)
    shifted = true.pose.moved(np.array([[3.0, 4.0, 0, 0, 0, 0, 0]]))
    assert error(shifted, true, shape)[0] == pytest.approx(5.0)
    # Turned half about z it is wrong by more than its size: such a pose must not look good.
    about = true.pose.moved(np.array([[0.0, 0, 0, 0, 0, np.pi, 0]]))
    assert error(about, true, shape)[0] > 20.0


def searched(shape, true, places, count, monkeypatch, share=0.8):
    monkeypatch.setattr(pose_search, "likely_places", lambda frame, trees, count: places)
    return search_poses(NumberedFrame(), search(shape, true, share), count)


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


def test_refinement_takes_back_a_share_at_every_step(shape, true):
    # One step skipped, or a step applied in world axes, leaves more than this.
    start = true.pose.moved(np.array([[6.0, -4.0, 3.0, 0.3, -0.2, 0.3, 0.1]]))
    before = start.towards(true.pose)[0]
    found, _ = refined(NumberedFrame(), search(shape, true, 0.5), start)
    after = found.towards(true.pose)[0]
    np.testing.assert_allclose(after[6], before[6] / 8, atol=1e-9)
    assert np.linalg.norm(after[:3]) == pytest.approx(np.linalg.norm(before[:3]) / 8, rel=0.05)


def test_ratings_belong_to_the_poses_they_come_with(shape, true):
    start = true.pose.repeated(3).moved(np.diag([9.0, 1.0, 4.0]) @ np.eye(3, 7))
    found, ratings = refined(NumberedFrame(), search(shape, true, 0.0), start)
    np.testing.assert_allclose(found.centre, start.centre)
    np.testing.assert_allclose(ratings, np.exp(-np.array([9.0, 1.0, 4.0]) / 6.0))


@pytest.mark.parametrize("step", range(len(REFINEMENTS)))
def test_what_samples_of_refinement_say_takes_them_back(true, step):
    x, y = refinement_samples(labelled(true, None, step), step, 30)
    back = Poses(*seen(x)[:3]).moved(y)
    np.testing.assert_allclose(back.centre, np.tile(true.pose.centre, (30, 1)), atol=1e-9)
    np.testing.assert_allclose(back.rotation, np.tile(true.pose.rotation, (30, 1, 1)), atol=1e-9)
    shift = np.linalg.norm(y[:, :3], axis=1)
    assert shift.mean() == pytest.approx(1.6 * REFINEMENTS[step].shift_mm, rel=0.3)


@pytest.mark.parametrize("samples", [coarse_samples, fine_samples])
def test_samples_of_rating_are_good_and_bad_and_rated_by_their_error(shape, true, samples):
    x, y = samples(labelled(true, shape), 120)
    assert y.shape == (120, 1)
    errors = error(Poses(*seen(x)[:3]), true, shape)
    assert np.all(np.diff(y[np.argsort(errors), 0]) <= 1e-9)
    assert y.max() > 0.5
    assert y.min() < 0.1


def test_the_final_rating_learns_to_tell_front_from_back(shape, true):
    # Poses in place but turned half about the valve's axis: there must be some, and rated low.
    x, y = fine_samples(labelled(true, shape), 240)
    by = true.pose.repeated(240).towards(Poses(*seen(x)[:3]))
    back = (np.linalg.norm(by[:, :3], axis=1) < 8) & (np.abs(by[:, 5]) > 2.5)
    right = (np.linalg.norm(by[:, :3], axis=1) < 3) & (np.linalg.norm(by[:, 3:6], axis=1) < 0.15)
    assert back.sum() > 20
    assert right.sum() > 20
    assert y[back].max() < 0.15
    assert y[right].min() > 0.3


def test_mistakes_are_learned_from_with_the_rating_they_deserve(shape, true):
    # A search's mistakes rated as it rated them would be learned as right.
    away = np.zeros((3, 7))
    away[:, 0] = [0.0, 6.0, 60.0]
    mistaken = true.pose.repeated(3).moved(away)
    x, y = fine_samples(labelled(true, shape), 60, mistaken)
    assert len(x) == len(y) == 63
    np.testing.assert_allclose(seen(x)[0][-3:], mistaken.centre)
    np.testing.assert_allclose(y[-3:, 0], np.exp(-np.array([0.0, 6.0, 60.0]) / 6.0), atol=1e-9)


POINT = np.array([3.0, -7.0, 50.0])


@pytest.fixture(scope="module")
def frame():
    direction = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    shape = (56, 60, 58)
    origin = POINT - direction @ (0.8 * np.array([26.0, 31.0, 28.0]))
    return standard_frame(ball_volume([0.8] * 3, direction, origin, shape, [POINT], 5.0), 0)


def test_the_best_place_is_first_and_others_are_apart(true, monkeypatch):
    # Without suppression all places crowd about the first.
    use_geometry(monkeypatch, [true])
    places = likely_places(NumberedFrame(), {"position": position_oracle([true])}, 6)
    assert places.shape == (6, 3)
    gap = np.linalg.norm(places - true.pose.centre, axis=1)
    assert np.argmin(gap) == 0
    assert gap[0] < 6.0
    between = np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(6, dtype=bool)]
    assert between.min() >= 0.8 * pose_search.NEAR_MM


@pytest.mark.parametrize(
    ("places", "found"), [([[0.0, 0, 0], [1.0, 0, 0]], [[1.0, 0, 0]]), (np.zeros((0, 3)),) * 2]
)
def test_there_may_be_fewer_places_than_asked_for(monkeypatch, places, found):
    monkeypatch.setattr(pose_search, "_places", lambda frame: np.array(places))
    monkeypatch.setattr(pose_search, "_shell_features", lambda frame, points: points)
    flat = {"position": Oracle(1, lambda x: x[:, :1].copy())}
    np.testing.assert_array_equal(likely_places(NumberedFrame(), flat, 5), found)


def test_places_are_voxels_of_the_field_of_view(frame):
    places = pose_search._places(frame)
    assert len(places) > 50
    index = (places - frame.origin) @ frame.to_index.T
    assert np.all(index > -0.5)
    assert np.all(index < frame.shapes[0] - 0.5 + 4)
    level = frame.level(pose_search.GRID_LEVEL)
    assert len(places) <= level.size / 8 * 1.5


def test_a_place_looks_alike_from_all_sides(frame):
    # Shells about the middle of a ball: the same whatever the axes of the volume are.
    turned = ball_volume(
        [0.8] * 3, np.eye(3), POINT - 0.8 * np.array([27.5, 28.0, 29.0]), (56, 60, 58), [POINT], 5.0
    )
    a = pose_search._shell_features(frame, POINT[None])
    b = pose_search._shell_features(standard_frame(turned, 0), POINT[None])
    off = pose_search._shell_features(frame, POINT[None] + [8.0, 0, 0])
    assert np.abs(a - b).mean() < 0.3 * np.abs(a - off).mean()


def test_samples_are_rated_by_their_distance(shape, true, frame, monkeypatch):
    centred = true._replace(pose=replace(true.pose, centre=POINT[None]))
    monkeypatch.setattr(pose_search, "_shell_features", lambda frame, points: points)
    points, y = position_samples(labelled(centred, shape, frame=frame), 100)
    assert y.shape == (100, 1)
    gap = np.linalg.norm(points - POINT, axis=1)
    order = np.argsort(gap)
    assert np.all(np.diff(y[order, 0]) <= 1e-12)
    assert y[gap < 2.0].min() > 0.8
    assert y[gap > 20.0].max() < 0.05
    assert np.any(gap > 15.0)


def test_coefficients_and_tips_come_back_as_they_were_learned(shape, true):
    # What samples divide by the deviation or subtract is multiplied and added again.
    b = shape.coefficients(true.pose.local(true.vertices[None]))[0, :MODES]
    trees = {"shape": start_oracle([true], shape, MODES)}
    found, tips = starting_shape(NumberedFrame(), trees, true.pose.repeated(2), shape)
    assert found.shape == (2, MODES)
    np.testing.assert_allclose(found[1], b, atol=1e-9)
    np.testing.assert_allclose(tips[1], true.tips, atol=1e-9)
    # Seen from the true pose instead, all samples would say the same.
    x, y = shape_start_samples(labelled(true, shape, 1), 25)
    assert y.shape == (25, MODES + 6)
    here = Poses(*seen(x)[:3])
    tips = here.world(shape.tips + y[:, MODES:].reshape(-1, 2, 3))
    np.testing.assert_allclose(tips, np.tile(true.tips, (25, 1, 1)), atol=1e-9)
    assert np.std(y[:, MODES:], axis=0).min() > 0.3
    np.testing.assert_allclose(y[:, :MODES].mean(axis=0), b / shape.std[:MODES], atol=1.5)
