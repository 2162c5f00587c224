"""What is written for 3D Slicer and ParaView, read by VTK, SimpleITK and the json module."""

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.cases.folder import write_case
from mvest.errors import InputError
from mvest.exchange.exporting.slicer import SlicerOptions, export_slicer
from mvest.valve.geometry.thickening import thicken
from tests.cases.folders import template_case

vtk = pytest.importorskip("vtk", reason="needs VTK, which comes with the extra viz")
from vtk.util.numpy_support import vtk_to_numpy  # noqa: E402

CASE = template_case(32, 10)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("slicer")
    write_case(folder / "case", CASE)
    return export_slicer(folder / "case", folder / "out", SlicerOptions())


def read(path):
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    assert reader.GetErrorCode() == 0
    return reader.GetOutput()


def points_of(model):
    return vtk_to_numpy(model.GetPoints().GetData())


def arrays_of(data):
    return {
        data.GetArrayName(k): vtk_to_numpy(data.GetArray(k))
        for k in range(data.GetNumberOfArrays())
    }


def test_paraview_and_slicer_read_the_frames_over_time(exported):
    entries = ET.parse(exported / "frames.pvd").findall("Collection/DataSet")
    assert [float(entry.get("timestep")) for entry in entries] == [0.1, 0.3, 0.45]
    for entry, frame in zip(entries, CASE.frames, strict=True):
        model = read(exported / entry.get("file"))
        assert np.array_equal(points_of(model), frame.vertices)
        corners = vtk_to_numpy(model.GetPolys().GetConnectivityArray()).reshape(-1, 3)
        assert np.array_equal(corners, frame.triangles)
        # Slicer takes the axes from here, and would turn the valve about if it read RAS.
        assert model.GetFieldData().GetAbstractArray("SPACE").GetValue(0) == "LPS"
        assert np.array_equal(arrays_of(model.GetCellData())["region"], frame.region)
    last = arrays_of(model.GetPointData())
    moved = CASE.frames[2].vertices - CASE.surface.vertices
    assert last["displacement_mm"] == pytest.approx(moved)
    assert last["stretch_of_area"] == pytest.approx(
        last["stretch_largest"] * last["stretch_smallest"]
    )


def test_landmarks_have_slicerhearts_labels(exported):
    content = json.loads((exported / "open.mrk.json").read_text())
    lists = {item["name"]: item for item in content["markups"]}
    assert {item["coordinateSystem"] for item in lists.values()} == {"LPS"}
    at = {
        point["label"]: np.array(point["position"])
        for point in lists["AnnulusLabelsMarkup"]["controlPoints"]
    }
    assert list(at) == ["A", "P", "AL", "PM", "ALC", "PMC", "MC"]
    # Anterior at +y and the ventricle at -z: from the atrium, the left is at -x.
    assert at["A"][1] > 5 > -5 > at["P"][1]
    for left, right in (("AL", "PM"), ("ALC", "PMC")):
        assert at[left][0] < -5 < 5 < at[right][0]
    ring = CASE.frame(Role.REFERENCE).annulus
    for label in ("ALC", "PMC"):
        assert np.linalg.norm(ring - at[label], axis=1).min() < 1e-9
    tip = lists["PapillaryMarkup-antero-lateral"]["controlPoints"][0]["position"]
    assert tip == CASE.frame(Role.REFERENCE).papillary_tips[1].tolist()
    assert lists["AnnulusContourMarkup"]["type"] == "ClosedCurve"
    assert len(lists["AnnulusContourMarkup"]["controlPoints"]) == len(ring)


def test_a_run_is_written_with_its_distances(tmp_path):
    closed, surface = CASE.frame(Role.CLOSED), CASE.surface
    rest = surface.vertices
    arrays = {"triangles": surface.triangles, "region": surface.region, "rest": rest}
    arrays |= {"annulus": CASE.annulus, "free_edge": CASE.free_edge, "seen": np.array([True])}
    arrays |= {"frames": np.array(["closed"]), "observed": closed.vertices[None]}
    arrays["tips"] = np.stack([one.papillary_tips for one in (CASE.frames[0], closed)])
    arrays |= {"fitted": rest[None] * [1.2, 1, 1], "distance_fitted": np.full((1, len(rest)), 0.25)}
    arrays["leaflets"] = np.array(["posterior", "anterior"])
    (tmp_path / "run").mkdir()
    np.savez(tmp_path / "run" / "fields.npz", **arrays)
    out = export_slicer(tmp_path / "run", tmp_path / "out", SlicerOptions())
    assert {path.name for path in out.glob("*.pvd")} == {"observed.pvd", "fitted.pvd"}
    first, last = (arrays_of(read(out / f"fitted_000{k}.vtp").GetPointData()) for k in (0, 1))
    assert set(first) == set(last)
    assert (first["distance_mm"] == 0).all()
    assert (last["distance_mm"] == 0.25).all()
    assert first["stretch_largest"] == pytest.approx(1.0)
    assert last["stretch_largest"].max() == pytest.approx(1.2, abs=1e-3)
    assert (out / "closed.mrk.json").is_file()
    # Regions have the names of the case, whose order is its own.
    cells = arrays_of(read(out / "fitted_0000.vtp").GetCellData())
    assert np.array_equal(cells["region.anterior"], surface.region == 1)
    del arrays["leaflets"]
    np.savez(tmp_path / "run" / "fields.npz", **arrays)
    with pytest.raises(InputError, match="no names of leaflets; run the case again"):
        export_slicer(tmp_path / "run", tmp_path / "again", SlicerOptions())


def test_a_closure_is_written_with_stress_and_contact_pressure(tmp_path):
    surface = thicken(CASE.surface)
    times = np.array([0.0, 0.02, 0.05])
    frames = surface.vertices + np.array([0.0, 1.0, 2.0])[:, None, None] * [0, 0, 1]
    stress = np.outer(times, np.ones(len(surface.vertices)))
    (tmp_path / "run").mkdir()
    arrays = {"times": times, "frames": frames, "region": surface.region}
    arrays |= {"triangles": surface.triangles, "stress": stress, "contact_pressure": 2 * stress}
    arrays["leaflets"] = np.array(["front", "left", "right"])
    np.savez(tmp_path / "run" / "fields.npz", **arrays)
    out = export_slicer(tmp_path / "run", tmp_path / "out", SlicerOptions())
    entries = ET.parse(out / "closing.pvd").findall("Collection/DataSet")
    assert [float(entry.get("timestep")) for entry in entries] == times.tolist()
    last = arrays_of(read(out / "closing_0002.vtp").GetPointData())
    assert (last["stress_MPa"] == 0.05).all()
    assert (last["contact_pressure_MPa"] == 0.1).all()
    cells = arrays_of(read(out / "closing_0002.vtp").GetCellData())
    assert np.array_equal(cells["region.left"], surface.region == 1)
    assert last["displacement_mm"] == pytest.approx(np.full_like(frames[0], 2.0) * [0, 0, 1])


def test_what_is_no_case_and_no_run_is_refused(tmp_path, exported):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"neither a case \(case\.yaml\) nor a run"):
        export_slicer(tmp_path / "empty", tmp_path / "out", SlicerOptions())
    with pytest.raises(InputError, match="exists; expected a new folder"):
        export_slicer(tmp_path / "empty", exported, SlicerOptions())
    assert not (tmp_path / "out").exists()
