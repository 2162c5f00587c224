"""Surfaces of every format are read as the program that wrote them, or VTK, has them."""

import itertools

import numpy as np
import pytest
from vtkmodules import vtkIOLegacy, vtkIOXML
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkStringArray
from vtkmodules.vtkFiltersCore import vtkAppendFilter, vtkStripper, vtkTriangleFilter
from vtkmodules.vtkFiltersSources import vtkSphereSource

from mvest.errors import GeometryError, InputError
from mvest.exchange.surfaces import part_of, read_mesh, read_regions, read_surface
from tests.exchange.surfaces.glb import Glb
from tests.places import ROOT

FIELD_INPUTS = ROOT.parent / "shared" / "data" / "field_inputs"
REGIONS = {0: "anterior", 1: "posterior"}
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.5], [2, 1, 0.25]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]])


def output(step, data=None):
    if data is not None:
        step.SetInputData(data)
    step.Update()
    return step.GetOutput()


def corners(surface):
    """Of VTK's triangles, ``(m, 3, 3)``."""
    triangles = output(vtkTriangleFilter(), surface)
    points = vtk_to_numpy(triangles.GetPoints().GetData())
    return points[vtk_to_numpy(triangles.GetPolys().GetConnectivityArray()).reshape(-1, 3)]


def add(data, name, values):
    array = numpy_to_vtk(values, deep=1)
    array.SetName(name)
    data.AddArray(array)


@pytest.fixture(scope="module")
def sphere():
    """With arrays of several types, some of them not numbers, and the name of its axes."""
    source = vtkSphereSource()
    source.SetThetaResolution(24)
    surface = output(source)
    n, m = surface.GetNumberOfPoints(), surface.GetNumberOfCells()
    add(surface.GetPointData(), "wall thickness", np.r_[np.nan, np.inf, np.arange(n - 2) / 7])
    add(surface.GetPointData(), "colour", np.arange(4 * n, dtype=np.uint8).reshape(n, 4))
    add(surface.GetCellData(), "region", np.arange(m, dtype=np.int8) % 2)
    words = vtkStringArray()
    words.SetName("SPACE")
    words.InsertNextValue("LPS")
    surface.GetFieldData().AddArray(words)
    return surface


def written(writer, path, data, **settings):
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    for name, value in settings.items():
        getattr(writer, f"Set{name}")(value)
    assert writer.Write()
    return path


def check_sphere(path, sphere):
    read, expected = read_mesh(path), sphere.GetPointData()
    points = vtk_to_numpy(sphere.GetPoints().GetData())
    np.testing.assert_allclose(read.vertices, points, atol=1e-6)
    np.testing.assert_allclose(read.vertices[read.triangles], corners(sphere), atol=1e-6)
    thickness = vtk_to_numpy(expected.GetArray("wall thickness"))
    np.testing.assert_allclose(read.point_data["wall thickness"], thickness, rtol=1e-5)
    np.testing.assert_array_equal(
        read.point_data["colour"], vtk_to_numpy(expected.GetArray("colour"))
    )
    np.testing.assert_array_equal(read.cell_data["region"], np.arange(len(read.triangles)) % 2)
    assert read.space == "LPS"


@pytest.mark.parametrize(("version", "kind"), list(itertools.product((42, 51), (1, 2))))
@pytest.mark.parametrize("grid", [False, True])
def test_legacy_vtk_as_text_and_binary(tmp_path, sphere, version, kind, grid):
    writer = vtkIOLegacy.vtkUnstructuredGridWriter() if grid else vtkIOLegacy.vtkPolyDataWriter()
    data = output(vtkAppendFilter(), sphere) if grid else sphere
    settings = {"FileVersion": version, "FileType": kind, "Header": "3D Slicer output. SPACE=LPS"}
    check_sphere(written(writer, tmp_path / "a.vtk", data, **settings), sphere)


