"""Legacy VTK files against VTK's own writer, in both encodings and both versions of its cells."""

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.exchange.surfaces import read_surface
from mvest.exchange.vtk_legacy import read_polydata

vtk = pytest.importorskip("vtk", reason="needs VTK, which comes with the extra viz")
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy  # noqa: E402

FORMS = [(version, kind) for version in (42, 51) for kind in (vtk.VTK_ASCII, vtk.VTK_BINARY)]


def output(source):
    source.Update()
    return source.GetOutput()


def named(name, values):
    array = numpy_to_vtk(values, deep=1)
    array.SetName(name)
    return array


def a_sphere():
    """With every kind of attribute that Slicer's models carry."""
    source = vtk.vtkSphereSource()
    source.SetThetaResolution(12)
    surface = output(source)
    n, m = surface.GetNumberOfPoints(), surface.GetNumberOfCells()
    surface.GetPointData().AddArray(named("wall thickness", np.arange(n) / 7))
    surface.GetPointData().AddArray(named("colour", np.arange(4 * n, dtype=np.uint8).reshape(n, 4)))
    surface.GetCellData().AddArray(named("region", np.arange(m, dtype=np.int32) % 2))
    surface.GetCellData().SetScalars(named("height", np.arange(m, dtype=np.float32)))
    words = vtk.vtkStringArray()
    words.SetName("SPACE")
    words.InsertNextValue("LPS")
    surface.GetFieldData().AddArray(words)
    return surface


def written(path, surface, version=42, kind=None):
    writer = vtk.vtkPolyDataWriter()
    writer.SetFileVersion(version)
    writer.SetFileType(vtk.VTK_BINARY if kind is None else kind)
    writer.SetHeader("3D Slicer output. SPACE=LPS")
    writer.SetInputData(surface)
    writer.SetFileName(str(path))
    assert writer.Write()
    return path


@pytest.mark.parametrize(("version", "kind"), FORMS)
def test_points_triangles_and_data_are_those_of_vtk(tmp_path, version, kind):
    surface = a_sphere()

    read = read_surface(written(tmp_path / "a.vtk", surface, version, kind))

    points = vtk_to_numpy(surface.GetPoints().GetData())
    corners = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    # VTK writes six digits as text.
    assert read.vertices == pytest.approx(points, abs=0 if kind == vtk.VTK_BINARY else 1e-6)
    assert np.array_equal(read.triangles, corners)
    assert set(read.point_data) == {"Normals", "wall thickness", "colour"}
    assert read.point_data["wall thickness"] == pytest.approx(np.arange(len(points)) / 7, abs=1e-5)
    assert read.point_data["colour"].shape == (len(points), 4)
    assert np.array_equal(read.cell_data["region"], np.arange(len(corners)) % 2)
    assert np.array_equal(read.cell_data["height"], np.arange(len(corners)))


@pytest.mark.parametrize(("version", "kind"), FORMS)
def test_strips_are_the_triangles_that_vtk_makes_of_them(tmp_path, version, kind):
    stripper = vtk.vtkStripper()
    stripper.SetInputData(a_sphere())
    strips = output(stripper)
    assert strips.GetNumberOfStrips() > 0
    triangles = vtk.vtkTriangleFilter()
    triangles.SetInputData(strips)
    expected = vtk_to_numpy(output(triangles).GetPolys().GetConnectivityArray()).reshape(-1, 3)

    read = read_surface(written(tmp_path / "a.vtk", strips, version, kind))

    def cyclic(corners):
        return {tuple(np.roll(row, -int(np.argmin(row)))) for row in corners}

    assert cyclic(read.triangles) == cyclic(expected)


@pytest.mark.parametrize(("version", "kind"), FORMS)
def test_lines_are_read_as_lines_and_are_no_surface(tmp_path, version, kind):
    path = written(tmp_path / "a.vtk", output(vtk.vtkLineSource()), version, kind)

    read = read_polydata(path)

    assert read.title == "3D Slicer output. SPACE=LPS"
    assert [line.tolist() for line in read.lines] == [[0, 1]]
    with pytest.raises(InputError, match="holds lines; expected triangles only"):
        read_surface(path)


def test_flat_polygons_are_cut_up_and_others_refused_by_name(tmp_path):
    source = vtk.vtkPlaneSource()
    source.SetResolution(2, 1)
    plane = output(source)
    plane.GetCellData().AddArray(named("region", np.array([3, 5], dtype=np.int32)))
    read = read_surface(written(tmp_path / "a.vtk", plane))
    assert len(read.triangles) == 4
    assert read.cell_data["region"].tolist() == [3, 3, 5, 5]
    edges = np.diff(read.vertices[read.triangles], axis=1)
    areas = 0.5 * np.cross(edges[:, 0], edges[:, 1])
    # All face the way that the square does, and fill it.
    assert areas[:, 2] == pytest.approx(0.25)
    plane.GetPoints().SetPoint(4, 0.0, 0.5, 0.3)
    with pytest.raises(InputError, match="polygon 0 has 4 corners and is not flat and convex"):
        read_surface(written(tmp_path / "a.vtk", plane))
    plane.GetPoints().SetPoint(4, -0.4, -0.4, 0.0)
    with pytest.raises(InputError, match="not flat and convex; triangulate"):
        read_surface(written(tmp_path / "a.vtk", plane))


def test_other_data_sets_and_missing_points_are_refused(tmp_path):
    path = written(tmp_path / "a.vtk", a_sphere(), kind=vtk.VTK_ASCII)
    text = path.read_text()
    path.write_text(text.replace("DATASET POLYDATA", "DATASET UNSTRUCTURED_GRID"))
    with pytest.raises(InputError, match="expected DATASET POLYDATA"):
        read_surface(path)
    path.write_text(text.replace("POLYGONS 144 576\n3 ", "POLYGONS 144 576\n3 9", 1))
    with pytest.raises((GeometryError, InputError)):
        read_surface(path)
