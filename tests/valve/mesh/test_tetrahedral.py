"""Tetrahedral meshes: what fills its surface, and what of a mesher's answer is refused."""

import numpy as np
import pytest

from mvest.elements import element
from mvest.errors import ConfigurationError, GeometryError, MeshingError
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_checks import enclosed_volume
from mvest.valve.mesh import tetwild as module
from mvest.valve.mesh.cells import outer_faces, with_middles
from mvest.valve.mesh.given import tetrahedral_leaflets
from mvest.valve.mesh.tetwild import orient, tetrahedralize, volumes

COARSE = 1.0
"""mm, edge length."""


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    """Meshes made once for all tests, as a study would keep them."""
    return tmp_path_factory.mktemp("meshes")


def test_mesh_fills_its_surface(shapes, store):
    vertices, triangles = shapes.box((4.0, 3.0, 2.0))
    nodes, tetrahedra = tetrahedralize(vertices, triangles, COARSE, store)
    size = volumes(nodes, tetrahedra)
    assert size.min() > 0
    assert size.sum() == pytest.approx(enclosed_volume(vertices, triangles), rel=0.02)
    faces = outer_faces(tetrahedra, "tet4")
    assert closest_points(nodes[np.unique(faces)], vertices, triangles).distance.max() <= 0.075
    assert closest_points(vertices, nodes, faces).distance.max() <= 0.1
    assert np.array_equal(np.unique(tetrahedra), np.arange(len(nodes)))


def test_the_mesher_needs_no_extra(shapes, store, tmp_path, monkeypatch):
    # A package of this name that cannot be imported hides the one that may be installed.
    (tmp_path / "pyvista.py").write_text("raise ModuleNotFoundError('pyvista')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    _, tetrahedra = tetrahedralize(*shapes.box((2.0, 2.0, 1.0)), COARSE, store)
    assert len(tetrahedra) > 0


def test_a_stored_mesh_is_read_back_and_nothing_is_meshed_again(shapes, store, monkeypatch):
    vertices, triangles = shapes.box((4.0, 3.0, 2.0))
    first = tetrahedralize(vertices, triangles, COARSE, store)
    monkeypatch.setattr(module, "_mesh", lambda *_: pytest.fail("meshed again"))
    # Limits do not shape a mesh, so they do not make another of it; the edge length does.
    monkeypatch.setattr(module, "TIME_LIMIT", 5.0)
    for one, again in zip(first, tetrahedralize(vertices, triangles, COARSE, store), strict=True):
        np.testing.assert_array_equal(one, again)
    with pytest.raises(pytest.fail.Exception, match="meshed again"):
        tetrahedralize(vertices, triangles, 0.9, store)


def test_a_damaged_store_is_refused(shapes, tmp_path):
    vertices, triangles = shapes.box((4.0, 3.0, 2.0))
    name = f"tetwild-{module._key(vertices, triangles, COARSE)}.npz"
    (tmp_path / name).write_text("nonsense")
    with pytest.raises(MeshingError, match="unreadable"):
        tetrahedralize(vertices, triangles, COARSE, tmp_path)


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "killed by signal 11"),
        ("raise RuntimeError('no volume')", "exit status 1: RuntimeError: no volume"),
        ("import time; time.sleep(60)", "longer than 1 s"),
        (
            "import sys, numpy as np; np.savez(sys.argv[2], nodes=np.zeros((4, 3)),"
            "tetrahedra=np.arange(4)[None])",
            "flat tetrahedra",
        ),
        (
            "import sys, numpy as np; np.savez(sys.argv[2], nodes=np.eye(4, 3),"
            "tetrahedra=np.arange(4)[None])",
            "at most 5%",
        ),
    ],
)
def test_a_mesher_that_fails_is_one_clear_error(shapes, tmp_path, monkeypatch, script, message):
    worker = tmp_path / "worker.py"
    worker.write_text(script)
    monkeypatch.setattr(module, "WORKER", worker)
    monkeypatch.setattr(module, "TIME_LIMIT", 1.0)
    with pytest.raises(MeshingError, match=message):
        tetrahedralize(*shapes.box((4.0, 3.0, 2.0)), COARSE, tmp_path / "store")
    assert not list((tmp_path / "store").glob("*.npz"))