def test_strips_polygons_and_what_lies_beside_them(tmp_path, sphere):
    strips = output(vtkStripper(), sphere)
    assert strips.GetNumberOfStrips()
    path = written(vtkIOXML.vtkXMLPolyDataWriter(), tmp_path / "a.vtp", strips)
    read = read_surface(path)
    np.testing.assert_allclose(read.vertices[read.triangles], corners(strips))
    # A vertex, a line, a concave polygon, a rectangle, a triangle, and a strip.
    (tmp_path / "b.vtk").write_text(
        "# vtk DataFile Version 4.2\nmade up\nASCII\nDATASET POLYDATA\nPOINTS 6 float\n"
        "0 0 0 2 0 0 2 2 0 1 0.5 0 3 0 0 3 2 0\nVERTICES 1 2\n1 0\nLINES 1 4\n3 0 1 4\n"
        "POLYGONS 3 14\n4 0 1 2 3\n4 1 4 5 2\n3 0 1 2\nTRIANGLE_STRIPS 1 5\n4 1 4 2 5\n"
        "CELL_DATA 6\nSCALARS region int 1\nLOOKUP_TABLE default\n8 9 0 1 2 3\n"
    )
    mesh = read_mesh(tmp_path / "b.vtk")
    assert mesh.segments.tolist() == [[0, 1], [1, 4]]
    region = mesh.cell_data["region"]
    assert region.tolist() == [0, 0, 1, 1, 2, 3, 3]
    sides = np.diff(mesh.vertices[mesh.triangles], axis=1)
    areas = np.cross(sides[:, 0], sides[:, 1])[:, 2] / 2
    assert areas.min() > 0
    # A triangle of area 2 without a notch of 0.5; a rectangle; that triangle; the strip.
    assert np.bincount(region, areas) == pytest.approx([1.5, 2.0, 2.0, 2.0])


def test_triangles_and_a_strip_keep_their_data(tmp_path):
    (tmp_path / "a.vtk").write_text(
        "# vtk DataFile Version 4.2\nmade up\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n"
        "0 0 0 1 0 0 0 1 0 1 1 0\nPOLYGONS 2 8\n3 0 1 2\n3 1 3 2\nTRIANGLE_STRIPS 1 5\n4 0 1 2 3\n"
        "CELL_DATA 3\nSCALARS region int 1\nLOOKUP_TABLE default\n5 6 7\n"
    )
    read = read_surface(tmp_path / "a.vtk")
    assert read.triangles.tolist() == [[0, 1, 2], [1, 3, 2], [0, 1, 2], [2, 1, 3]]
    assert read.cell_data["region"].tolist() == [5, 6, 7, 7]


def test_cells_other_than_triangles_are_named(tmp_path):
    (tmp_path / "a.vtk").write_text(
        "# vtk DataFile Version 4.2\nmade up\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 float\n"
        "9 9 9 0 0 0 1 0 0 0 1 0 0 0 1\nCELLS 2 9\n3 1 2 3\n4 1 2 3 4\nCELL_TYPES 2\n5\n10\n"
    )
    assert read_mesh(tmp_path / "a.vtk").others == {"tetra": 1}
    with pytest.raises(GeometryError, match="cells of type tetra; expected triangles only"):
        read_surface(tmp_path / "a.vtk")


