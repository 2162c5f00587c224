"""Reference elements: what a shape function, a quadrature rule and a face must satisfy."""

from math import factorial

import numpy as np
import pytest

from mvest.elements import ELEMENTS, FACES, element
from mvest.errors import InputError
from mvest.mechanics.body import box, outer_faces

NAMES = tuple(ELEMENTS)


def inside(name, n=20):
    """Random points of the reference element."""
    random = np.random.default_rng(3)
    if name.startswith("tet"):
        return random.dirichlet(np.ones(4), n)[:, 1:]
    if name.startswith("wedge"):
        return np.column_stack([random.dirichlet(np.ones(3), n)[:, 1:], random.uniform(-1, 1, n)])
    return random.uniform(-1, 1, (n, 3))


@pytest.mark.parametrize("name", NAMES)
def test_shape_functions_sum_to_one_and_are_one_at_their_own_node(name):
    e = ELEMENTS[name]
    xi = inside(name)
    assert e.shape(xi).shape == (len(xi), e.n_nodes)
    np.testing.assert_allclose(e.shape(xi).sum(axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(e.gradient(xi).sum(axis=1), 0, atol=1e-13)
    np.testing.assert_allclose(e.shape(e.node_coordinates), np.eye(e.n_nodes), atol=1e-14)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_the_derivatives_of_the_shape_functions(name):
    e = ELEMENTS[name]
    xi, h = inside(name), 1e-5
    # Central differences of a polynomial of degree <= 5: error of the order h^2.
    for axis in range(3):
        step = h * np.eye(3)[axis]
        difference = (e.shape(xi + step) - e.shape(xi - step)) / (2 * h)
        np.testing.assert_allclose(e.gradient(xi)[:, :, axis], difference, atol=1e-9)


def monomial(name, a, b, c):
    """Integral of x^a y^b z^c over the reference element, in closed form."""
    line = 0.0 if c % 2 else 2 / (c + 1)
    if name.startswith("tet"):  # a! b! c! / (a + b + c + 3)!
        return factorial(a) * factorial(b) * factorial(c) / factorial(a + b + c + 3)
    if name.startswith("wedge"):  # a! b! / (a + b + 2)! in the triangle
        return factorial(a) * factorial(b) / factorial(a + b + 2) * line
    return (0.0 if a % 2 else 2 / (a + 1)) * (0.0 if b % 2 else 2 / (b + 1)) * line


# Highest exact degree: total (tetrahedra), in the plane and across (layered elements).
EXACT = {"tet4": (1, 1), "tet10": (2, 2), "hex18": (5, 3),
         "hex27": (5, 3), "wedge12": (4, 3), "wedge18": (4, 3)}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_quadrature_is_exact_to_its_degree_and_no_further(name):
    e = ELEMENTS[name]
    x, y, z = e.points.T
    plane, across = EXACT[name]
    for a in range(plane + 1):
        for b in range(plane + 1 if name.startswith("hex") else plane + 1 - a):
            for c in range((plane - a - b if name.startswith("tet") else across) + 1):
                value = np.sum(e.weights * x**a * y**b * z**c)
                np.testing.assert_allclose(value, monomial(name, a, b, c), atol=1e-13)
    # One degree more must fail, otherwise this test could not tell a rule from a better one.
    degree = plane + 1
    assert abs(np.sum(e.weights * x**degree) - monomial(name, degree, 0, 0)) > 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_a_point_near_to_one_outside_is_of_the_element(name):
    e = ELEMENTS[name]
    own = inside(name)
    np.testing.assert_allclose(e.inside(own), own, atol=1e-15)
    away = e.centre + np.random.default_rng(3).normal(scale=2.0, size=(50, 3))
    near = e.inside(away)
    assert np.all(e.outside(near) <= 1e-12)
    out = e.outside(away) > 0
    assert np.all(np.abs(near - away)[out].max(axis=1) > 0)


@pytest.mark.parametrize("name", ["hex18", "wedge12", "hex27"])
def test_enhanced_modes_do_no_work_on_a_constant_stress(name):
    # Patch test condition of enhanced strains: the modes integrate to zero over the element.
    e = ELEMENTS[name]
    modes = e.enhanced(e.points)
    if modes.shape[1]:
        np.testing.assert_allclose(e.weights @ modes, 0, atol=1e-14)
    expected = {"hex18": 4, "wedge12": 3, "hex27": 0}
    assert modes.shape[1] == expected[name]


@pytest.mark.parametrize("name", NAMES)
def test_outer_faces_enclose_the_volume(name):
    # Divergence theorem: integral of z n_z over the closed surface is the volume. Of layered
    # elements only top and bottom are faces, but on a block these are the ones with n_z != 0.
    nodes, elements = box(name, (2, 3, 2), (2.0, 3.0, 1.5))
    nodes += np.array([0.3, -0.2, 0.4])
    faces = outer_faces(elements, name)
    face = FACES[ELEMENTS[name].face]
    x = nodes[faces]
    tangent = np.einsum("fai,qaj->fqij", x, face.gradient)
    normal = np.cross(tangent[..., 0], tangent[..., 1])
    z = np.einsum("qa,fa->fq", face.shape, x[:, :, 2])
    assert np.sum(z * normal[..., 2] * face.weights) == pytest.approx(9.0, rel=1e-12)


@pytest.mark.parametrize("name", tuple(FACES))
def test_face_tables(name):
    face = FACES[name]
    np.testing.assert_allclose(face.shape.sum(axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(face.gradient.sum(axis=1), 0, atol=1e-13)
    assert face.weights.sum() == pytest.approx(4.0 if name == "quad9" else 0.5)
    assert np.array_equal(np.unique(face.corners), np.arange(face.n_nodes))


@pytest.mark.parametrize("name", [n for n in NAMES if ELEMENTS[n].layered])
def test_top_face_is_the_face_at_zeta_one(name):
    e = ELEMENTS[name]
    assert np.all(e.node_coordinates[e.top_face, 2] == 1)
    # The same in-plane order as the face element, or pressure would act on a crumpled face.
    face = FACES[e.face]
    plane = e.node_coordinates[e.top_face, :2]
    tangent = np.einsum("ai,qaj->qij", plane, face.gradient)
    np.testing.assert_allclose(np.linalg.det(tangent), 1, atol=1e-13)


def test_an_unknown_element_names_the_known_ones():
    with pytest.raises(InputError, match=r"hex20.*known elements: tet4, tet10"):
        element("hex20")
