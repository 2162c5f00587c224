"""Strains of leaflets that are stretched alike everywhere, and quantiles by area."""

import numpy as np
import pytest

from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.measure.strain import mean_strains, triangle_strains, weighted_quantiles


def sheet(shapes, fibre):
    """Two leaflets of a plate 6 mm by 4 mm in the plane x, y."""
    vertices, triangles = shapes.plate([0, 0, 0], [6, 0, 0], [0, 4, 0], 8)
    region = (vertices[triangles].mean(axis=1)[:, 0] > 3).astype(int)
    n = len(vertices)
    return LeafletSurface(
        vertices, triangles, region, ("one", "two"), np.tile(fibre, (n, 1)), np.ones(n)
    )


def test_an_affine_stretch_is_exact_in_every_triangle(shapes):
    # By hand: a line along a is |F a| times as long. Afterwards the sheet is turned in space.
    angle = 0.4
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    surface = sheet(shapes, along)
    F = np.array([[1.1, 0.2, 0.0], [-0.05, 0.9, 0.0], [0.0, 0.0, 1.0]])
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    found = triangle_strains(surface.vertices, surface.vertices @ (turn @ F).T, surface)
    expected = [np.linalg.norm(F @ a) - 1 for a in (along, across)]
    np.testing.assert_allclose(found, np.tile(expected, (len(found), 1)), atol=1e-12)


def test_means_weigh_triangles_by_their_area_at_rest(shapes):
    # A leaflet that stretches by 10 % on its wider part and not at all elsewhere.
    surface = sheet(shapes, [1.0, 0.0, 0.0])
    x = surface.vertices.copy()
    x[:, 0] = np.where(x[:, 0] > 0.75, 1.1 * x[:, 0] - 0.075, x[:, 0])
    along = mean_strains(surface.vertices, x, surface)[:, 0]
    np.testing.assert_allclose(along, [0.1 * 2.25 / 3, 0.1], atol=1e-12)


def test_quantiles_count_by_weight():
    values, weights = np.array([3.0, 1.0, 2.0, 4.0]), np.array([2.0, 5.0, 2.0, 1.0])
    assert weighted_quantiles(values, weights, (0.0, 0.5, 0.6, 0.9, 0.95, 1.0)) == [
        1.0, 1.0, 2.0, 3.0, 4.0, 4.0,
    ]  # fmt: skip
    # Triangles cut in two have the same quantiles.
    halves = weighted_quantiles(np.tile(values, 2), np.tile(weights / 2, 2), (0.3, 0.7, 0.95))
    assert halves == weighted_quantiles(values, weights, (0.3, 0.7, 0.95))
    rng = np.random.default_rng(2)
    many = rng.normal(size=100_000)
    median, high = weighted_quantiles(many, np.full(len(many), 0.1), (0.5, 0.95))
    assert (median, high) == pytest.approx((0.0, 1.645), abs=0.02)
