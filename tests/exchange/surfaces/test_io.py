import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.exchange.surfaces import (
    read_surface,
    write_surface,
)
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume


@pytest.mark.parametrize("suffix", [".vtu", ".vtp", ".stl", ".obj", ".ply"])
def test_a_surface_comes_back_as_it_went(shapes, tmp_path, suffix):
    vertices, triangles = shapes.sphere(2.0, 3)
    vertices += [10.0, -20.0, 1 / 3]
    path = write_surface(tmp_path / f"sphere{suffix}", vertices, triangles)
    back = read_surface(path)
    check_surface(back.vertices, back.triangles, closed=True)
    if suffix == ".stl":  # triangle soup: vertices are found again by their place
        assert len(back.vertices) == len(vertices)
        assert enclosed_volume(back.vertices, back.triangles) == pytest.approx(
            enclosed_volume(vertices, triangles), rel=1e-5
        )
    else:
        np.testing.assert_array_equal(back.triangles, triangles)
        np.testing.assert_allclose(back.vertices, vertices, rtol=0 if suffix != ".obj" else 1e-9)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".vtu", ".vtp"])
def test_data_come_back_exactly(shapes, tmp_path, suffix):
    vertices, triangles = shapes.sphere(2.0, 4)  # several compressed blocks
    rng = np.random.default_rng(0)
    points = {
        "vector": rng.normal(size=(len(vertices), 3)),
        "single": rng.normal(size=len(vertices)).astype(np.float32),
    }
    cells = {"label": rng.integers(-5, 5, len(triangles)), "flag": rng.random(len(triangles)) > 0.5}
    back = read_surface(write_surface(tmp_path / f"s{suffix}", vertices, triangles, points, cells))
    for name, values in points.items():
        np.testing.assert_array_equal(back.point_data[name], values)
        assert back.point_data[name].dtype == values.dtype
    for name, values in cells.items():
        np.testing.assert_array_equal(back.cell_data[name], values)


@pytest.mark.parametrize("form", ["ascii", "binary", "appended raw", "appended base64"])
@pytest.mark.parametrize("compressed", [True, False])
def test_vtp_of_vtk_itself_is_read(shapes, tmp_path, form, compressed):
    vtk = pytest.importorskip("vtk")
    pyvista = pytest.importorskip("pyvista")
    vertices, triangles = shapes.sphere(2.0, 4)
    mesh = pyvista.PolyData.from_regular_faces(vertices, triangles)
    mesh.point_data["height"] = vertices[:, 2]
    mesh.cell_data["number"] = np.arange(len(triangles))
    writer = vtk.vtkXMLPolyDataWriter()
    writer.SetFileName(str(tmp_path / "s.vtp"))
    writer.SetInputData(mesh)
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(
        form, writer.SetDataModeToAppended
    )()
    writer.SetEncodeAppendedData(form == "appended base64")
    writer.SetCompressorTypeToZLib() if compressed else writer.SetCompressorTypeToNone()
    assert writer.Write()
    back = read_surface(tmp_path / "s.vtp")
    np.testing.assert_allclose(back.vertices, vertices, atol=1e-12)
    np.testing.assert_array_equal(back.triangles, triangles)
    np.testing.assert_allclose(back.point_data["height"], vertices[:, 2], atol=1e-12)
    np.testing.assert_array_equal(back.cell_data["number"], np.arange(len(triangles)))


@pytest.mark.parametrize("form", ["Ascii", "Binary", "Appended"])
@pytest.mark.parametrize("compressor", ["None", "ZLib", "LZMA"])
def test_vtu_of_vtk_itself_is_read(shapes, tmp_path, form, compressor):
    vtk = pytest.importorskip("vtk")
    pyvista = pytest.importorskip("pyvista")
    vertices, triangles = shapes.sphere(2.0, 4)
    mesh = pyvista.PolyData.from_regular_faces(vertices, triangles).cast_to_unstructured_grid()
    mesh.point_data["height"] = vertices[:, 2]
    mesh.cell_data["number"] = np.arange(len(triangles))
    writer = vtk.vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(tmp_path / "s.vtu"))
    writer.SetInputData(mesh)
    getattr(writer, f"SetDataModeTo{form}")()
    getattr(writer, f"SetCompressorTypeTo{compressor}")()
    assert writer.Write()
    back = read_surface(tmp_path / "s.vtu")
    np.testing.assert_allclose(back.vertices, vertices, atol=1e-12)
    np.testing.assert_array_equal(back.triangles, triangles)
    np.testing.assert_allclose(back.point_data["height"], vertices[:, 2], atol=1e-12)
    np.testing.assert_array_equal(back.cell_data["number"], np.arange(len(triangles)))


