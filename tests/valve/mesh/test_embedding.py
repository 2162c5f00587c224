"""Material points in meshes: they are where they were, and move as the element moves."""

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.mechanics.body import box
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh, embed
from mvest.valve.mesh.structured import structured_mesh

TEMPLATE = Template()
NAMES = ("hex18", "hex27", "wedge12", "wedge18", "tet4", "tet10")
POINTS = np.random.default_rng(5).uniform(0, 1, (200, 3)) * [3.0, 2.0, 1.0]


def block(name):
    """A block of 3 x 2 x 1 mm whose cells are cubes of 1 mm: affine elements."""
    nodes, elements = box(name, (3, 2, 1), (3.0, 2.0, 1.0))
    return SolidMesh(
        nodes,
        elements,
        name,
        np.zeros(len(elements), dtype=int),
        ("tissue",),
        np.tile([1.0, 0.0, 0.0], (len(nodes), 1)),
        np.zeros((0, {"hex": 9, "wed": 6, "tet": 3 if name == "tet4" else 6}[name[:3]]), dtype=int),
    )


@pytest.mark.parametrize("name", NAMES)
def test_points_are_reproduced_and_linear_fields_are_exact(name):
    mesh = block(name)
    points = embed(mesh, POINTS)
    assert len(points) == 200
    np.testing.assert_allclose(points.weights.sum(axis=1), 1, atol=1e-13)
    np.testing.assert_allclose(points(mesh.nodes), POINTS, atol=1e-10)
    matrix, shift = np.random.default_rng(6).normal(size=(3, 3)), np.array([1.0, -2.0, 3.0])
    moved = points(mesh.nodes @ matrix.T + shift)
    np.testing.assert_allclose(moved, POINTS @ matrix.T + shift, atol=1e-9)
    # Elements with two nodes through the thickness are linear in z, tet4 in everything: there the
    # error of a quadratic over 1 mm is up to 1/4 mm².
    for power, exact in ((0, name != "tet4"), (2, name in ("hex27", "wedge18", "tet10"))):
        error = np.abs(points(mesh.nodes[:, power] ** 2) - POINTS[:, power] ** 2).max()
        assert error < 1e-9 if exact else error > 0.05
    # Points inside stay inside their host.
    reference = mesh.reference
    assert np.all((points.host >= 0) & (points.host < len(mesh.elements)))
    np.testing.assert_array_equal(points.nodes, mesh.elements[points.host])
    assert reference.n_nodes == points.weights.shape[1]


@pytest.mark.parametrize("name", ["hex18", "hex27", "tet4", "tet10"])
def test_the_vertices_of_a_valve_are_reproduced_in_every_mesh_of_it(name):
    # On curved elements the map is inverted by Newton's method; points that a coarse mesh cuts off
    # are extrapolated in the nearest element, and still reproduced.
    vertices = TEMPLATE.valve().surface.vertices
    mesh = structured_mesh(TEMPLATE, name, 36, 4)
    points = embed(mesh, vertices)
    np.testing.assert_allclose(points(mesh.nodes), vertices, atol=1e-7)
    angle = np.deg2rad(30)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    np.testing.assert_allclose(points(mesh.nodes @ turn.T), vertices @ turn.T, atol=1e-7)
    # Extrapolation is slight: a large weight would make the point swing with the element.
    assert np.abs(points.weights).max() < 3.0


def test_a_point_far_from_the_mesh_is_refused_with_its_place_and_distance():
    mesh = block("hex18")
    points = np.vstack([POINTS[:3], [[1.5, 1.0, 4.0]], POINTS[3:4]])
    with pytest.raises(
        GeometryError, match=r"point 3 at \[1\.5 1\.  4\. \] mm is outside the mesh"
    ):
        embed(mesh, points)
    # 0.3 mm above the block: within the tolerance of 1 mm, not within 0.1 mm.
    near = np.array([[1.5, 1.0, 1.3]])
    np.testing.assert_allclose(embed(mesh, near)(mesh.nodes), near, atol=1e-10)
    with pytest.raises(GeometryError, match=r"tolerance 0\.1 mm"):
        embed(mesh, near, tolerance=0.1)
    with pytest.raises(InputError, match=r"shape \(1, 3\), expected finite"):
        embed(mesh, np.full((1, 3), np.nan))


def test_a_point_beyond_a_thin_element_is_its_own_and_not_the_neighbours():
    # Two cells of 10 x 10 x 0.4 mm, of which the second gets thinner from where they meet.
    nodes, elements = box("hex18", (2, 1, 1), (20.0, 10.0, 0.4))
    nodes[:, 2] = (nodes[:, 2] - 0.2) * np.where(nodes[:, 0] > 10, 1 - 0.08 * (nodes[:, 0] - 10), 1)
    mesh = SolidMesh(
        nodes, elements, "hex18", np.zeros(2, dtype=int), ("tissue",),
        np.tile([1.0, 0.0, 0.0], (len(nodes), 1)), np.zeros((0, 9), dtype=int),
    )  # fmt: skip
    # 0.1 mm above the first cell, half a cell beyond its face; 2 mm before the second, which is
    # less of one.
    point = embed(mesh, np.array([[8.0, 5.0, 0.3]]))
    assert point.host.tolist() == [0]


def test_averages_are_weighted_sums_of_the_points():
    mesh = block("hex18")
    points = embed(mesh, POINTS[:6])
    # The last two entries of the second row are padding.
    coefficients = np.array([[0.25, 0.5, 0.25], [1.0, 0.0, 0.0], [-0.5, 0.5, 1.0]])
    groups = np.array([[0, 1, 2], [3, 0, 0], [4, 5, 4]])
    averages = points.average(coefficients, groups)
    assert isinstance(averages, Embedding)
    assert len(averages) == 3
    assert averages.host.tolist() == [-1, -1, -1]
    np.testing.assert_allclose(averages.weights.sum(axis=1), 1, atol=1e-12)
    x = mesh.nodes + 0.1 * np.random.default_rng(8).normal(size=mesh.nodes.shape)
    y = points(x)
    expected = np.einsum("gs,gsi->gi", coefficients, y[groups])
    np.testing.assert_allclose(averages(x), expected, atol=1e-12)
    # No node twice in a row but for padding of weight zero: a row may be scattered without sums.
    for nodes, weights in zip(averages.nodes, averages.weights, strict=True):
        assert len(np.unique(nodes[weights != 0])) == np.count_nonzero(weights)
    again = averages.average(np.array([[0.5, 0.5]]), np.array([[0, 1]]))
    np.testing.assert_allclose(again(x), 0.5 * (expected[:1] + expected[1:2]), atol=1e-12)
