import numpy as np
import pytest

from mvest.elements import ELEMENTS
from mvest.errors import InputError
from mvest.valve.mesh.cells import mesh_quality


def ideal(name):
    """Regular tetrahedron, equilateral prism of unit edges, or cube of edge 2."""
    x = ELEMENTS[name].node_coordinates
    if name.startswith("hex"):
        return x.copy()
    plane = x[:, :2] @ np.array([[1.0, 0.0], [0.5, np.sqrt(3) / 2]])
    if name.startswith("wedge"):
        return np.column_stack([plane, 0.5 * x[:, 2]])
    apex = np.array([0.5, np.sqrt(3) / 6, np.sqrt(2 / 3)])
    return np.column_stack([plane, np.zeros(len(x))]) + x[:, 2:] * apex


VOLUME = {"tet": 1 / np.sqrt(72), "wed": np.sqrt(3) / 4, "hex": 8.0}


@pytest.mark.parametrize("name", ELEMENTS)
def test_ideal_element_scores_one(name):
    nodes = ideal(name)
    report = mesh_quality(nodes, np.arange(len(nodes))[None], name)
    assert report.min_scaled_jacobian == pytest.approx(1.0)
    assert report.max_aspect == pytest.approx(1.0)
    assert report.volume == pytest.approx(VOLUME[name[:3]])
    assert (report.non_positive_at_points, report.non_positive_at_nodes) == (0, 0)


@pytest.mark.parametrize("name", ELEMENTS)
def test_mirrored_element_is_counted_and_named(name):
    good = ideal(name)
    bad = good * [1, 1, -1] + [5, 0, 0]
    k = len(good)
    report = mesh_quality(np.concatenate([good, bad]), np.arange(2 * k).reshape(2, k), name)
    assert report.min_scaled_jacobian == pytest.approx(-1.0)
    assert (report.non_positive_at_points, report.non_positive_at_nodes) == (1, 1)
    assert report.worst == (1, 0)


def test_a_fold_at_a_node_shows_although_every_quadrature_point_is_good():
    nodes = ideal("tet10")
    nodes[4] += 0.3 * (nodes[1] - nodes[0])  # midside node beyond the quarter point
    report = mesh_quality(nodes, np.arange(10)[None], "tet10")
    assert report.non_positive_at_points == 0
    assert report.non_positive_at_nodes == 1


def test_aspect_of_a_flat_brick():
    nodes = ideal("hex18") * [2.0, 1.0, 0.25]
    report = mesh_quality(nodes, np.arange(18)[None], "hex18")
    assert report.max_aspect == pytest.approx(8.0)
    assert report.min_scaled_jacobian == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("nodes", "elements", "name", "message"),
    [
        (np.zeros((4, 3)), np.zeros((0, 4), int), "tet4", "shape"),
        (np.zeros((4, 3)), np.arange(4)[None], "tet10", "expected .m, 10."),
        (np.zeros((4, 2)), np.arange(4)[None], "tet4", "nodes: shape"),
        (np.full((4, 3), np.nan), np.arange(4)[None], "tet4", "finite"),
        (np.zeros((3, 3)), np.arange(4)[None], "tet4", "0 to 2"),
        (np.zeros((4, 3)), np.arange(4)[None], "brick", "unknown element"),
    ],
)
def test_bad_input_is_one_clear_error(nodes, elements, name, message):
    with pytest.raises(InputError, match=message):
        mesh_quality(nodes, elements, name)