def test_properties_of_faces_are_read_from_a_binary_ply(tmp_path):
    faces = np.zeros(2, [("count", "u1"), ("corners", ">i4", 3), ("region", ">f4")])
    faces["count"], faces["corners"], faces["region"] = 3, [[0, 1, 2], [2, 1, 3]], [7, 9]
    points = np.arange(12, dtype=">f4")
    head = (
        "ply\nformat binary_big_endian 1.0\nelement vertex 4\nproperty float x\n"
        "property float y\nproperty float z\nelement face 2\n"
        "property list uchar int vertex_index\nproperty float region\nend_header\n"
    )
    (tmp_path / "a.ply").write_bytes(head.encode() + points.tobytes() + faces.tobytes())
    back = read_surface(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.vertices, points.reshape(4, 3))
    np.testing.assert_array_equal(back.triangles, faces["corners"])
    np.testing.assert_array_equal(back.cell_data["region"], [7, 9])


def test_negative_numbers_in_obj_count_from_the_last_vertex(tmp_path):
    (tmp_path / "a.obj").write_text(TRIANGLE + "f -3 -2 -1\nv 1 1 0\nf -1 3 2\n")
    back = read_surface(tmp_path / "a.obj")
    np.testing.assert_array_equal(back.triangles, [[0, 1, 2], [3, 2, 1]])


def test_vtp_is_read_by_vtk(shapes, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    vertices, triangles = shapes.sphere(2.0, 4)
    path = write_surface(tmp_path / "s.vtp", vertices, triangles, {"x": vertices[:, 0]})
    mesh = pyvista.read(path)
    np.testing.assert_array_equal(mesh.points, vertices)
    np.testing.assert_array_equal(mesh.regular_faces, triangles)
    np.testing.assert_array_equal(mesh.point_data["x"], vertices[:, 0])


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\n"
    "property double z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 1 0\n"
)
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("missing.stl", None, InputError, "no such file"),
        ("mesh.off", "", InputError, r"extension '\.off', expected .*\.stl, \.obj, \.ply"),
        ("mesh.ply", "nonsense", InputError, "damaged or no PLY"),
        ("mesh.ply", PLY[:70], InputError, "no end_header"),
        ("mesh.ply", PLY + "3 0 1 9\n", GeometryError, "do not exist"),
        ("mesh", "", InputError, "extension ''"),
        ("mesh.vtu", "nonsense", InputError, "damaged or no VTU"),
        ("mesh.vtp", "nonsense", InputError, "damaged or no VTK XML"),
        ("mesh.vtp", "<VTKFile type='ImageData'/>", InputError, "'ImageData', expected PolyData"),
        ("mesh.vtp", "<VTKFile><PolyData/></VTKFile>", InputError, "0 pieces"),
        ("mesh.stl", "", (InputError, GeometryError), "mesh.stl"),
        ("mesh.obj", TRIANGLE, GeometryError, "no triangles"),
        ("mesh.obj", TRIANGLE + "v 1 1 0\nf 1 2 4 3\n", GeometryError, "type quad"),
        ("mesh.obj", TRIANGLE + "f 1 2 9\n", GeometryError, "do not exist"),
        ("mesh.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", GeometryError, r"points \[0\]"),
        ("mesh.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", GeometryError, "shape"),
    ],
)
def test_bad_files_are_one_clear_error(tmp_path, name, content, error, message):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    with pytest.raises(error, match=message):
        read_surface(path)


def box_with(shapes, **change):
    vertices, triangles = shapes.box()
    return {"vertices": vertices, "triangles": triangles, **change}


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("a.off", {}, "extension"),
        ("no/where/a.vtu", {}, "cannot write"),
        ("a.vtu", {"vertices": np.zeros((8, 2))}, "shape"),
        ("a.vtu", {"vertices": np.full((8, 3), np.nan)}, "not finite"),
        ("a.vtp", {"triangles": np.zeros((0, 3), int)}, "shape"),
        ("a.vtp", {"triangles": np.array([[0, 1, 8]])}, "outside 0 to 7"),
        ("a.vtp", {"point_data": {"x": np.zeros(7)}}, "'x': shape"),
        ("a.vtu", {"cell_data": {"x": np.array(["a"] * 12)}}, "expected numbers"),
        ("a.stl", {"cell_data": {"x": np.zeros(12)}}, "STL holds no data"),
        ("a.obj", {"point_data": {"x": np.zeros(8)}}, "OBJ holds no data"),
        ("a.ply", {"point_data": {"x": np.zeros(8)}}, "PLY holds no data"),
    ],
)
def test_bad_output_is_one_clear_error_and_leaves_nothing(shapes, tmp_path, name, change, message):
    with pytest.raises(InputError, match=message):
        write_surface(tmp_path / name, **box_with(shapes, **change))
    assert list(tmp_path.iterdir()) == []
