"""Binary glTF: what its nodes place where, and what is refused."""

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.exchange import polygon_files
from mvest.exchange.regions import read_regions
from mvest.exchange.surfaces import read_surface
from tests.exchange.surfaces.glb import Glb, write_parts

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
QUARTER = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
"""A quarter turn about z: x becomes y."""


@pytest.mark.parametrize("dtype", ["<u1", "<u2", "<u4"])
@pytest.mark.parametrize("stride", [None, 20])
def test_points_and_triangles_are_those_that_were_written(dtype, stride, tmp_path):
    file = Glb()
    file.node("valve", mesh=file.mesh(POINTS, TRIANGLES, dtype, stride))
    found = read_surface(file.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(found.vertices, POINTS)
    np.testing.assert_array_equal(found.triangles, TRIANGLES)
    assert set(found.groups) == {"valve"}


def test_points_without_numbers_are_triangles_in_turn(tmp_path):
    file = Glb()
    file.node(mesh=file.mesh(POINTS[TRIANGLES].reshape(-1, 3)))
    found = read_surface(file.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(found.vertices[found.triangles], POINTS[TRIANGLES])


def test_nodes_place_what_is_below_them(tmp_path):
    file = Glb()
    mesh = file.mesh(POINTS, TRIANGLES)
    inner = file.node("inner", top=False, mesh=mesh, scale=[2, 2, 2], translation=[1, 0, 0])
    file.node("outer", children=[inner], rotation=QUARTER, translation=[0, 0, 5])
    # By columns: the last one moves.
    file.node("matrix", mesh=mesh, matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1])
    file.node("mirror", mesh=mesh, scale=[-1, 1, 1])
    file.node("elsewhere", top=False, mesh=mesh)
    found = read_surface(file.write(tmp_path / "a.glb"))
    groups = np.array(found.groups)
    corners = {name: found.vertices[found.triangles[groups == name]] for name in set(groups)}
    assert set(corners) == {"inner", "matrix", "mirror"}
    x, y, z = np.moveaxis(POINTS[TRIANGLES], -1, 0)
    np.testing.assert_allclose(
        corners["inner"], np.stack([-2 * y, 2 * x + 1, 2 * z + 5], -1), atol=1e-12
    )
    np.testing.assert_allclose(corners["matrix"], POINTS[TRIANGLES] + [7, 8, 9])
    # Normals point outwards still.
    a, b, c = np.moveaxis(corners["mirror"], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) == pytest.approx(1.0)


def test_one_of_several_objects_by_its_name(tmp_path):
    path = write_parts(
        tmp_path / "a.glb",
        {"one": (POINTS, TRIANGLES), "other": (POINTS[TRIANGLES[:2]].reshape(-1, 3) + 9, None)},
    )
    found = read_regions({"leaflets": path}, {0: "leaflets"}, "other")
    # Corners that coincide are one.
    assert (len(found.vertices), len(found.triangles)) == (4, 2)
    with pytest.raises(InputError, match="no part is called third; there are one, other"):
        read_regions({"leaflets": path}, {0: "leaflets"}, "third")
    named = read_regions(path, {1: "one", 2: "other"})
    assert np.bincount(named.region).tolist() == [4, 2]


def spoilt(change):
    file = Glb()
    file.node("valve", mesh=file.mesh(POINTS, TRIANGLES))
    change(file.document)
    return file


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "needs KHR_draco"),
        (lambda d: d["buffers"][0].update(uri="a.bin"), "in another file"),
        (lambda d: d["meshes"][0]["primitives"][0].update(mode=5), "mode 5; expected triangles"),
        (lambda d: d["nodes"][0].update(children=[0]), "below two nodes, or below itself"),
        (lambda d: d["accessors"][0].update(count=5), "5 rows, more than its 48 bytes hold"),
        (lambda d: d["accessors"][0].update(count=2**40), "rows, more than its 48 bytes"),
        (lambda d: d["accessors"][0].pop("bufferView"), "no plain VEC3"),
        (lambda d: d["accessors"][1].update(count=11), "11 corners, expected three"),
        (lambda d: d["bufferViews"][0].update(byteLength=10**6), "ends beyond"),
        (lambda d: d["bufferViews"][0].update(byteStride=4), "more than its 48 bytes"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-4), "-4 where a number from 0 on"),
        (lambda d: d["scenes"][0].update(nodes=[-1]), "-1 where a number from 0 on"),
        (lambda d: d["nodes"][0].update(scale=[1, 1]), r"shape \(2,\), expected 3 numbers"),
        (lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0]), "damaged or no GLB file"),
        (lambda d: d["scenes"][0].update(nodes=[]), "no triangles"),
    ],
)
def test_what_is_damaged_or_not_understood_is_refused_in_a_line(change, message, tmp_path):
    path = spoilt(change).write(tmp_path / "a.glb")
    with pytest.raises((InputError, GeometryError), match=message) as raised:
        read_surface(path)
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(str(path))


def test_triangles_of_points_that_are_not_there_are_refused(tmp_path):
    file = Glb()
    file.node(mesh=file.mesh(POINTS[:3], TRIANGLES))
    with pytest.raises(GeometryError, match="points that do not exist"):
        read_surface(file.write(tmp_path / "a.glb"))


def test_another_version_and_a_file_that_is_cut_off_are_refused(tmp_path):
    file = spoilt(lambda _: None)
    with pytest.raises(InputError, match="version 1"):
        read_surface(file.write(tmp_path / "a.glb", version=1))
    whole = file.write(tmp_path / "b.glb").read_bytes()
    (tmp_path / "b.glb").write_bytes(whole[:-8])
    with pytest.raises(InputError, match="cut off"):
        read_surface(tmp_path / "b.glb")


def test_nodes_that_share_a_mesh_do_not_fill_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(polygon_files, "MAX_CORNERS", 100)
    file = Glb()
    mesh = file.mesh(POINTS, TRIANGLES)
    for _ in range(9):
        file.node(mesh=mesh)
    with pytest.raises(InputError, match="more than 100 points"):
        read_surface(file.write(tmp_path / "a.glb"))
