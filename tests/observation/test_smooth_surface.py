"""Surfaces that are drawn finer and smoothed: right, without creases, and differentiable."""

import numpy as np
import pytest

from mvest.estimation import Prediction
from mvest.observation.surfaces import (
    UNKNOWN,
    ObservedSurface,
    PredictedSurface,
    SurfaceObservation,
)
from mvest.observation.vertices import vertex_sets
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.moving_distance import smooth_distances, smooth_offsets

VALVE = Template().valve(40, 11)
REST = VALVE.surface.vertices
SURFACE = VALVE.surface
FINE = PredictedSurface.of_valve(VALVE, 0.3, 0.5)


def moved(m):
    """A valve that bends and shifts with three parameters, and its derivatives."""
    x, y, z = REST.T
    a, b, c = m
    shape = np.column_stack([x + np.sin(0.2 * z + a), y * np.cosh(0.3 * b), z + c + 0.05 * a * x])
    slope = np.zeros((len(REST), 3, 3))
    slope[:, 0, 0] = np.cos(0.2 * z + a)
    slope[:, 1, 1] = 0.3 * y * np.sinh(0.3 * b)
    slope[:, 2, 0] = 0.05 * x
    slope[:, 2, 2] = 1.0
    return shape, slope


def model(m):
    shape, slope = moved(m)
    still = np.zeros((slope.size // 3, 3))
    return Prediction(
        np.concatenate([REST.ravel(), shape.ravel()]),
        np.concatenate([still, slope.reshape(-1, 3)]),
    )


def seen(points, region, **more):
    return ObservedSurface("closed", points, region, **more)


def observation(count=80, off=0.6, seed=1):
    rng = np.random.default_rng(seed)
    picked = rng.integers(0, len(SURFACE.triangles), count)
    corners = moved(np.zeros(3))[0][SURFACE.triangles[picked]]
    points = np.einsum("qc,qci->qi", rng.dirichlet(np.ones(3), count), corners)
    points += off * rng.normal(size=points.shape)
    edge = VALVE.surface.vertices[VALVE.free_edge] + off * rng.normal(size=(40, 3))
    own = np.repeat([0, 1], 20)
    own[[0, 19, 20, 39]] = UNKNOWN
    only = seen(points, SURFACE.region[picked], free_edge=edge, free_edge_region=own)
    return SurfaceObservation((only,), FINE, 0.5)


def slope_errors(step):
    predict = observation().of(model)
    m = np.array([0.1, 0.7, -0.2])
    exact = predict(m).jacobian
    columns = [(predict(m + step * e).y - predict(m - step * e).y) / (2 * step) for e in np.eye(3)]
    return np.abs(np.column_stack(columns) - exact).max()


def test_derivatives_are_those_of_differences_everywhere():
    # Points at all distances, beyond borders and at bends: none is left out.
    # Below steps of 5e-3 the rounding of the smoothed surface prevails.
    coarse, fine = slope_errors(4e-2), slope_errors(1e-2)
    assert fine < 2e-4
    assert coarse / fine == pytest.approx(16.0, rel=0.3)


def test_beyond_a_border_the_surface_goes_on():
    # A square in the plane z = 0: nothing happens where a point passes its border.
    x, y = (v.ravel() for v in np.meshgrid(*2 * (np.linspace(0, 5, 26),)))
    a = (np.arange(25)[:, None] * 26 + np.arange(25)).ravel()
    triangles = np.concatenate(
        [np.column_stack([a, a + 1, a + 27]), np.column_stack([a, a + 27, a + 26])]
    )
    square = np.column_stack([x, y, 0 * x])
    points = np.array([[5.0 + t, 2.0, z] for t in (-1, 0.5, 2) for z in (-0.3, 1e-3, 2.0)])
    shift = np.broadcast_to(np.eye(3), (len(square), 3, 3))
    distance, shifted = smooth_distances(points, square, shift, triangles, 0.5)
    np.testing.assert_allclose(distance, points[:, 2], atol=1e-12)
    np.testing.assert_allclose(shifted, np.tile([0.0, 0.0, -1.0], (9, 1)), atol=1e-12)


def test_an_edge_is_compared_with_that_of_its_own_leaflet():
    # Two lines 1 mm apart; the point lies nearer to the second, to which it does not belong.
    t = np.linspace(-5, 5, 101)
    two = np.concatenate(
        [np.column_stack([t, 0 * t, 0 * t]), np.column_stack([t[::-1], 0 * t + 1, 0 * t])]
    )
    point = np.array([[0.03, 0.8, 0.2]])
    across = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    still = np.zeros((202, 3, 1))
    own = np.arange(202)[None] < 101
    with_own = smooth_offsets(point, across, two, still, 0.5, own)[0]
    np.testing.assert_allclose(with_own, [0.8, 0.2], atol=1e-12)
    assert smooth_offsets(point, across, two, still, 0.5)[0][0] < 0.5


def test_sets_of_vertices():
    # Vertices row by row, the annulus first.
    rows = {name: members.reshape(7, 12) for name, members in vertex_sets(12, 7).items()}
    assert rows["all vertices"].all()
    assert [int(r.any()) for r in rows["belly (middle third)"]] == [0, 0, 1, 1, 1, 0, 0]
    assert [int(r.any()) for r in rows["free edge"]] == [0, 0, 0, 0, 0, 0, 1]
    assert [int(r.any()) for r in rows["annulus and free edge"]] == [1, 0, 0, 0, 0, 0, 1]
    assert rows["20 landmarks"].sum(axis=1).tolist() == [0, 0, 0, 10, 0, 0, 10]
