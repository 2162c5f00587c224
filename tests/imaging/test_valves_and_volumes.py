"""The layout of a valve, its named points, and the axes of a volume; inconsistent arrays."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import LANDMARKS, ValveSequence, landmark_vertices, landmarks
from mvest.imaging.volume import VolumeSequence
from mvest.valve.anatomy.template import Template
from tests.exchange.volumes.volumes import MIRRORED, ROTATION
from tests.made_up_sequence import descending_valve, sequence

LAYOUT = ValveLayout(16, 7)


@pytest.mark.parametrize(("columns", "rows"), [(16, 7), (64, 15)])
def test_vertices_and_triangles_are_those_of_the_template(columns, rows):
    layout = ValveLayout(columns, rows)
    surface = Template().valve(columns, rows).surface
    np.testing.assert_allclose(
        Template().position(layout.phi, layout.s), surface.vertices, rtol=0, atol=1e-9
    )
    np.testing.assert_array_equal(layout.triangles, surface.triangles)
    np.testing.assert_array_equal(layout.region, surface.region)


def test_points_are_located_where_phi_and_s_are_linear():
    rng = np.random.default_rng(3)
    phi = np.concatenate([rng.uniform(-400.0, 400.0, 200), [0.0, 360.0, 22.5, 359.999]])
    s = np.concatenate([rng.uniform(size=200), [0.0, 1.0, 1.0, 0.5]])
    corners, weights = LAYOUT.locate(phi, s)
    assert weights.min() >= -1e-12
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    # Triangles of the layout, the same as are drawn and meshed.
    known = {tuple(sorted(t)) for t in LAYOUT.triangles.tolist()}
    assert all(tuple(sorted(t)) in known for t in corners.tolist())
    np.testing.assert_allclose((weights * LAYOUT.s[corners]).sum(axis=1), s, atol=1e-12)
    # Angles of the corners, unwrapped about the requested one.
    near = phi[:, None] + np.mod(LAYOUT.phi[corners] - phi[:, None] + 180.0, 360.0) - 180.0
    np.testing.assert_allclose((weights * near).sum(axis=1), phi, atol=1e-9)


@pytest.mark.parametrize("kind", ["sequence", "moving"])
def test_arrays_of_other_shapes_and_times_that_do_not_increase_are_refused(kind):
    valve = sequence((1.0, 0.0), LAYOUT) if kind == "sequence" else descending_valve(LAYOUT)
    # With "a difference <= 0" as the test, times that are no numbers pass.
    for name, values in (
        ("vertices", valve.vertices[..., :2]), ("tips", valve.tips[:, :1]),
        ("times", np.array([0.1, 0.1])), ("times", np.array([0.0, np.nan])),
    ):  # fmt: skip
        with pytest.raises(InputError, match=name):
            replace(valve, **{name: values})


def test_every_landmark_is_where_its_name_says():
    expected = {
        **{f"commissure_{phi}": (phi, 0) for phi in (0, 180)},
        "annulus_anterior": (90, 0), "annulus_posterior": (270, 0),
        "free_edge_anterior": (90, 1), "free_edge_posterior": (270, 1),
        **{f"annulus_{phi}": (phi, 0) for phi in (45, 135, 225, 315)},
        **{f"tip_{phi}": (-1, phi) for phi in (0, 180)},
    }  # fmt: skip
    ones = np.ones((2, LAYOUT.size))
    # A position is (phi, s, frame).
    vertices = np.stack([np.stack([LAYOUT.phi, LAYOUT.s, t * ones[0]], axis=1) for t in range(2)])
    tips = np.array([[[-1.0, tip, t] for tip in (0.0, 180.0)] for t in range(2)])
    valve = ValveSequence(LAYOUT, np.arange(2.0), vertices, tips, ones[:, 0], ones, ones[0], 5.0)
    found = landmarks(valve, 1)
    assert tuple(found) == LANDMARKS == tuple(expected)
    for name, position in expected.items():
        np.testing.assert_allclose(found[name], (*position, 1), err_msg=name)
    with pytest.raises(InputError, match="frame 2, expected 0 to 1"):
        landmarks(valve, 2)
    with pytest.raises(InputError, match="no column of 12 lies at 45 degrees"):
        landmark_vertices(ValveLayout(12, 3))


@pytest.mark.parametrize("direction", [ROTATION, MIRRORED])
def test_a_step_along_an_axis_of_a_volume_is_its_column_times_its_spacing(direction):
    # Rows taken for columns, or the spacing of another axis, fail here.
    grey, spacing = np.zeros((1, 3, 4, 5), np.uint8), np.array([0.5, 1.0, 2.0])
    v = VolumeSequence(grey, spacing, direction, np.array([10.0, -20.0, 30.0]), np.zeros(1))
    np.testing.assert_allclose(v.world(np.zeros(3)), v.origin)
    for axis, step in enumerate(v.world(np.eye(3)) - v.origin):
        np.testing.assert_allclose(step, spacing[axis] * direction[:, axis], atol=1e-12)
    np.testing.assert_allclose(v.index(v.world(spacing)), spacing, atol=1e-12)
    with pytest.raises(InputError, match=r"frames: shape \(3, 4, 5\)"):
        replace(v, frames=grey[0])
    with pytest.raises(InputError, match=r"times: shape \(2,\)"):
        replace(v, times=np.array([0.0, 0.1]))
