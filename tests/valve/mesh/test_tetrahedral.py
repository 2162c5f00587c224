""""""

import numpy as np
import pytest

from mvest.elements import ELEMENTS, element
from mvest.errors import ConfigurationError, GeometryError, InputError, MeshingError
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.mesh import tetwild as module
from mvest.valve.mesh.cells import (
    content_sha256,
    mesh_quality,
    orient,
    outer_faces,
    promote_to_tet10,
    tri6_faces,
    volumes,
)
from mvest.valve.mesh.given import label_tetrahedra, tetrahedral_leaflets
from mvest.valve.mesh.tetwild import TetwildSettings, tetrahedralize

COARSE = TetwildSettings(edge_length=1.0, envelope=0.01)


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    """Meshes made once for all tests, as a study would keep them."""
    return tmp_path_factory.mktemp("meshes")


@pytest.mark.parametrize("name", ["box", "sphere"])
def test_mesh_fills_its_surface(shapes, store, name):
    vertices, triangles = shapes.box((4.0, 3.0, 2.0)) if name == "box" else shapes.sphere(2.0, 2)
    mesh = tetrahedralize(vertices, triangles, COARSE, store)
    assert volumes(mesh.nodes, mesh.tetrahedra).min() > 0
    assert mesh.report.quality.non_positive_at_nodes == 0
    assert mesh.report.quality.volume == pytest.approx(mesh.report.surface_volume, rel=0.02)
    assert mesh.report.to_surface <= 0.015
    assert mesh.report.from_surface <= 0.1
    assert np.array_equal(np.unique(mesh.tetrahedra), np.arange(len(mesh.nodes)))


def test_the_mesher_needs_no_extra(shapes, store, tmp_path, monkeypatch):
    # A package of this name that cannot be imported hides the one that may be installed.
    (tmp_path / "pyvista.py").write_text("raise ModuleNotFoundError('pyvista')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    mesh = tetrahedralize(*shapes.box((2.0, 2.0, 1.0)), COARSE, store)
    assert len(mesh.tetrahedra) > 0


def test_a_stored_mesh_is_read_back_and_nothing_is_meshed_again(shapes, store, monkeypatch):
    vertices, triangles = shapes.box((4.0, 3.0, 2.0))
    first = tetrahedralize(vertices, triangles, COARSE, store)
    monkeypatch.setattr(module, "_mesh", lambda *_: pytest.fail("meshed again"))
    again = tetrahedralize(vertices, triangles, COARSE, store)
    assert again.sha256 == first.sha256
    np.testing.assert_array_equal(again.nodes, first.nodes)
    # Limits do not shape a mesh, so they do not make another of it; settings that do, do.
    other = TetwildSettings(edge_length=1.0, envelope=0.01, time_limit=5.0)
    assert tetrahedralize(vertices, triangles, other, store).sha256 == first.sha256
    with pytest.raises(pytest.fail.Exception, match="meshed again"):
        tetrahedralize(vertices, triangles, TetwildSettings(edge_length=0.9, envelope=0.01), store)


def test_a_damaged_store_is_refused(shapes, store, tmp_path):
    vertices, triangles = shapes.box((4.0, 3.0, 2.0))
    mesh = tetrahedralize(vertices, triangles, COARSE, store)
    name = next(store.glob("*.npz")).name
    for path in store.glob("*.npz"):
        with np.load(path) as data:
            if len(data["nodes"]) == len(mesh.nodes):
                name = path.name
    np.savez(tmp_path / name, nodes=mesh.nodes + 1e-3, tetrahedra=mesh.tetrahedra, sha256="0")
    with pytest.raises(MeshingError, match="does not match its hash"):
        tetrahedralize(vertices, triangles, COARSE, tmp_path)
    (tmp_path / name).write_text("nonsense")
    with pytest.raises(MeshingError, match="unreadable"):
        tetrahedralize(vertices, triangles, COARSE, tmp_path)


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "killed by signal 11"),
        ("raise RuntimeError('no volume')", "exit status 1: RuntimeError: no volume"),
        ("import time; time.sleep(60)", "longer than time_limit = 1 s"),
        ("pass", "without a message"),
        (
            "import sys, numpy as np; np.savez(sys.argv[2], nodes=np.zeros((4, 3)),"
            "tetrahedra=np.arange(4)[None])",
            "flat tetrahedra",
        ),
        (
            "import sys, numpy as np; np.savez(sys.argv[2], nodes=np.eye(4, 3),"
            "tetrahedra=np.arange(4)[None])",
            "volume_tolerance",
        ),
        (
            "import sys, numpy as np; np.savez(sys.argv[2], nodes=np.zeros((0, 3)),"
            "tetrahedra=np.zeros((0, 4), int))",
            "returned 0 tetrahedra",
        ),
    ],
)
def test_a_mesher_that_fails_is_one_clear_error(shapes, tmp_path, monkeypatch, script, message):
    worker = tmp_path / "worker.py"
    worker.write_text(script)
    monkeypatch.setattr(module, "WORKER", worker)
    limits = TetwildSettings(edge_length=1.0, envelope=0.01, time_limit=1.0)
    with pytest.raises(MeshingError, match=message):
        tetrahedralize(*shapes.box((4.0, 3.0, 2.0)), limits, tmp_path / "store")
    assert not list((tmp_path / "store").glob("*.npz"))


