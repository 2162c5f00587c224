"""Layered meshes of the template: valid, closed, conforming, and of one and the same body."""

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mvest.elements import ELEMENTS, FACES
from mvest.errors import InputError
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.solid_mesh import jacobian_determinants
from mvest.valve.mesh.structured import structured_mesh

TEMPLATE = Template()
NAMES = ("hex18", "hex27", "tet4", "tet10")


def volume(mesh):
    e = mesh.reference
    determinants = jacobian_determinants(mesh.nodes, mesh.elements, e, e.points)
    return float((determinants @ e.weights).sum())


def face_vectors(mesh):
    """Normals times area (f, q, 3) of the pressure faces at their quadrature points."""
    face = FACES[mesh.reference.face]
    tangent = np.einsum("fai,qaj->fqij", mesh.nodes[mesh.pressure_faces], face.gradient)
    return np.cross(tangent[..., 0], tangent[..., 1]) * face.weights[:, None]


def faces_of(name):
    """Local nodes of each face, from where they lie in the reference element, and its corners."""
    xi = ELEMENTS[name].node_coordinates
    if name.startswith("tet"):
        on = [xi[:, 0] == 0, xi[:, 1] == 0, xi[:, 2] == 0, np.isclose(xi.sum(axis=1), 1)]
        corner = np.arange(len(xi)) < 4
    else:
        on = [xi[:, axis] == side for axis in range(3) for side in (-1, 1)]
        corner = np.all(np.abs(xi) == 1, axis=1)
    return [np.flatnonzero(o) for o in on], [np.flatnonzero(o & corner) for o in on]


def edges_of(name, corners):
    """Pairs of local corners of one face that an edge joins."""
    xi = ELEMENTS[name].node_coordinates
    return [
        (a, b)
        for a, b in combinations(corners, 2)
        if name.startswith("tet") or np.count_nonzero(xi[a] != xi[b]) == 1
    ]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(24, 3, 2), (36, 4, 1)])
def test_no_element_is_inverted_anywhere(name, size):
    mesh = structured_mesh(TEMPLATE, name, *size)
    e = mesh.reference
    points = np.concatenate([e.points, e.node_coordinates])
    assert jacobian_determinants(mesh.nodes, mesh.elements, e, points).min() > 0
    cells = size[0] * size[1] * size[2]
    assert len(mesh.elements) == (cells if name.startswith("hex") else 6 * cells)


@pytest.mark.parametrize(
    ("name", "layers"), [("hex18", 2), ("hex27", 1), ("tet4", 1), ("tet10", 2)]
)
def test_neighbours_share_whole_faces_and_the_boundary_is_closed(name, layers):
    mesh = structured_mesh(TEMPLATE, name, 12, 2, layers)
    every, corners = faces_of(name)
    shared = Counter(tuple(sorted(element[local])) for element in mesh.elements for local in every)
    assert set(shared.values()) == {1, 2}
    # Around 12 x 2 x layers cells lie atrial, ventricular and two rim faces per column; two
    # triangles each for tetrahedra.
    boundary = sum(1 for count in shared.values() if count == 1)
    assert boundary == (2 * 12 * 2 + 2 * 12 * layers) * (1 if name.startswith("hex") else 2)
    # Each edge of the boundary lies between two of its faces, which together are a torus:
    # V - E + F = 0.
    edges = Counter(
        tuple(sorted((element[a], element[b])))
        for element in mesh.elements
        for local, ends in zip(every, corners, strict=True)
        if shared[tuple(sorted(element[local]))] == 1
        for a, b in edges_of(name, ends)
    )
    assert set(edges.values()) == {2}
    assert len({v for edge in edges for v in edge}) - len(edges) + boundary == 0


def order(values, refinement=2.0):
    """Order of convergence from three values of meshes refined twice: log of the changes' ratio."""
    a, b, c = values
    return float(np.log((b - a) / (c - b)) / np.log(refinement))


def test_volumes_converge_to_that_of_the_body_whatever_the_element():
    # The normals' average makes the body only piecewise smooth (its kinks are 4 and 8 degrees from
    # the commissures), so that quadratic elements converge with the second order at least. Columns
    # narrower than 2 degrees would overlap at the ends of the free edge.
    fine = [volume(structured_mesh(TEMPLATE, "hex18", 40 * k, 8 * k)) for k in (1, 2, 4)]
    assert abs(fine[2] - fine[1]) < abs(fine[1] - fine[0]) / 4 < 1e-4 * fine[2]
    limit = fine[2]
    linear = [volume(structured_mesh(TEMPLATE, "tet4", 36 * k, 6 * k)) for k in (1, 2, 4)]
    assert order(linear) == pytest.approx(2, abs=0.3)
    assert linear[2] + (linear[2] - linear[1]) / 3 == pytest.approx(limit, rel=2e-4)
    for name in ("hex27", "tet10"):
        assert volume(structured_mesh(TEMPLATE, name, 96, 16)) == pytest.approx(limit, rel=5e-4)
    # Layers divide the same body: every node of two layers lies on straight thickness fibres.
    for name in ("hex18", "hex27", "tet4"):
        one, two = (volume(structured_mesh(TEMPLATE, name, 24, 4, n)) for n in (1, 2))
        assert two == pytest.approx(one, rel=1e-12)
    # Thickness times area: the midsurface of the fine template, and its tapered thickness.
    surface = TEMPLATE.valve(224, 57).surface
    assert limit == pytest.approx(float(surface.areas @ surface.thickness), rel=0.01)


