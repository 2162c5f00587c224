import numpy as np
import pytest

from mvest.errors import GeometryError
from mvest.valve.measure.annulus import annulus_plane, measure_annulus
from mvest.valve.measure.clinical import leaflet_length, tenting
from mvest.valve.measure.coaptation import (
    coaptation_area,
    coaptation_depth,
    coaptation_length,
    orifice_area,
    touching_triangles,
)

BELOW = np.array([0.0, 0.0, 30.0])
FRONT = np.array([10.0, 0.0, 1.0])


def plane_of(annulus):
    return annulus_plane(annulus, BELOW, FRONT)


def polygon_area(radius, n):
    return 0.5 * n * radius**2 * np.sin(2 * np.pi / n)


def test_annulus_of_a_saddle_ellipse():
    # x = 14 cos a, y = 18 sin a, z = 3 cos 2a: AP 28, commissural 36, height 6.
    a = np.arange(720) * 2 * np.pi / 720
    annulus = np.column_stack([14 * np.cos(a), 18 * np.sin(a), 3 * np.cos(2 * a)])
    plane = plane_of(annulus)
    np.testing.assert_allclose(plane.normal, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(plane.lateral, [0, 1, 0], atol=1e-9)
    size = measure_annulus(annulus, plane)
    assert size.anteroposterior_diameter == pytest.approx(28, abs=1e-6)
    assert size.commissural_diameter == pytest.approx(36, abs=1e-6)
    assert size.height == pytest.approx(6, abs=1e-9)
    assert size.projected_area == pytest.approx(np.pi * 14 * 18, rel=1e-4)
    # Ramanujan's approximation of an ellipse's circumference, good to 1e-6 here.
    h = (4 / 32) ** 2
    ellipse = np.pi * 32 * (1 + 3 * h / (10 + np.sqrt(4 - 3 * h)))
    assert size.circumference > ellipse
    flat = annulus * [1, 1, 0]
    assert measure_annulus(flat, plane_of(flat)).circumference == pytest.approx(ellipse, rel=1e-4)


def test_orifice_of_a_disc_with_a_hole_and_without(shapes):
    # Hole of radius 5 in a disc of radius 15: the orifice is the 120-gon of radius 5.
    annulus = shapes.circle(15.0)
    plane = plane_of(annulus)
    vertices, triangles = shapes.bands([annulus, shapes.circle(10.0), shapes.circle(5.0)])
    area = orifice_area(vertices, triangles, annulus, plane, resolution=0.1)
    assert area == pytest.approx(polygon_area(5.0, 120), abs=0.3)
    vertices, triangles = shapes.bands([annulus, shapes.circle(5.0)], close=True)
    assert orifice_area(vertices, triangles, annulus, plane) == 0.0


def test_tenting_and_length_of_a_cone(shapes):
    # Cone radius 15, depth 12: volume pi r^2 h / 3, two flanks of sqrt(r^2 + h^2).
    vertices, triangles = shapes.cone(15.0, 1e-3, 12.0)
    annulus = vertices[:180]
    plane = plane_of(annulus)
    found = tenting(vertices, triangles, annulus, plane, resolution=0.1)
    assert found["tenting_height_mm"] == pytest.approx(12, abs=0.1)
    assert found["tenting_volume_mm3"] == pytest.approx(polygon_area(15, 180) * 12 / 3, rel=0.01)
    assert leaflet_length(vertices, triangles, plane) == pytest.approx(
        2 * np.hypot(15, 12), rel=1e-3
    )


def facing_plates(shapes, gap, height=10.0, width=12.0, n=24):
    """Anterior plate at x = gap/2, posterior at x = -gap/2, normals away from each other."""
    anterior = shapes.plate([gap / 2, -width / 2, 0], [0, width, 0], [0, 0, height], n)
    posterior = shapes.plate([-gap / 2, -width / 2, 0], [0, 0, height], [0, width, 0], n)
    return shapes.join(anterior, posterior)


def test_coaptation_of_parallel_plates(shapes):
    vertices, _, (first, second) = facing_plates(shapes, gap=1.2)
    plane = plane_of(shapes.circle(15.0))
    touching = coaptation_length(vertices, first, second, plane, contact_distance=1.3)
    assert touching == pytest.approx(10.0, abs=1e-9)
    assert coaptation_length(vertices, first, second, plane, 1.1) == 0.0
    assert coaptation_area(vertices, [first, second], 1.3) == pytest.approx(120.0)
    assert coaptation_area(vertices, [first, second], 1.1) == 0.0
    # Turned to face the same way, the two no longer count as opposing.
    assert coaptation_length(vertices, first, second[:, ::-1], plane, 1.3) == 0.0


def test_coaptation_of_a_wedge(shapes):
    # Plates open by 2 alpha at a common edge: the distance at s along a plate is s sin(2 alpha).
    alpha = np.radians(10)
    along = 10 * np.array([np.sin(alpha), 0, np.cos(alpha)])
    first = shapes.plate([0, -6, 0], [0, 12, 0], along, 20)
    second = shapes.plate([0, -6, 0], along * [-1, 1, 1], [0, 12, 0], 20)
    vertices, _, (a, b) = shapes.join(first, second)
    plane = plane_of(shapes.circle(15.0))
    length = coaptation_length(vertices, a, b, plane, contact_distance=1.3)
    assert length == pytest.approx(1.3 / np.sin(2 * alpha), abs=0.05)
    assert coaptation_area(vertices, [a, b], 1.3, subdivisions=6) == pytest.approx(
        12 * 1.3 / np.sin(2 * alpha), rel=0.03
    )


def test_the_coaptation_point_is_where_leaflets_first_touch(shapes):
    # The plates of a wedge that is closed below: they come within reach at the distance that is
    # reach / sin(2 alpha) from their common edge, 12 mm deep.
    alpha = np.radians(10)
    along = 10 * np.array([np.sin(alpha), 0, -np.cos(alpha)])
    first = shapes.plate([0, -6, 12], along, [0, 12, 0], 40)
    second = shapes.plate([0, -6, 12], [0, 12, 0], along * [-1, 1, 1], 40)
    vertices, triangles, (a, b) = shapes.join(first, second)
    plane = plane_of(shapes.circle(15.0))
    depth = coaptation_depth(vertices, a, b, plane, contact_distance=1.3)
    assert depth == pytest.approx(12 - 1.3 / np.sin(2 * alpha) * np.cos(alpha), abs=0.05)
    assert np.isnan(coaptation_depth(vertices, a, b[:, ::-1], plane, 1.3))
    # As deep, the material that touches: centroids nearer to the edge than the coaptation point.
    touching = touching_triangles(vertices, triangles, 1.3)
    z = vertices[triangles].mean(axis=1)[:, 2]
    assert z[touching].min() == pytest.approx(depth, abs=0.3)
    assert z[~touching].max() == pytest.approx(depth, abs=0.3)


def test_a_leaflet_that_is_folded_touches_itself(shapes):
    # A sheet folded over itself at x = 0: two flaps 1 mm apart, joined by a half-cylinder.
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    path = [(-x, -0.5) for x in np.linspace(6, 0.5, 12)]
    path += [(0.5 * np.cos(a), 0.5 * np.sin(a)) for a in turn]
    path += [(-x, 0.5) for x in np.linspace(0.5, 6, 12)]
    vertices, triangles = shapes.plate([0, 0, 0], [len(path) - 1, 0, 0], [0, 3, 0], len(path) - 1)
    at = np.rint(vertices[:, 0]).astype(int)
    folded = np.column_stack([np.array(path)[at, 0], vertices[:, 1], np.array(path)[at, 1]])
    flaps = folded[triangles].mean(axis=1)[:, 0] < -0.2
    assert touching_triangles(folded, triangles, 1.05)[flaps].all()
    assert not touching_triangles(folded, triangles, 0.95)[flaps].any()
    # The flat sheet touches nothing, however far the reach.
    assert not touching_triangles(vertices, triangles, 3.0).any()


@pytest.mark.parametrize(
    ("annulus", "below", "front", "message"),
    [
        (np.zeros((2, 3)), BELOW, FRONT, "shape"),
        (np.zeros((5, 3)), BELOW, FRONT, "coincide"),
        (np.linspace(0, 1, 5)[:, None] * [1, 1, 0], BELOW, FRONT, "one line"),
        ("circle", np.zeros(3), FRONT, "ventricle_point"),
        ("circle", BELOW, BELOW, "anterior_point"),
        ("nan", BELOW, FRONT, "not finite"),
    ],
)
def test_bad_annulus_is_one_clear_error(shapes, annulus, below, front, message):
    if isinstance(annulus, str):
        points = shapes.circle(15.0)
        if annulus == "nan":
            points[3, 1] = np.nan
    else:
        points = annulus
    with pytest.raises(GeometryError, match=message):
        annulus_plane(points, below, front)


@pytest.mark.parametrize("resolution", [0.0, 1e-6])
def test_bad_resolution_is_one_clear_error(shapes, resolution):
    annulus = shapes.circle(15.0)
    vertices, triangles = shapes.bands([annulus, shapes.circle(5.0)])
    plane = plane_of(annulus)
    with pytest.raises(GeometryError, match="resolution"):
        orifice_area(vertices, triangles, annulus, plane, resolution)
