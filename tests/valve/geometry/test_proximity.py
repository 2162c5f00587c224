import numpy as np
import pytest

from mvest.valve.geometry.proximity import (
    closest_points,
    has_intersections,
    intersecting_triangles,
    plane_section,
)

ONE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("point", "distance", "barycentric"),
    [
        ([0.25, 0.25, 2.0], 2.0, [0.5, 0.25, 0.25]),  # over the face
        ([-1.0, -1.0, 0.0], np.sqrt(2), [1, 0, 0]),  # corners
        ([3.0, 0.0, 0.0], 2.0, [0, 1, 0]),
        ([0.0, 3.0, 0.0], 2.0, [0, 0, 1]),
        ([0.5, -1.0, 0.0], 1.0, [0.5, 0.5, 0]),  # edges
        ([-1.0, 0.5, 0.0], 1.0, [0.5, 0, 0.5]),
        ([1.0, 1.0, 0.0], np.sqrt(0.5), [0, 0.5, 0.5]),
    ],
)
def test_closest_point_in_every_region_of_a_triangle(point, distance, barycentric):
    found = closest_points(np.array([point]), ONE, np.array([[0, 1, 2]]))
    assert found.distance[0] == pytest.approx(distance, abs=1e-14)
    np.testing.assert_allclose(found.barycentric[0], barycentric, atol=1e-14)


def test_closest_points_are_those_of_a_full_search(shapes):
    rng = np.random.default_rng(0)
    vertices, triangles = shapes.sphere(2.0, 2)
    # A few huge triangles among small ones, so that the nearest centroid is not the nearest face.
    vertices = np.concatenate([vertices, [[-9, -9, 3], [9, -9, 3], [0, 30, 3]]])
    triangles = np.concatenate(
        [triangles, [[len(vertices) - 3, len(vertices) - 2, len(vertices) - 1]]]
    )
    points = rng.normal(size=(300, 3)) * 3
    found = closest_points(points, vertices, triangles)
    every = np.array(
        [closest_points(points, vertices, triangles[[t]]).distance for t in range(len(triangles))]
    )
    np.testing.assert_allclose(found.distance, every.min(axis=0), rtol=1e-12)
    foot = found.interpolate(vertices, triangles)
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), found.distance, rtol=1e-12)


def test_intersections_are_found_with_their_numbers(shapes):
    first = shapes.plate([0, 0, 0], [1, 0, 0], [0, 1, 0], 1)
    through = shapes.plate([0.6, 0.2, -0.5], [0, 0.1, 0], [0, 0, 1], 1)
    aside = shapes.plate([5, 0, -0.5], [0, 1, 0], [0, 0, 1], 1)
    vertices, triangles, _ = shapes.join(first, through, aside)
    assert has_intersections(vertices, triangles)
    # The crossing plate meets z = 0 on x = 0.6, y in 0.2..0.3, inside triangle 0 (y < x) only.
    np.testing.assert_array_equal(intersecting_triangles(vertices, triangles), [[0, 2], [0, 3]])
    vertices, triangles, _ = shapes.join(first, aside)
    assert not has_intersections(vertices, triangles)
    assert intersecting_triangles(vertices, triangles).shape == (0, 2)


def test_plane_section_of_a_sphere_is_a_great_circle(shapes):
    vertices, triangles = shapes.sphere(2.0, 4)
    segments, _ = plane_section(vertices, triangles, np.zeros(3), np.array([0.0, 0, 1]))
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * 2, rel=2e-3)
    np.testing.assert_allclose(segments[..., 2], 0, atol=1e-12)