STL = (
    "solid {name}\n"
    + "".join(
        "facet normal 0 0 1\n outer loop\n"
        + "".join(f"  vertex {x:.5e} {y:.5e} {z:.5e}\n" for x, y, z in triangle)
        + " endloop\nendfacet\n"
        for triangle in POINTS[TRIANGLES]
    )
    + "endsolid\n"
)
FACETS = np.zeros(3, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
FACETS["corners"], FACETS["attribute"] = POINTS[TRIANGLES], 7
BINARY = np.uint32(3).tobytes() + FACETS.tobytes()


@pytest.mark.parametrize(
    "content",
    [
        STL.replace("\n", "\r").encode(),
        b"\n  " + STL.encode(),
        b"solid with more".ljust(80, b"\0") + BINARY + b"more",
    ],
)
def test_stl_as_text_and_binary(tmp_path, content):
    (tmp_path / "a.stl").write_bytes(content)
    read = read_surface(tmp_path / "a.stl")
    assert len(read.vertices) == len(POINTS)
    np.testing.assert_allclose(read.vertices[read.triangles], POINTS[TRIANGLES])


def ply(form, faces, nl="\n"):
    """Vertices with a region, faces with a region before and texture coordinates behind."""
    head = (
        f"ply\ncomment first\nformat {form} 1.0\nobj_info made up\nelement vertex 6\n"
        "property float x\nproperty double y\nproperty float32 z\nproperty uchar region\n"
        f"element face {len(faces)}\nproperty short region\n"
        "property list uchar int vertex_indices\nproperty list uint8 float texcoord\n"
        "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    )
    kinds = {"f": "f4", "d": "f8", "B": "u1", "h": "i2", "i": "i4"}
    rows = [("fdfB", [*point, k % 2]) for k, point in enumerate(POINTS.tolist())]
    for k, face in enumerate(faces):
        texture = [0.5] * (2 * len(face))
        types = "hB" + "i" * len(face) + "B" + "f" * len(texture)
        rows.append((types, [k % 2, len(face), *face, len(texture), *texture]))
    rows.append(("ii", [0, 1]))
    if form == "ascii":
        return (
            (head + "".join(" ".join(map(str, row)) + "\n" for _, row in rows))
            .replace("\n", nl)
            .encode()
        )
    order = "<" if "little" in form else ">"
    return head.replace("\n", nl).encode() + b"".join(
        np.array(value).astype(order + kinds[kind]).tobytes()
        for types, row in rows
        for kind, value in zip(types, row, strict=True)
    )


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("nl", ["\n", "\r\n"])
@pytest.mark.parametrize("faces", [TRIANGLES.tolist(), [[0, 1, 2, 3], [1, 4, 5], [1, 4, 5, 2]]])
def test_ply_with_properties_lists_and_quadrilaterals(tmp_path, form, nl, faces):
    (tmp_path / "a.ply").write_bytes(ply(form, faces, nl))
    read = read_surface(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.vertices, POINTS)
    np.testing.assert_array_equal(read.point_data["region"], [0, 1, 0, 1, 0, 1])
    per_face = [len(face) - 2 for face in faces]
    np.testing.assert_array_equal(
        read.cell_data["region"], np.repeat(np.arange(len(faces)) % 2, per_face)
    )
    if faces == TRIANGLES.tolist():
        np.testing.assert_array_equal(read.triangles, TRIANGLES)
    assert set(read.cell_data) == {"region"}


VERTICES = "".join(f"v {x} {y} {z} 0.5 0.5 0.5\n" for x, y, z in POINTS.tolist())
FACES = ["f 1/1/1 2//1 3/1 # a face\n", "f\t-6 -4 \\\n -3\n", "f 2 5 6\n"]


@pytest.mark.parametrize(
    ("lines", "groups"),
    [
        (FACES, []),
        (["o valve\n", "g anterior  leaflet\n", *FACES[:2], "g posterior\n", FACES[2]],
         ["anterior leaflet"] * 2 + ["posterior"]),
        (["o one\n", FACES[0], "usemtl x\ns off\nl 1 2\np 3\n", *FACES[1:]], ["one"] * 3),
    ],
)  # fmt: skip
def test_obj_with_groups_and_objects(tmp_path, lines, groups):
    (tmp_path / "a.obj").write_text("# made up\nmtllib a.mtl\nvt 0 0\n" + VERTICES + "".join(lines))
    read = read_surface(tmp_path / "a.obj")
    np.testing.assert_array_equal(read.vertices, POINTS)
    np.testing.assert_array_equal(read.triangles, TRIANGLES)
    assert list(read.groups) == groups


def test_parts_are_taken_by_their_names(tmp_path):
    text = VERTICES + "".join(["g one\n", *FACES[:2], "g other\n", FACES[2]])
    (tmp_path / "a.obj").write_text(text)
    surface = read_surface(tmp_path / "a.obj")
    part = part_of(surface, "other")
    np.testing.assert_array_equal(part.vertices[part.triangles], POINTS[TRIANGLES[2:]])
    with pytest.raises(InputError, match="no part is called third; there are one, other"):
        part_of(surface, "third")
    with pytest.raises(InputError, match=r"unknown label one, other at triangles .*known are ant"):
        read_regions(tmp_path / "a.obj", REGIONS)


def test_nodes_place_what_is_below_them(tmp_path):
    file = Glb()
    mesh = file.mesh(POINTS, TRIANGLES)
    quarter = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # about z: x becomes y
    inner = file.node("inner", top=False, mesh=mesh, scale=[2, 2, 2], translation=[1, 0, 0])
    file.node("outer", children=[inner], rotation=quarter, translation=[0, 0, 5])
    # By columns: the last one moves.
    file.node("matrix", mesh=mesh, matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1])
    file.node("mirror", mesh=mesh, scale=[-1, 1, 1])
    file.node("elsewhere", top=False, mesh=mesh)
    file.document["meshes"][mesh]["primitives"] *= 2
    found = read_surface(file.write(tmp_path / "a.glb"))
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