def test_a_faulty_surface_never_reaches_the_mesher(shapes, monkeypatch):
    monkeypatch.setattr(module, "_mesh", lambda *_: pytest.fail("meshed"))
    vertices, triangles = shapes.box()
    with pytest.raises(GeometryError, match="open surface"):
        tetrahedralize(vertices, triangles[:-1], COARSE)
    vertices[0, 0] = np.nan
    with pytest.raises(GeometryError, match="not finite"):
        tetrahedralize(vertices, triangles, COARSE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edge_length": 0.0}, "edge_length = 0"),
        ({"envelope": -1.0}, "envelope = -1"),
        ({"envelope": 2.0}, "exceeds edge_length"),
        ({"time_limit": float("nan")}, "time_limit = nan"),
        ({"iterations": 0}, "iterations = 0"),
    ],
)
def test_bad_settings_are_one_clear_error(change, message):
    with pytest.raises(ConfigurationError, match=message):
        TetwildSettings(**{"edge_length": 1.0, "envelope": 0.01, **change})


def test_an_unwritable_store_is_one_clear_error(shapes, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_mesh", lambda *_: (np.array(CUBE[0], float), np.array(CUBE[1])))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        tetrahedralize(*shapes.box(), COARSE, tmp_path / "file")


# A unit cube cut into five tetrahedra, two of them given with negative volume.
CUBE = (
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    [[0, 1, 3, 4], [1, 2, 3, 6], [1, 5, 6, 4], [3, 6, 7, 4], [1, 4, 6, 3]],
)


def test_orientation_faces_and_midside_nodes_of_a_cube():
    nodes, tetrahedra = np.array(CUBE[0], float), np.array(CUBE[1])
    tetrahedra = orient(nodes, tetrahedra)
    assert volumes(nodes, tetrahedra) == pytest.approx([1 / 6] * 4 + [1 / 3])
    faces, owner = outer_faces(tetrahedra)
    assert len(faces) == 12
    corners = nodes[faces]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(axis=1) - 0.5
    assert ((area * outward).sum(axis=1) > 0).all()
    np.testing.assert_allclose(area.sum(axis=0), 0, atol=1e-15)
    more, elements = promote_to_tet10(nodes, tetrahedra)
    assert len(more) == 8 + 18  # 12 cube edges and 6 face diagonals
    reference = element("tet10")
    x = np.einsum("qa,mai->mqi", reference.shape(reference.node_coordinates), more[elements])
    np.testing.assert_allclose(x, more[elements])
    linear = element("tet4").shape(reference.node_coordinates)
    np.testing.assert_allclose(x, np.einsum("qa,mai->mqi", linear, nodes[tetrahedra]))
    assert mesh_quality(more, elements, "tet10").volume == pytest.approx(1.0)
    six = more[tri6_faces(faces, elements, owner)]
    np.testing.assert_allclose(six[:, 3:], 0.5 * (six[:, :3] + six[:, [1, 2, 0]]))


def test_more_than_two_tetrahedra_on_a_face_are_refused():
    with pytest.raises(GeometryError, match="more than two tetrahedra"):
        outer_faces(np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]]))


def test_hash_sees_content_and_not_negative_zero():
    nodes = np.array([[0.0, 1, 2]])
    cells = np.array([[0, 0, 0, 0]])
    assert content_sha256(nodes, cells) == content_sha256(nodes * [-1, 1, 1], cells)
    assert content_sha256(nodes, cells) != content_sha256(nodes + 1e-6, cells)


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
    settings = TetwildSettings(edge_length=1.5, envelope=0.03)
    mesh = tetrahedral_leaflets(funnel, settings, element_type, store)
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


def test_other_elements_are_refused(funnel):
    with pytest.raises(InputError, match="tet4"):
        label_tetrahedra(None, None, funnel, "hex18")


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
