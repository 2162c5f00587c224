"""Surfaces whose cells, groups or nodes are arranged as few programs arrange them.

The common ways in which each format is written are `tests.exchange.surface_variants`.
"""

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.exchange.surfaces import read_mesh, read_regions, read_surface
from tests.exchange.surfaces.glb import described, write_parts

REGIONS = {0: "anterior", 1: "posterior"}
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.5], [2, 1, 0.25]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]])


def test_polygons_and_what_lies_beside_them(tmp_path):
    # A vertex, a line, a concave polygon, a rectangle and a triangle.
    (tmp_path / "b.vtk").write_text(
        "# vtk DataFile Version 4.2\nmade up\nASCII\nDATASET POLYDATA\nPOINTS 6 float\n"
        "0 0 0 2 0 0 2 2 0 1 0.5 0 3 0 0 3 2 0\nVERTICES 1 2\n1 0\nLINES 1 4\n3 0 1 4\n"
        "POLYGONS 3 14\n4 0 1 2 3\n4 1 4 5 2\n3 0 1 2\n"
        "CELL_DATA 5\nSCALARS region int 1\nLOOKUP_TABLE default\n8 9 0 1 2\n"
    )
    mesh = read_mesh(tmp_path / "b.vtk")
    region = mesh.cell_data["region"]
    assert region.tolist() == [0, 0, 1, 1, 2]
    sides = np.diff(mesh.vertices[mesh.triangles], axis=1)
    areas = np.cross(sides[:, 0], sides[:, 1])[:, 2] / 2
    assert areas.min() > 0
    # A triangle of area 2 without a notch of 0.5; a rectangle; that triangle.
    assert np.bincount(region, areas) == pytest.approx([1.5, 2.0, 2.0])


def test_cells_other_than_triangles_are_named(tmp_path):
    (tmp_path / "a.vtk").write_text(
        "# vtk DataFile Version 4.2\nmade up\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 float\n"
        "9 9 9 0 0 0 1 0 0 0 1 0 0 0 1\nCELLS 2 9\n3 1 2 3\n4 1 2 3 4\nCELL_TYPES 2\n5\n10\n"
    )
    assert read_mesh(tmp_path / "a.vtk").others == {"tetra": 1}
    with pytest.raises(GeometryError, match="cells of type tetra; expected triangles only"):
        read_surface(tmp_path / "a.vtk")


def test_unknown_regions_are_named(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"for the region 'AML'; .*name them anterior and post"):
        read_regions({"AML": [tmp_path / "a.obj"]}, REGIONS)


def test_objects_of_several_names_are_one_region(tmp_path):
    parts = {"P1": (POINTS, TRIANGLES[:1]), "A": (POINTS, TRIANGLES[1:2])}
    path = write_parts(tmp_path / "a.glb", parts | {"posterior": (POINTS, TRIANGLES[2:])})
    regions = {"A": "anterior", "P1": "posterior"}
    found = read_regions(path, regions)
    names = [(groups, region) for groups, region in zip(found.groups, found.region, strict=True)]
    assert sorted(names) == [("A", 0), ("P1", 1), ("posterior", 1)]
    with pytest.raises(
        InputError, match=r"unknown label P1 .*known are anterior, .*A \(anterior\)"
    ):
        read_regions(path, {"A": "anterior", 1: "posterior"})


def test_nodes_place_what_is_below_them(tmp_path):
    def place(scene):
        quarter = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # about z: x becomes y
        scene["nodes"] = [
            {"name": "inner", "mesh": 0, "scale": [2, 2, 2], "translation": [1, 0, 0]},
            {"name": "outer", "children": [0], "rotation": quarter, "translation": [0, 0, 5]},
            # By columns: the last one moves.
            {"name": "matrix", "mesh": 0, "matrix": [*np.eye(4).ravel().tolist()[:12], 7, 8, 9, 1]},
            {"name": "mirror", "mesh": 0, "scale": [-1, 1, 1]},
            {"name": "elsewhere", "mesh": 0},
        ]
        scene["scenes"] = [{"nodes": [1, 2, 3]}]
        scene["meshes"][0]["primitives"] *= 2

    path = write_parts(tmp_path / "a.glb", {"all": (POINTS, TRIANGLES)})
    whole = path.read_bytes()
    for change, words in (
        (lambda d: d.update(extensionsRequired=["KHR_draco"]), "needs KHR_draco"),
        (lambda d: d["buffers"][0].update(uri="a.bin"), "damaged"),
        (lambda d: d["accessors"][0].update(sparse={}), "needs sparse or compressed arrays"),
    ):
        path.write_bytes(described(whole, change))
        with pytest.raises(InputError, match=words):
            read_surface(path)
    path.write_bytes(described(whole, place))
    found = read_surface(path)
    groups = np.array(found.groups)
    corners = {name: found.vertices[found.triangles[groups == name]][:3] for name in set(groups)}
    assert set(corners) == {"inner", "matrix", "mirror"}
    x, y, z = np.moveaxis(POINTS[TRIANGLES], -1, 0)
    np.testing.assert_allclose(
        corners["inner"], np.stack([-2 * y, 2 * x + 1, 2 * z + 5], -1), atol=1e-12
    )
    np.testing.assert_allclose(corners["matrix"], POINTS[TRIANGLES] + [7, 8, 9])
    # Normals point upwards still.
    sides = np.diff(corners["mirror"], axis=1)
    assert np.cross(sides[:, 0], sides[:, 1])[:, 2].min() > 0
