"""Meshes in the elements of FEBio.

Laws as FEBio has them, worked out here by its formulas.
"""

import re
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from mvest.exchange.febio.document import FebDocument, febio_law, opposite_faces
from mvest.mechanics.body import box, outer_faces
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.valve.mesh.solid_mesh import SolidMesh
from tests.exchange.febio.program import febio_mesh

# Where FEBio's shape functions of hex27 are one, from FESolidElementShape.cpp: a factor 0.5 r (r+1)
# is one at r = 1, 0.5 r (r-1) at r = -1 and 1 - r^2 at r = 0.
HEX27 = """-1-1-1 +1-1-1 +1+1-1 -1+1-1 -1-1+1 +1-1+1 +1+1+1 -1+1+1 0-1-1 +10-1 0+1-1 -10-1
0-1+1 +10+1 0+1+1 -10+1 -1-10 +1-10 +1+10 -1+10 0-10 +100 0+10 -100 00-1 00+1 000"""


def written(given, folder):
    """Of the file of a body: FEBio's element, its nodes of each element, and of each face."""
    document = FebDocument(febio_mesh(given), [febio_law(A)], 1.0, 1.0, 1e-9)
    document.press(febio_mesh(given).pressure_faces, np.array([[0.0, 0.0], [1.0, 1.0]]))
    root = Xml.parse(document.write(folder / "a.feb")).getroot()

    def rows(elements):
        return np.array([[float(word) for word in e.text.split(",")] for e in elements])

    x, faces = rows(root.find("Mesh/Nodes")), root.find("Mesh/Surface")
    elements = root.find("Mesh/Elements")
    return (
        (elements.get("type"), x[rows(elements).astype(int) - 1]),
        (faces[0].tag, x[rows(faces).astype(int) - 1]),
    )


def mesh_of(kind, cells=(2, 3, 2), size=(2.0, 3.0, 1.0)):
    nodes, elements = box(kind, cells, size)
    faces = outer_faces(elements, kind)
    top = faces[np.all(np.isclose(nodes[faces][:, :, 2], size[2]), axis=1)]
    fibre = np.tile([1.0, 0.0, 0.0], (len(nodes), 1))
    return SolidMesh(nodes, elements, kind, np.zeros(len(elements), int), ("a",), fibre, top)


def test_nodes_of_a_brick_are_where_febio_has_them(tmp_path):
    (name, places), _ = written(mesh_of("hex18", (1, 1, 1), (2.0, 2.0, 2.0)), tmp_path)
    corners = np.array(re.findall(r"[-+]?\d", HEX27), dtype=float).reshape(27, 3)
    assert name == "hex27"
    np.testing.assert_allclose(places[0] - 1, corners, atol=1e-12)


def test_nodes_of_a_wedge_are_where_febio_has_them(tmp_path):
    (name, places), _ = written(mesh_of("wedge12", (1, 1, 1)), tmp_path)
    assert name == "penta15"
    x = places[0]
    for low, high, middle in ((0, 3, 12), (1, 4, 13), (2, 5, 14)):
        np.testing.assert_allclose(x[middle], (x[low] + x[high]) / 2)
        assert x[low, 2] < x[high, 2]
    for k in range(3):
        for base, middle in ((0, 6), (3, 9)):
            ends = x[base + k] + x[base + (k + 1) % 3]
            np.testing.assert_allclose(x[middle + k], ends / 2)


@pytest.mark.parametrize("kind", ["hex18", "hex27", "tet10", "wedge12", "wedge18"])
def test_the_other_side_is_as_large_and_looks_the_other_way(kind):
    mesh = febio_mesh(mesh_of(kind))
    faces = opposite_faces(mesh)
    assert len(faces) == len(mesh.pressure_faces)
    x = mesh.nodes[faces]
    assert np.allclose(x[:, :, 2], 0.0)
    corners = mesh.nodes[faces[:, [0, 2, 8]]] if faces.shape[1] == 9 else x[:, :3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    assert np.all(normal[:, 2] < 0)


A = TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.LITERAL)
C = TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.NEARLY_INCOMPRESSIBLE)


@pytest.mark.parametrize("material", [A, C])
def test_the_orthotropic_stiffness_is_the_same(material):
    p = febio_law(material, "orthotropic")
    # FEOrthoElastic::EvaluateLameCoefficients: the compliance that it inverts.
    s = np.array(
        [
            [1 / p["E1"], -p["v12"] / p["E1"], -p["v31"] / p["E3"]],
            [-p["v12"] / p["E1"], 1 / p["E2"], -p["v23"] / p["E2"]],
            [-p["v31"] / p["E3"], -p["v23"] / p["E2"], 1 / p["E3"]],
        ]
    )
    np.testing.assert_allclose(np.linalg.inv(s), material.stiffness[:3, :3], rtol=1e-12)
    shear = [p["G23"], p["G31"], p["G12"]]
    np.testing.assert_allclose(shear, np.diag(material.stiffness)[3:], rtol=1e-12)
