"""The soap film in an annulus, against films that are known."""

import numpy as np
import pytest

from mvest.errors import GeometryError
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.annulus import annulus_plane, spanning_surface

ANGLE = np.arange(128) * 2 * np.pi / 128


def film(loop):
    plane = annulus_plane(loop, np.array([0, 0, -30.0]), np.array([0, 10.0, 0]))
    return spanning_surface(loop, plane), plane


@pytest.mark.parametrize("radius", [0.3, 0.5])
def test_enneper(radius):
    # Enneper's surface is minimal: area pi (R² + R⁴ + R⁶ / 3) over the parameters' disc.
    u, v = radius * np.cos(ANGLE), radius * np.sin(ANGLE)
    loop = 20 * np.stack([u - u**3 / 3 + u * v * v, v - v**3 / 3 + v * u * u, u * u - v * v], 1)
    exact = 400 * np.pi * (radius**2 + radius**4 + radius**6 / 3)
    (vertices, triangles), plane = film(loop)
    area = areas(vertices, triangles).sum()
    assert area == pytest.approx(exact, rel=1e-3)
    # The cone from the centre, as any other surface, is larger.
    spokes = np.cross(loop - plane.origin, np.roll(loop, -1, axis=0) - plane.origin)
    assert area < 0.5 * np.linalg.norm(spokes, axis=1).sum()


def test_a_flat_ellipse_keeps_its_own_area_wherever_it_lies():
    loop = np.stack([18 * np.cos(ANGLE), 14 * np.sin(ANGLE), 0 * ANGLE], 1)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    moved = loop @ turn.T + [3.0, -40.0, 7.0]
    plane = annulus_plane(moved, moved.mean(0) - turn[:, 2], moved[32])
    vertices, triangles = spanning_surface(moved, plane)
    polygon = 0.5 * 128 * 18 * 14 * np.sin(2 * np.pi / 128)
    assert areas(vertices, triangles).sum() == pytest.approx(polygon, rel=1e-9)
    np.testing.assert_allclose(vertices[:128], moved, atol=1e-9)


def test_a_curve_in_wrong_order_is_refused():
    loop = np.stack([18 * np.cos(ANGLE), 14 * np.sin(ANGLE), 0 * ANGLE], 1)
    loop[[3, 4]] = loop[[4, 3]]
    with pytest.raises(GeometryError, match="turns back at point"):
        film(loop)
