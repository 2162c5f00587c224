"""The band of two leaflets: vertices, triangles and regions where other code takes them to be."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.valve.anatomy.template import Template


def normals(x, triangles):
    a, b, c = (x[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize(("columns", "rows"), [(16, 7), (20, 9), (64, 15)])
def test_vertices_and_triangles_are_those_of_the_template(columns, rows):
    layout = ValveLayout(columns, rows)
    surface = Template().valve(columns, rows).surface
    np.testing.assert_allclose(
        Template().position(layout.phi, layout.s), surface.vertices, rtol=0, atol=1e-9
    )
    np.testing.assert_array_equal(layout.triangles, surface.triangles)
    np.testing.assert_array_equal(layout.region, surface.region)


def test_rims_and_vertices_are_found_by_angle_and_row():
    layout = ValveLayout(16, 7)
    for rim, s in ((layout.annulus, 0), (layout.free_edge, 1)):
        assert np.all(layout.s[rim] == s)
        np.testing.assert_allclose(layout.phi[rim], 22.5 * np.arange(16))
    for phi, row in ((0.0, 0), (90.0, 3), (270.0, -1), (360.0, -1), (-90.0, 0)):
        vertex = layout.vertex(phi, row)
        assert layout.phi[vertex] == phi % 360
        assert layout.s[vertex] == pytest.approx((row % 7) / 6)
    with pytest.raises(InputError, match="at 10 degrees"):
        layout.vertex(10.0, 0)


@pytest.mark.parametrize(("columns", "rows"), [(4, 7), (18, 7), (16, 2)])
def test_a_layout_without_middles_is_refused(columns, rows):
    with pytest.raises(InputError, match="multiple of 4"):
        ValveLayout(columns, rows)


def test_places_are_found_where_phi_and_s_are_linear():
    layout = ValveLayout(16, 7)
    rng = np.random.default_rng(3)
    phi = np.concatenate([rng.uniform(-400.0, 400.0, 200), [0.0, 360.0, 22.5, 359.999]])
    s = np.concatenate([rng.uniform(size=200), [0.0, 1.0, 1.0, 0.5]])
    corners, weights = layout.locate(phi, s)
    assert weights.min() >= -1e-12
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    # Triangles of the layout, the same as are drawn and meshed.
    known = {tuple(sorted(t)) for t in layout.triangles.tolist()}
    assert all(tuple(sorted(t)) in known for t in corners.tolist())
    np.testing.assert_allclose((weights * layout.s[corners]).sum(axis=1), s, atol=1e-12)
    # Angles of the corners, unwrapped about the one asked for.
    near = phi[:, None] + np.mod(layout.phi[corners] - phi[:, None] + 180.0, 360.0) - 180.0
    np.testing.assert_allclose((weights * near).sum(axis=1), phi, atol=1e-9)