def test_a_faulty_surface_never_reaches_the_mesher(shapes, monkeypatch):
    monkeypatch.setattr(module, "_mesh", lambda *_: pytest.fail("meshed"))
    vertices, triangles = shapes.box()
    with pytest.raises(GeometryError, match="open surface"):
        tetrahedralize(vertices, triangles[:-1], COARSE)
    with pytest.raises(ConfigurationError, match="edge_length = nan"):
        tetrahedralize(vertices, triangles, np.nan)


# A unit cube cut into five tetrahedra, two of them given with negative volume.
CUBE = (
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    [[0, 1, 3, 4], [1, 2, 3, 6], [1, 5, 6, 4], [3, 6, 7, 4], [1, 4, 6, 3]],
)


def test_orientation_faces_and_midside_nodes_of_a_cube():
    nodes, tetrahedra = np.array(CUBE[0], float), np.array(CUBE[1])
    tetrahedra = orient(nodes, tetrahedra)
    assert volumes(nodes, tetrahedra) == pytest.approx([1 / 6] * 4 + [1 / 3])
    faces = outer_faces(tetrahedra, "tet4")
    assert len(faces) == 12
    corners = nodes[faces]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(axis=1) - 0.5
    assert ((area * outward).sum(axis=1) > 0).all()
    np.testing.assert_allclose(area.sum(axis=0), 0, atol=1e-15)
    more, elements = with_middles(nodes, tetrahedra)
    assert len(more) == 8 + 18  # 12 cube edges and 6 face diagonals
    reference = element("tet10")
    x = np.einsum("qa,mai->mqi", reference.shape(reference.node_coordinates), more[elements])
    np.testing.assert_allclose(x, more[elements])
    linear = element("tet4").shape(reference.node_coordinates)
    np.testing.assert_allclose(x, np.einsum("qa,mai->mqi", linear, nodes[tetrahedra]))
    six = more[outer_faces(elements, "tet10")]
    np.testing.assert_array_equal(six[:, :3], corners)
    np.testing.assert_allclose(six[:, 3:], 0.5 * (six[:, :3] + six[:, [1, 2, 0]]))


@pytest.fixture(scope="session")
def funnel(shapes):
    """A funnel of two leaflets, fibres running round it."""
    vertices, triangles = shapes.cone(6.0, 4.0, 4.0, n=24, layers=3)
    angle = np.arctan2(vertices[:, 1], vertices[:, 0])
    fibre = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
    # Signs of fibres mean nothing, so a transfer must not depend on them.
    fibre[::2] *= -1
    region = (vertices[triangles].mean(axis=1)[:, 0] > 0).astype(int)
    return LeafletSurface(
        vertices, triangles, region, ("posterior", "anterior"), fibre, np.full(len(vertices), 1.2)
    )


@pytest.mark.parametrize("element_type", ["tet4", "tet10"])
def test_labels_fibres_and_faces_are_transferred(funnel, store, element_type):
    mesh = tetrahedral_leaflets(funnel, 1.5, element_type, store)
    corners = mesh.nodes[mesh.elements[:, :4]]
    x = corners.mean(axis=1)[:, 0]
    clear = np.abs(x) > 0.3
    np.testing.assert_array_equal(mesh.region[clear], (x > 0)[clear].astype(int))
    angle = np.arctan2(mesh.nodes[:, 1], mesh.nodes[:, 0])
    around = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
    along = (mesh.fibre * around[mesh.elements]).sum(axis=2)
    assert np.abs(along).min() > np.cos(np.radians(15))
    np.testing.assert_array_equal(np.abs(np.sign(along).sum(axis=1)), along.shape[1])
    faces = mesh.nodes[mesh.pressure_faces[:, :3]]
    normal = 0.5 * np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    area = np.linalg.norm(normal, axis=1)
    # The funnel's normals point outwards and down; the ventricle is outside of it.
    outward = faces.mean(axis=1) * [1, 1, 0]
    assert ((normal * outward).sum(axis=1) > 0).all()
    # Mean radius 5, its normal 0.894 radial: the outer side is (5 + 0.6 x 0.894) / 5 as large.
    assert area.sum() == pytest.approx(funnel.areas.sum() * 1.107, rel=0.03)
    assert mesh.pressure_faces.shape[1] == (3 if element_type == "tet4" else 6)
