"""How errors are measured: on surfaces whose distances are known."""

import numpy as np
import pytest
from mvest.imaging.detection.boundary import leaflet_axes
from mvest.imaging.detection.landmark_detector import landmark_points
from mvest.imaging.learning.evaluation import best_threshold, frame_errors, surface_distances

from mvest.imaging.detection.detect import FrameValve
from mvest.imaging.detection.shape_model import TrueValve
from mvest.imaging.layout import ValveLayout
from mvest.valve.anatomy.template import Template
from tests.imaging.detection.made_up import TIPS, poses

LAYOUT = ValveLayout(64, 15)


def tube(radius, height=20.0, turned=0.0, layout=LAYOUT):
    """A round tube about z; `turned` in degrees slides vertices along it."""
    angle = np.deg2rad(layout.phi + turned)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), -height * layout.s], axis=1)


def test_a_surface_is_at_no_distance_from_itself():
    x = Template().position(LAYOUT.phi, LAYOUT.s)
    for d in surface_distances(x, x, LAYOUT):
        np.testing.assert_allclose(d, 0, atol=1e-9)


def test_tubes_around_each_other_are_their_radii_apart():
    # Distances between vertices, or signed ones that cancel, are seen here.
    there, back = surface_distances(tube(15.0), tube(17.0), LAYOUT)
    np.testing.assert_allclose(there, 2.0, atol=0.03)
    np.testing.assert_allclose(back, 2.0, atol=0.03)
    assert there.shape == (LAYOUT.size,)


def test_an_offset_leaflet_is_at_the_offsets_distance():
    x = Template().position(LAYOUT.phi, LAYOUT.s)
    off = x + 0.8 * leaflet_axes(x, LAYOUT)[:, :, 2]
    there, back = surface_distances(off, x, LAYOUT)
    inner = (LAYOUT.s > 0.1) & (LAYOUT.s < 0.9)
    assert np.median(there[inner]) == pytest.approx(0.8, abs=0.02)
    assert np.median(back[inner]) == pytest.approx(0.8, abs=0.05)


def test_other_points_of_the_same_surface_are_at_no_distance():
    # Vertices slid along the surface by half a column: the points are far off, the surface is not.
    slid = tube(15.0, turned=0.5 * 360 / LAYOUT.columns)
    there, back = surface_distances(slid, tube(15.0), LAYOUT)
    points = np.linalg.norm(slid - tube(15.0), axis=1).mean()
    assert points > 0.7
    assert there.mean() < 0.05
    assert back.mean() < 0.05


def test_beyond_a_rim_the_distance_is_that_from_the_rim():
    # Tangent planes reach on without end: a leaflet too long would cost nothing.
    longer, whole = tube(15.0, 26.0), tube(15.0, 20.0)
    there, back = surface_distances(longer, whole, LAYOUT)
    np.testing.assert_allclose(there[LAYOUT.free_edge], 6.0, atol=0.05)
    np.testing.assert_allclose(there[LAYOUT.annulus], 0.0, atol=1e-6)
    assert back.max() < 0.05


def found_valve(true, vertices, tips, stages=None):
    return FrameValve(
        true.pose,
        true.pose,
        np.zeros(2),
        vertices,
        tips,
        1.0,
        np.ones(len(vertices)),
        {} if stages is None else stages,
    )


@pytest.fixture
def true():
    by = poses(1, 4)
    x = Template().position(LAYOUT.phi, LAYOUT.s)
    return TrueValve(by.world(x)[0], by.world(TIPS)[0], by)


def test_what_is_right_has_no_errors(true):
    errors = frame_errors(
        found_valve(true, true.vertices, true.tips), true.vertices, true.tips, true, LAYOUT
    )
    for name in ("surface", "points", "tips", "annulus", "free_edge", "position", "turn"):
        assert getattr(errors, name) == pytest.approx(0.0, abs=1e-6), name
    assert errors.log_scale == pytest.approx(0.0, abs=1e-9)


def test_each_error_is_of_its_own_part(true):
    # Rims exchanged, tips taken from the stages instead of what is handed on, and the like.
    annulus = true.vertices.copy()
    z = true.pose.rotation[0][:, 2]
    annulus[LAYOUT.annulus] += 2.0 * z
    tips = true.tips + np.array([[3.0, 0, 0], [0, 0, 0]])
    errors = frame_errors(found_valve(true, annulus, true.tips), annulus, tips, true, LAYOUT)
    assert errors.annulus == pytest.approx(2.0, abs=0.6)
    assert errors.annulus > 1.0
    assert errors.free_edge == pytest.approx(0.0, abs=1e-9)
    assert errors.tips == pytest.approx(1.5)
    assert errors.points == pytest.approx(2.0 / LAYOUT.rows)
    assert 0.0 < errors.surface < errors.points


def test_rims_are_compared_across_their_course(true):
    # Every vertex on to the next: the curve is the same, its points are not.
    on = np.roll(true.vertices.reshape(LAYOUT.rows, LAYOUT.columns, 3), 1, axis=1).reshape(-1, 3)
    half = 0.5 * (on + true.vertices)
    errors = frame_errors(found_valve(true, half, true.tips), half, true.tips, true, LAYOUT)
    assert errors.annulus == pytest.approx(0.0, abs=1e-9)
    assert errors.free_edge == pytest.approx(0.0, abs=1e-9)
    assert errors.points > 0.4


def test_the_pose_it_began_with_is_measured_in_mm_and_degrees(true):
    start = true.pose.moved(np.array([[3.0, 0, 4.0, 0, 0.2, 0, -0.1]]))
    found = FrameValve(
        start, true.pose, np.zeros(2), true.vertices, true.tips, 1.0, np.ones(LAYOUT.size), {}
    )
    errors = frame_errors(found, true.vertices, true.tips, true, LAYOUT)
    assert errors.position == pytest.approx(5.0)
    assert errors.turn == pytest.approx(np.rad2deg(0.2))
    assert errors.log_scale == pytest.approx(0.1)


def test_stages_are_compared_with_vertices_or_landmarks(true):
    stages = {
        "a shape": true.vertices + np.array([0, 3.0, 4.0]),
        "landmarks": landmark_points(true, LAYOUT) + np.array([1.0, 0, 0]),
    }
    errors = frame_errors(
        found_valve(true, true.vertices, true.tips, stages),
        true.vertices, true.tips, true, LAYOUT,
    )  # fmt: skip
    assert errors.stages == pytest.approx({"a shape": 5.0, "landmarks": 1.0})


def test_the_threshold_separates_right_from_wrong():
    right, wrong = np.array([0.6, 0.8, 0.9]), np.array([0.1, 0.4])
    assert best_threshold(right, wrong) == pytest.approx(0.5)
    # One outlier does not move it.
    assert 0.4 < best_threshold(np.array([0.3, 0.8, 0.9]), wrong) < 0.8
