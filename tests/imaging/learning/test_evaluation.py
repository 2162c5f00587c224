"""How errors are measured: on surfaces whose distances are known."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.imaging.detection.detect import FrameValve
from mvest.imaging.detection.leaflets import landmark_points, leaflet_axes
from mvest.imaging.detection.shape_model import TrueValve
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import best_threshold, frame_errors, surface_distance
from mvest.valve.anatomy.template import Template
from tests.imaging.detection.made_up import TIPS, poses

LAYOUT = ValveLayout(64, 15)


def tube(radius, height=20.0, turned=0.0, layout=LAYOUT):
    """A round tube about z; `turned` in degrees slides vertices along it."""
    angle = np.deg2rad(layout.phi + turned)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), -height * layout.s], axis=1)


def test_a_surface_is_at_no_distance_from_itself():
    x = Template().position(LAYOUT.phi, LAYOUT.s)
    assert surface_distance(x, x, LAYOUT) == pytest.approx(0, abs=1e-9)


def test_tubes_around_each_other_are_their_radii_apart():
    # Distances between vertices, or signed ones that cancel, are seen here.
    assert surface_distance(tube(15.0), tube(17.0), LAYOUT) == pytest.approx(2.0, abs=0.03)


def test_an_offset_leaflet_is_at_the_offsets_distance():
    x = Template().position(LAYOUT.phi, LAYOUT.s)
    off = x + 0.8 * leaflet_axes(x, LAYOUT)[:, :, 2]
    assert surface_distance(off, x, LAYOUT) == pytest.approx(0.8, abs=0.05)


def test_other_points_of_the_same_surface_are_at_no_distance():
    # Vertices slid along the surface by half a column: the points are far off, the surface is not.
    slid = tube(15.0, turned=0.5 * 360 / LAYOUT.columns)
    assert np.linalg.norm(slid - tube(15.0), axis=1).mean() > 0.7
    assert surface_distance(slid, tube(15.0), LAYOUT) < 0.05


def test_beyond_a_rim_the_distance_is_that_from_the_rim():
    # Tangent planes reach on without end: a leaflet too long would cost nothing.
    # The last 6 of 26 mm reach beyond: rows at 0.43, 2.29, 4.14 and 6 mm, of 15, there alone.
    found = surface_distance(tube(15.0, 26.0), tube(15.0, 20.0), LAYOUT)
    assert found == pytest.approx(0.5 * (0.43 + 2.29 + 4.14 + 6.0) / 15, abs=0.02)


def found_valve(true, **changed):
    right = FrameValve(
        true.pose, true.pose, np.zeros(2), true.vertices, true.tips, 1.0, np.ones(LAYOUT.size),
        landmark_points(true, LAYOUT),
    )  # fmt: skip
    return replace(right, **changed)


@pytest.fixture
def true():
    by = poses(1, 4)
    x = Template().position(LAYOUT.phi, LAYOUT.s)
    return TrueValve(by.world(x)[0], by.world(TIPS)[0], by)


def test_what_is_right_has_no_errors(true):
    for name, error in frame_errors(found_valve(true), true, LAYOUT).items():
        assert error == pytest.approx(0.0, abs=1e-6), name


def test_each_error_is_of_its_own_part(true):
    # Rims exchanged, tips taken from the landmarks instead of what is found, and the like.
    vertices = true.vertices.copy()
    vertices[LAYOUT.annulus] += 2.0 * true.pose.rotation[0][:, 2]
    found = found_valve(
        true,
        start=true.pose.moved(np.array([[3.0, 0, 4.0, 0, 0.2, 0, -0.1]])),
        vertices=vertices,
        tips=true.tips + np.array([[3.0, 0, 0], [0, 0, 0]]),
        landmarks=landmark_points(true, LAYOUT) + np.array([1.0, 0, 0]),
    )
    errors = frame_errors(found, true, LAYOUT)
    assert 1.0 < errors["hinge"] < 2.6
    assert errors["tips"] == pytest.approx(1.5)
    assert errors["points"] == pytest.approx(2.0 / LAYOUT.rows)
    assert 0.0 < errors["surface"] < errors["points"]
    assert errors["landmarks"] == pytest.approx(1.0)
    assert errors["position"] == pytest.approx(5.0)
    assert errors["pose"] == pytest.approx(np.rad2deg(0.2))


def test_the_hinge_is_compared_across_its_course(true):
    # Every vertex half way on to the next: the curve is the same, its points are not.
    on = np.roll(true.vertices.reshape(LAYOUT.rows, LAYOUT.columns, 3), 1, axis=1).reshape(-1, 3)
    errors = frame_errors(found_valve(true, vertices=0.5 * (on + true.vertices)), true, LAYOUT)
    assert errors["hinge"] == pytest.approx(0.0, abs=1e-9)
    assert errors["points"] > 0.4


def test_the_threshold_separates_right_from_wrong():
    right, wrong = np.array([0.6, 0.8, 0.9]), np.array([0.1, 0.4])
    assert best_threshold(right, wrong) == pytest.approx(0.5)
    # One outlier does not move it.
    assert 0.4 < best_threshold(np.array([0.3, 0.8, 0.9]), wrong) < 0.8
