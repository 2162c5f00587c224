"""All frames together: path, smoothing in time, no valve; and the fit of one frame."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.imaging.detection import pose_search, tracking
from mvest.imaging.detection.detect import NoValveError, fit_frame
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.tracking import detect_valve, smooth_in_time
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.volume import VolumeSequence
from tests.imaging.detection import made_up as made
from tests.imaging.detection.made_up import (
    NumberedFrame,
    oracle_model,
    placed,
    poses,
    use_geometry,
)

TIMES = np.array([0.0, 0.03, 0.05, 0.09])
FRAMES = [made.NumberedFrame(k) for k in range(4)]


@pytest.fixture
def unsmoothed(monkeypatch):
    monkeypatch.setattr(tracking, "SMOOTHING_S", (0.0, 0.0, 0.0))


@pytest.fixture
def truths(shape, monkeypatch):
    """A valve that moves and closes a little over four frames, which oracles know."""
    rng = np.random.default_rng(3)
    pose, b = made.poses(1, 2), rng.standard_normal(8) * 0.5 * shape.std[:8]
    found = []
    for k in range(len(TIMES)):
        moved = pose.moved(np.array([[0.4 * k, -0.3 * k, 0.5 * k, 0, 0.01 * k, 0, 0.0]]))
        b = b.copy()
        b[0] = (0.3 * k - 0.4) * shape.std[0]
        found.append(made.placed(shape, moved, b))
    made.use_geometry(monkeypatch, found)
    monkeypatch.setattr(tracking, "standard_frame", lambda volume, k: made.NumberedFrame(k))
    return found


def volume(count=4):
    grey, times = np.zeros((count, 1, 1, 1), np.uint8), TIMES[:count]
    return VolumeSequence(grey, np.ones(3), np.eye(3), np.zeros(3), times, source="made up.nrrd")


def detected(shape, truths, frames=4, *, min_confidence=0.7, progress=None, **of):
    """What oracles make of a volume."""
    model = made.oracle_model(shape, truths, **of)
    return detect_valve(volume(frames), model, min_confidence=min_confidence, progress=progress)


# --- whole sequences ----------------------------------------------------------------------------


def test_the_valve_is_found_in_every_frame(shape, truths, unsmoothed):
    # Frames or their confidences in the wrong order fail here.
    told = []
    found = detected(shape, truths, progress=lambda done, all_: told.append((done, all_)))
    for k, true in enumerate(truths):
        gaps = [np.linalg.norm(found.vertices[k] - t.vertices, axis=1).mean() for t in truths]
        assert gaps[k] < 0.35
        assert np.argmin(gaps) == k
        np.testing.assert_allclose(found.tips[k], true.tips, atol=0.05)
    np.testing.assert_array_equal(found.times, TIMES)
    assert np.all(found.frame_confidence > 0.9)
    assert found.vertex_confidence.shape == (4, made.LAYOUT.size)
    assert told == [(k + 1, 4) for k in range(4)]
    assert np.all(np.isnan(found.std_mm))
    assert np.isnan(found.correlation_length_mm)
    # A single frame is enough.
    found = detected(shape, truths, 1)
    assert np.linalg.norm(found.vertices[0] - truths[0].vertices, axis=1).mean() < 0.35


def test_the_measured_accuracy_goes_with_the_sequence_wider_for_low_confidence(shape, truths):
    n = made.LAYOUT.size
    rng = np.random.default_rng(0)
    samples, tips = rng.standard_normal((3, 2, n, 3)), rng.standard_normal((3, 2, 2, 3))
    accuracy = DetectionAccuracy(np.linspace(1, 2, n), 7.5, samples, tips)
    found = detected(shape, truths, accuracy=accuracy)
    # Smoothing leaves a steady motion where it is.
    for x, true in zip(found.vertices, truths, strict=True):
        assert np.linalg.norm(x - true.vertices, axis=1).mean() < 0.5
    accuracy = replace(accuracy, widening=(1.2, 2.0))
    found = detected(shape, truths, min_confidence=0.0, best=0.3, accuracy=accuracy, seen=0.6)
    factor = 1.2 * np.exp(2.0 * (1.0 - np.median(found.frame_confidence)))
    assert factor > 1.25
    np.testing.assert_allclose(found.std_mm, factor * accuracy.std_mm)
    assert found.correlation_length_mm == 7.5


def test_a_lost_frame_is_found_again_from_its_neighbours(shape, truths):
    # Its own search ended elsewhere; two frames in a row are found one after the other.
    model = made.oracle_model(shape, truths)
    valves = [fit_frame(FRAMES[k], model, truths[k].pose) for k in range(4)]
    for k in (1, 2):
        away = valves[k].pose.moved(np.array([[30.0, 0, 0, 0, 0, 0, 0]]))
        x = valves[k].vertices + 30.0
        valves[k] = replace(valves[k], pose=away, vertices=x, confidence=0.4)
    tracking._refit_lost_frames(FRAMES, valves, model)
    for k, true in enumerate(truths):
        assert np.linalg.norm(valves[k].vertices - true.vertices, axis=1).mean() < 0.6


def test_detectors_that_believe_in_nothing_find_no_valve(shape, truths):
    with pytest.raises(NoValveError, match="no valve") as told:
        detected(shape, truths, best=0.05, seen=0.05)
    assert "made up.nrrd" in str(told.value)
    assert "\n" not in str(told.value)
    candidate = told.value.candidate
    assert candidate.frame_confidence.max() < 0.6
    assert len(candidate.times) == len(volume().times)
    detected(shape, truths, min_confidence=0.01, best=0.05, seen=0.05)


# --- the path -----------------------------------------------------------------------------------


def hypotheses(centres, ratings):
    count, centres = len(centres), np.asarray(centres, float)
    return Poses(centres, np.tile(np.eye(3), (count, 1, 1)), np.zeros(count)), np.asarray(ratings)


def test_the_consistent_hypothesis_is_taken_though_one_frame_rates_another_higher(shape, truths):
    # Each frame by itself would jump 20 mm away and back.
    model = made.oracle_model(shape, truths)
    both = [0.0, 0, 0], [20.0, 0, 0]
    frames = [hypotheses(both, ratings) for ratings in ([0.9, 0.5], [0.6, 0.8], [0.9, 0.5])]
    times = np.array([0.0, 0.02, 0.04])
    assert tracking._best_path(frames, times, model) == [0, 0, 0]
    # Were there minutes in between, it could have moved.
    assert tracking._best_path(frames, 1e3 * times, model) == [0, 1, 0]
    # A middle frame offers nothing but a place far away: an unbounded cost would take all there.
    here, there = [0.0, 0, 0], [200.0, 0, 0]
    frames = [hypotheses([here, there], [0.9, 0.1])] * 2
    frames += [hypotheses([there], [0.9]), *[hypotheses([there, here], [0.1, 0.9])] * 2]
    assert tracking._best_path(frames, 0.02 * np.arange(5), model) == [0, 0, 0, 1, 1]


UNEVEN = np.array([0.0, 0.02, 0.03, 0.07, 0.08, 0.13, 0.15])


def smooth(points, weight=None, times=(0.06, 0.06, 0.06)):
    weight = np.ones(points.shape[:2]) if weight is None else weight
    return smooth_in_time(UNEVEN, points, weight, np.asarray(times))


def test_motion_linear_in_time_is_kept_exactly_at_uneven_times():
    # Second differences over frames instead of seconds bend it.
    rng = np.random.default_rng(0)
    start, speed = rng.standard_normal((2, 3, 3)) * 10
    line = start + UNEVEN[:, None, None] * speed * 10
    found = smooth(line, rng.uniform(0.05, 1.0, (len(UNEVEN), 3)))
    np.testing.assert_allclose(found, line, atol=1e-7)


def test_an_unsure_frame_is_drawn_to_its_neighbours_and_a_sure_one_less():
    # Weights that do not count, or count the other way round, fail here.
    x = np.zeros((len(UNEVEN), 3, 3))
    x[3] = 5.0
    weight = np.ones((len(UNEVEN), 3))
    weight[3] = [1.0, 1.0, 0.01]
    found = smooth(x, weight, (0.02, 0.02, 0.02))
    assert found[3, 2, 0] < 0.5
    assert found[3, 0, 0] > 2 * found[3, 2, 0]
    assert np.abs(found[[0, 6], 2]).max() < 0.3
    # Weights are relative.
    np.testing.assert_allclose(found, smooth(x, 0.3 * weight, (0.02, 0.02, 0.02)), atol=1e-9)


def fitted(shape, true, pose=None, **more):
    return fit_frame(NumberedFrame(), oracle_model(shape, [true]), pose or true.pose, **more)


def test_a_shape_that_no_valve_has_is_believed_less(shape, monkeypatch):
    # Seen as well as any, but three deviations from the mean along every mode.
    believed = []
    for far in (0.0, 3.0):
        strained = placed(shape, poses(1, 2), far * shape.std[:8])
        use_geometry(monkeypatch, [strained])
        believed.append(fitted(shape, strained).confidence)
    assert believed[1] < believed[0] - 0.3


def test_hypotheses_that_are_about_the_same_count_once():
    base = made.poses(1, 3)
    by = np.zeros((5, 7))
    by[1, 0], by[2, 3], by[3, 5], by[4, 1] = 1.0, 0.05, 1.0, 12.0
    some = base.repeated(5).moved(by)
    kept = some.apart(np.array([0.5, 0.9, 0.7, 0.8, 0.6]), 5)
    # 1 is best; 0 and 2 lie upon it; 3 is turned by 57 degrees and 4 is 12 mm away.
    np.testing.assert_array_equal(kept, [1, 3, 4])
    np.testing.assert_array_equal(some.apart(np.array([0.5, 0.9, 0.7, 0.8, 0.6]), 2), [1, 3])


def test_frames_without_a_field_of_view_show_no_valve(shape, truths, monkeypatch):
    monkeypatch.setattr(pose_search, "_places", lambda frame: np.zeros((0, 3)))
    with pytest.raises(NoValveError, match="no valve found"):
        detected(shape, truths)
