"""Surfaces drawn finer: what they keep, and how much nearer they are to what is curved."""

import numpy as np
import pytest

from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import directed_edges, refined

VALVE = Template().valve(40, 11)
REST, TRIANGLES = VALVE.surface.vertices, VALVE.surface.triangles


@pytest.fixture(scope="module")
def fine():
    return refined(REST, TRIANGLES, 0.6, (VALVE.free_edge, VALVE.annulus))


def test_vertices_stay_and_edges_become_short(fine):
    drawn = fine.weights @ REST
    np.testing.assert_array_equal(drawn[: len(REST)], REST)
    ends = drawn[directed_edges(fine.triangles)]
    assert np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)) <= 0.6
    assert len(fine.triangles) == len(fine.parent) == 16 * len(TRIANGLES)
    # Each part lies on the triangle of which it is one.
    middle = drawn[fine.triangles].mean(axis=1)
    apart = np.linalg.norm(middle - REST[TRIANGLES[fine.parent]].mean(axis=1), axis=1)
    assert apart.max() < 3.0


def test_what_is_linear_stays_so(fine):
    flat = REST * [1.0, 1.0, 0.0]
    plane = refined(flat, TRIANGLES, 0.6)
    A = np.random.default_rng(1).normal(size=(3, 3))
    np.testing.assert_allclose(plane.weights @ (flat @ A), (plane.weights @ flat) @ A, atol=1e-12)
    np.testing.assert_allclose(fine.weights @ np.ones(len(REST)), 1.0, atol=1e-12)
    assert np.abs((plane.weights @ flat)[:, 2]).max() == 0.0


def test_a_sphere_is_drawn_with_a_tenth_of_the_error_of_its_facets():
    # A cap of a sphere of radius 5 mm under edges of 1.2 mm: facets are h² / 8 r = 0.04 mm off.
    x, y = (v.ravel() for v in np.meshgrid(*2 * (np.linspace(-3, 3, 6),)))
    cap = np.column_stack([x, y, np.sqrt(25.0 - x**2 - y**2)])
    a = (np.arange(5)[:, None] * 6 + np.arange(5)).ravel()
    triangles = np.concatenate(
        [np.column_stack([a, a + 1, a + 7]), np.column_stack([a, a + 7, a + 6])]
    )
    fine = refined(cap, triangles, 0.2)
    u = np.random.default_rng(2).uniform(-1.5, 1.5, (400, 2))
    points = np.column_stack([u, np.sqrt(25.0 - np.sum(u**2, axis=1))])
    of_facets = closest_points(points, cap, triangles).distance
    drawn = closest_points(points, fine.weights @ cap, fine.triangles).distance
    assert of_facets.mean() > 0.02
    assert drawn.mean() < 0.1 * of_facets.mean()
