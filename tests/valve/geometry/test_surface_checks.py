import numpy as np
import pytest

from mvest.errors import GeometryError
from mvest.valve.anatomy.valve import LeafletSurface, lumped_areas, lumped_areas_change
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume
from mvest.valve.geometry.thickening import (
    FACE_KINDS,
    smooth_normals_change,
    smooth_vertex_normals,
    thicken,
)


def leaflet(shapes, vertices, triangles, thickness=1.2):
    n = len(vertices)
    region = (vertices[triangles].mean(axis=1)[:, 0] > 0).astype(int)
    names = ("posterior", "anterior")
    fibre = np.tile([0.0, 1.0, 0.0], (n, 1))
    return LeafletSurface(vertices, triangles, region, names, fibre, np.full(n, thickness))


def bow_tie(shapes):
    # Two boxes that share one corner only.
    vertices, triangles = shapes.box()
    other = triangles + 8
    both = np.concatenate([vertices, vertices + 1.0])
    other[other == 8] = 6
    return both, np.concatenate([triangles, other])


def crossed(shapes):
    first = shapes.box()
    second = shapes.box()
    vertices, triangles, _ = shapes.join(first, (second[0] + [0.4, 0.3, 0.2], second[1]))
    return vertices, triangles


def flipped_one(shapes):
    vertices, triangles = shapes.box()
    triangles[5] = triangles[5, ::-1]
    return vertices, triangles


BAD = {
    "non-manifold vertex: .*vertices 6": bow_tie,
    "self-intersection: triangles": crossed,
    "inconsistent orientation: .*5": flipped_one,
    r"non-manifold edge: .*\[0, 4\]": lambda s: (
        np.concatenate([s.box()[0], [[-1.0, -1, 0]]]),
        np.concatenate([s.box()[1], [[0, 4, 8]]]),
    ),
    "not finite: vertices 3": lambda s: (
        np.where(np.arange(24).reshape(8, 3) == 10, np.nan, s.box()[0]),
        s.box()[1],
    ),
    "degenerate triangle: triangles 12": lambda s: (
        np.concatenate([s.box()[0], [[2.0, 0, 0], [3, 0, 0], [4, 0, 0]]]),
        np.concatenate([s.box()[1], [[8, 9, 10]]]),
    ),
    "duplicate triangle: triangles 0": lambda s: (
        s.box()[0],
        np.concatenate([s.box()[1], s.box()[1][:1, [1, 2, 0]]]),
    ),
    "open surface: 3 boundary edges": lambda s: (s.box()[0], s.box()[1][1:]),
    "inward normals: .*-1 mm": lambda s: (s.box()[0], s.box()[1][:, ::-1]),
    "index out of range: triangles": lambda s: (s.box()[0][:7], s.box()[1]),
    "no triangles": lambda s: (s.box()[0], np.zeros((0, 3), dtype=int)),
    "wrong shape: triangles .*float": lambda s: (s.box()[0], s.box()[1].astype(float)),
}


@pytest.mark.parametrize("message", BAD)
def test_each_fault_has_its_name_and_numbers(shapes, message):
    check_surface(*shapes.box(), closed=True)
    with pytest.raises(GeometryError, match="part: " + message):
        check_surface(*BAD[message](shapes), closed=True, name="part")


def test_volumes(shapes):
    assert enclosed_volume(*shapes.box((2.0, 3.0, 4.0))) == pytest.approx(24.0)
    vertices, triangles = shapes.sphere(2.0, 4)
    assert enclosed_volume(vertices + 100.0, triangles) == pytest.approx(
        4 / 3 * np.pi * 8, rel=3e-3
    )


def test_smoothing_keeps_the_normals_of_a_sphere_and_calms_noise(shapes):
    vertices, triangles = shapes.sphere(1.0, 3)
    exact = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    np.testing.assert_allclose(smooth_vertex_normals(vertices, triangles), exact, atol=0.03)
    noise = vertices * (1 + np.random.default_rng(0).uniform(-0.03, 0.03, (len(vertices), 1)))
    error = [
        np.linalg.norm(smooth_vertex_normals(noise, triangles, k) - exact, axis=1).max()
        for k in (0, 10)
    ]
    assert error[1] < 0.5 * error[0]


def test_thickened_plate_is_a_box(shapes):
    # 10 x 8 plate, 1.2 thick: volume 96, rim 2 (10 + 8) x 1.2 = 43.2.
    vertices, triangles = shapes.plate([-5, -4, 0], [10, 0, 0], [0, 8, 0], 6)
    closed = thicken(leaflet(shapes, vertices, triangles))
    assert enclosed_volume(closed.vertices, closed.triangles) == pytest.approx(96.0)
    corners = closed.vertices[closed.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    by_kind = {name: area[closed.kind == i].sum() for i, name in enumerate(FACE_KINDS)}
    assert by_kind == pytest.approx({"ventricular": 80.0, "atrial": 80.0, "rim": 43.2})
    assert (cross[closed.kind == 0, 2] > 0).all()
    assert (cross[closed.kind == 1, 2] < 0).all()
    # Labels follow the midsurface triangles, on the rim too.
    x = corners.mean(axis=1)[:, 0]
    np.testing.assert_array_equal(closed.region, (x > 0).astype(int))


def test_normals_and_areas_change_with_the_vertices_as_differences_do(shapes):
    vertices, triangles = shapes.cone(15, 4, 12)
    moves = np.random.default_rng(0).normal(size=(*vertices.shape, 2))

    def difference(of):
        h = 1e-5
        sides = [[of(vertices + s * h * moves[..., k]) for k in range(2)] for s in (1, -1)]
        return np.stack([(a - b) / (2 * h) for a, b in zip(*sides, strict=True)], axis=-1)

    for rounds in (0, 5):
        normals, change = smooth_normals_change(vertices, triangles, rounds, moves)
        np.testing.assert_array_equal(normals, smooth_vertex_normals(vertices, triangles, rounds))
        exact = difference(lambda at, r=rounds: smooth_vertex_normals(at, triangles, r))
        np.testing.assert_allclose(change, exact, atol=1e-6)
    np.testing.assert_allclose(
        lumped_areas_change(vertices, triangles, moves),
        difference(lambda at: lumped_areas(at, triangles)),
        atol=1e-6,
    )