@pytest.mark.parametrize(("name", "layers"), [("hex18", 2), ("tet4", 1), ("tet10", 1)])
def test_pressure_acts_on_the_whole_ventricular_face_from_outside(name, layers):
    # Linear faces cut the indentations: their area needs smaller cells.
    columns, rows = (54, 6) if name == "tet4" else (36, 4)
    mesh = structured_mesh(TEMPLATE, name, columns, rows, layers)
    vectors = face_vectors(mesh)
    expected = columns * rows * (1 if name.startswith("hex") else 2)
    assert len(mesh.pressure_faces) == expected
    assert len(np.unique(np.sort(mesh.pressure_faces, axis=1), axis=0)) == expected
    # Area: that of the triangulated face zeta = 1 of a fine sampling.
    j, i = (v.ravel() for v in np.meshgrid(np.arange(57), np.arange(224), indexing="ij"))
    triangles = TEMPLATE.valve(224, 57).surface.triangles
    outer = TEMPLATE.position(360 * i / 224, j / 56, 1.0)
    a, b, c = np.moveaxis(outer[triangles], 1, 0)
    face = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(face, axis=1).sum()
    tolerance = 2e-3 if name == "tet4" else 1e-3
    assert np.linalg.norm(vectors, axis=2).sum() == pytest.approx(area, rel=tolerance)
    # The force of a unit pressure depends on the rims alone.
    np.testing.assert_allclose(vectors.sum(axis=(0, 1)), 0.5 * face.sum(axis=0), atol=0.01 * area)
    # Out of the solid: away from the element that holds the face.
    holders = {tuple(sorted(e[local])): e for e in mesh.elements for local in faces_of(name)[0]}
    for nodes, normal in zip(mesh.pressure_faces, vectors.sum(axis=1), strict=True):
        inside = mesh.nodes[holders[tuple(sorted(nodes))]].mean(axis=0)
        assert normal @ (mesh.nodes[nodes].mean(axis=0) - inside) > 0


@pytest.mark.parametrize("name", ["hex18", "tet4"])
def test_elements_belong_to_the_leaflet_they_lie_in(name):
    mesh = structured_mesh(TEMPLATE, name, 36, 4)
    assert mesh.region_names == ("anterior", "posterior")
    assert np.bincount(mesh.region).tolist() == [len(mesh.elements) // 2] * 2
    surface = TEMPLATE.valve().surface
    middles = surface.vertices[surface.triangles].mean(axis=1)
    centres = mesh.nodes[mesh.elements].mean(axis=1)
    # Elements beside a commissure reach across it with their thickness: they are left out.
    distance, nearest = cKDTree(middles).query(centres)
    commissures = TEMPLATE.position(np.repeat([0.0, 180.0], 21), np.tile(np.linspace(0, 1, 21), 2))
    far = cKDTree(commissures).query(centres)[0] > 1.5
    assert far.mean() > 0.8
    assert np.all(distance < 1.5)
    np.testing.assert_array_equal(surface.region[nearest][far], mesh.region[far])


def test_the_hash_is_that_of_the_content():
    base = structured_mesh(TEMPLATE, "hex18", 12, 2).sha256
    assert structured_mesh(Template(), "hex18", 12, 2).sha256 == base
    turned = Template(TEMPLATE.parameters.changed({"leaflets.fibre_turn": 0.24}))
    for arguments in (
        (TEMPLATE, "hex18", 14, 2),
        (TEMPLATE, "hex27", 12, 2),
        (turned, "hex18", 12, 2),
    ):
        assert structured_mesh(*arguments).sha256 != base


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("hex18", 13, 2, 1), "mesh of 13 x 2 x 1 cells, expected a multiple of 2 >= 6"),
        (("hex18", 12, 0, 1), "mesh of 12 x 0 x 1 cells"),
        (("wedge12", 12, 2, 1), "no structured mesh of 'wedge12'; known: hex18"),
    ],
)
def test_what_cannot_be_meshed_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        structured_mesh(TEMPLATE, *arguments)
