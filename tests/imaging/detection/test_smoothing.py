"""Smoothing in time: what goes, what stays, and by whose weight."""

import numpy as np

from mvest.imaging.detection.smoothing import smooth_in_time

UNEVEN = np.array([0.0, 0.02, 0.03, 0.07, 0.08, 0.13, 0.15])
S = np.array([0.0, 0.5, 1.0])


def smooth(vertices, tips=None, weight=None, frame_weight=None, times=(0.06, 0.06, 0.06)):
    count = len(UNEVEN)
    return smooth_in_time(
        UNEVEN,
        vertices,
        np.zeros((count, 2, 3)) if tips is None else tips,
        np.ones(vertices.shape[:2]) if weight is None else weight,
        np.ones(count) if frame_weight is None else frame_weight,
        S,
        times,
    )


def test_motion_linear_in_time_is_kept_exactly_at_uneven_times():
    # Second differences over frames instead of seconds bend it.
    rng = np.random.default_rng(0)
    start, speed = rng.standard_normal((2, 3, 3)) * 10
    line = start + UNEVEN[:, None, None] * speed * 10
    weight = rng.uniform(0.05, 1.0, (len(UNEVEN), 3))
    vertices, tips = smooth(line, line[:, :2], weight, weight[:, 0])
    np.testing.assert_allclose(vertices, line, atol=1e-7)
    np.testing.assert_allclose(tips, line[:, :2], atol=1e-7)


def test_no_smoothing_is_none_at_all():
    x = np.random.default_rng(0).standard_normal((len(UNEVEN), 3, 3))
    vertices, tips = smooth(x, x[:, :2], times=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(vertices, x)
    np.testing.assert_array_equal(tips, x[:, :2])
    # The annulus alone: the free edge stays as it is, what is in between moves a little.
    x = np.repeat(x[:, :1], 3, 1)
    vertices, _ = smooth(x, times=(0.06, 0.0, 0.0))
    np.testing.assert_allclose(vertices[:, 2], x[:, 2], atol=1e-9)
    moved = np.abs(vertices - x).mean(axis=(0, 2))
    assert moved[0] > moved[1] > 0.01


def test_an_unsure_frame_is_drawn_to_its_neighbours_and_a_sure_one_less():
    # Weights that do not count, or count the other way round, are seen here.
    x = np.zeros((len(UNEVEN), 3, 3))
    x[3] = 5.0
    weight = np.ones((len(UNEVEN), 3))
    weight[3] = [1.0, 1.0, 0.01]
    vertices, _ = smooth(x, weight=weight, times=(0.02, 0.02, 0.02))
    assert vertices[3, 2, 0] < 0.5
    assert vertices[3, 0, 0] > 2 * vertices[3, 2, 0]
    assert np.abs(vertices[[0, 6], 2]).max() < 0.3


def test_weights_count_relative_to_the_others():
    x = np.random.default_rng(0).standard_normal((len(UNEVEN), 3, 3))
    rng = np.random.default_rng(1)
    weight = rng.uniform(0.2, 1.0, (len(UNEVEN), 3))
    np.testing.assert_allclose(
        smooth(x, weight=weight)[0], smooth(x, weight=0.3 * weight)[0], atol=1e-9
    )


def test_fast_changes_go_and_slow_ones_stay():
    # Smoothing over 0.06 s: a wave of 0.03 s goes, one of 1.5 s stays.
    times = 0.01 * np.arange(60)
    slow, fast = (np.sin(2 * np.pi * times / period) for period in (1.5, 0.03))
    x = np.stack([slow, fast, slow + fast], axis=1)[..., None] * np.ones(3)
    found, _ = smooth_in_time(
        times, x, np.zeros((60, 2, 3)), np.ones((60, 3)), np.ones(60), S, (0.06, 0.06, 0.0)
    )
    inner = slice(10, -10)
    np.testing.assert_allclose(found[inner, 0], x[inner, 0], atol=0.06)
    assert np.abs(found[inner, 1]).max() < 0.05
    np.testing.assert_allclose(found[:, 2], found[:, 0] + found[:, 1], atol=1e-9)


def test_two_frames_are_left_as_they_are():
    x = np.random.default_rng(0).standard_normal((2, 3, 3))
    found, tips = smooth_in_time(
        np.array([0.0, 0.1]), x, x[:, :2], np.ones((2, 3)), np.ones(2), S, (0.1, 0.1, 0.1)
    )
    np.testing.assert_array_equal(found, x)
    np.testing.assert_array_equal(tips, x[:, :2])
