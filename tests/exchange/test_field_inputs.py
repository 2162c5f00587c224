"""Files of kinds that people have: read as the reference library reads them.

The files lie beside the checkout and are no part of it. Others of each kind are among those that
other programs' libraries make (`tests.exchange.variants`).
"""

import json
from collections.abc import Callable
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK
import slicerio
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkTriangleFilter
from vtkmodules.vtkIOGeometry import vtkOBJReader
from vtkmodules.vtkIOLegacy import vtkPolyDataReader
from vtkmodules.vtkIOPLY import vtkPLYReader

from experiments import cli
from mvest.cases.case import Role, ValveCase
from mvest.cases.folder import read_case
from mvest.exchange.abaqus.deck import Deck
from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_surface
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality
from tests.places import field_input

TIPS = "tips=[-16,-0.24,-25,16,-0.24,-25]"


def reference(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Corners ``(m, 3, 3)`` of triangles by VTK, and the labels of its cells, if there are any."""
    reader = {".vtk": vtkPolyDataReader, ".obj": vtkOBJReader, ".ply": vtkPLYReader}[path.suffix]()
    reader.SetFileName(str(path))
    if path.suffix == ".vtk":
        reader.ReadAllScalarsOn()
        reader.ReadAllColorScalarsOn()
    cutter = vtkTriangleFilter()
    cutter.SetInputConnection(reader.GetOutputPort())
    cutter.PassLinesOff()
    cutter.PassVertsOff()
    cutter.Update()
    found = cutter.GetOutput()
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(float)
    corners = points[vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3)]
    labels = found.GetCellData().GetArray("region")
    return corners, None if labels is None else vtk_to_numpy(labels)


@pytest.mark.parametrize(
    "name", ["cells_idtype.vtk", "pv_region_uint8_ascii.vtk", "obj_tabs.obj", "ply_ascii_tex.ply"]
)
def test_surfaces_are_as_vtk_reads_them(name: str) -> None:
    corners, labels = reference(field_input(name))
    found = read_surface(field_input(name))
    np.testing.assert_allclose(found.vertices[found.triangles], corners, rtol=0, atol=1e-5)
    assert (labels is None) == ("region" not in found.cell_data)
    if labels is not None:
        np.testing.assert_array_equal(np.ravel(found.cell_data["region"]), labels)


def test_phases_with_names_have_the_stated_interval() -> None:
    path = field_input("slicer_text_index.seq.nrrd")
    found = read_volume(path, modality=Modality.ULTRASOUND, frame_interval_s=0.03)
    np.testing.assert_array_equal(found.frames, nrrd.read(str(path))[0])
    np.testing.assert_allclose(found.times, [0, 0.03, 0.06])


@pytest.mark.parametrize("name", ["itk3d.nhdr", "itk4d.nrrd"])
def test_volumes_are_as_simpleitk_reads_them(name: str) -> None:
    image = SimpleITK.ReadImage(str(field_input(name)))
    size, step = image.GetDimension(), image.GetSpacing()
    found = read_volume(
        field_input(name), modality=Modality.ULTRASOUND, time_unit="s" if size == 4 else None
    )
    values = SimpleITK.GetArrayFromImage(image).reshape(-1, *image.GetSize()[2::-1])
    np.testing.assert_array_equal(found.frames, values.transpose(0, 3, 2, 1))
    direction = np.reshape(image.GetDirection(), (size, size))[:3, :3]
    np.testing.assert_allclose(found.spacing, step[:3], rtol=1e-6)
    np.testing.assert_allclose(found.direction, direction, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.origin, image.GetOrigin()[:3], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.times, step[-1] * np.arange(len(values)) * (size == 4))


def test_a_recording_lies_where_slicerheart_puts_it() -> None:
    dicom = read_volume(field_input("rec.dcm"))
    saved = read_volume(field_input("rec.seq.nrrd"), modality=Modality.ULTRASOUND)
    np.testing.assert_allclose(dicom.times, saved.times, atol=1e-9)
    here_and_there = np.array([[0.0, 0, 0], [5, 7, 9], [19, 23, 27]])
    for index in here_and_there:
        np.testing.assert_allclose(dicom.world(index), saved.world(index), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(dicom.frames, saved.frames)


def test_a_deck_has_a_heading_in_latin_1() -> None:
    assert list(Deck(field_input("latin1.inp")).sets["ELSET"]) == ["ALL"]


def positions(path: Path) -> dict[str, list[list[float]]]:
    """What the file says, in Slicer's default axes: LPS."""
    lists = json.loads(path.read_text())["markups"]
    assert {item.get("coordinateSystem", "LPS") for item in lists} == {"LPS"}
    return {item["type"]: [point["position"] for point in item["controlPoints"]] for item in lists}


@pytest.mark.parametrize("name", ["no_system.mrk.json", "line_and_points.mrk.json"])
def test_points_are_read_whatever_lies_beside_them(name: str) -> None:
    found = {
        points.kind: points.points.tolist() for points in read_markups(field_input(name)).values()
    }
    wanted = positions(field_input(name))
    assert found["Fiducial"] == wanted["Fiducial"]
    assert set(found) <= set(wanted)


def by_nibabel(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Labels ``(F, I, J, K)`` and the matrix to LPS."""
    image = nibabel.load(path)
    values = np.asarray(image.dataobj).reshape(*image.shape[:3], -1)
    return np.moveaxis(values, 3, 0), np.diag([-1, -1, 1, 1]) @ image.affine


def by_pynrrd(path: Path) -> tuple[np.ndarray, np.ndarray]:
    values, header = nrrd.read(str(path))
    assert header["space"] == "left-posterior-superior"
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = header["space directions"][-3:].T, header["space origin"]
    return values.reshape(-1, *values.shape[-3:]), matrix


MAPS = (
    *("overlapping.seg.nrrd", "overlapping_empty_layer.seg.nrrd", "sparse4d_ms.nii.gz"),
    *("full4d_default_times.nii.gz", "mvseg_posterior1_anterior2.nii.gz", "int64_labels.nrrd"),
    *("child_cropped.nii.gz", "scene_mitral_frame_3_MD_anterior_leaflet.nrrd"),
    "scene_mitral_frame_3_MD_posterior_leaflet.nrrd",
)


@pytest.mark.parametrize("name", MAPS)
def test_labels_are_as_nibabel_and_pynrrd_read_them(name: str) -> None:
    read: Callable[[Path], tuple[np.ndarray, np.ndarray]]
    read = by_nibabel if name.endswith(".gz") else by_pynrrd
    values, matrix = read(field_input(name))
    found = read_labels(field_input(name))
    np.testing.assert_array_equal(found.frames, values)
    np.testing.assert_allclose(found.direction * found.spacing, matrix[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found.origin, matrix[:3, 3], atol=1e-6)


@pytest.mark.parametrize("name", ["overlapping.seg.nrrd", "overlapping_empty_layer.seg.nrrd"])
def test_segments_are_those_of_slicerio(name: str) -> None:
    path = field_input(name)
    expected = slicerio.read_segmentation(str(path), skip_voxels=True)["segments"]
    assert [(s.name, s.label, s.layer) for s in read_labels(path).segments] == [
        (s["name"], s["labelValue"], s["layer"]) for s in expected
    ]


def imported(kind: str, name: str, folder: Path, *options: str) -> ValveCase:
    """The case that the command makes of a file."""
    case = folder / "case"
    assert cli.main(["import", kind, str(field_input(name)), str(case), *options]) == 0
    return read_case(case)


def check_leaflets(case: ValveCase, role: Role, voxels: dict[str, np.ndarray]) -> None:
    """Each leaflet of a frame is nearest to the voxels ``(n, 3)`` LPS that were drawn as it."""
    frame = case.frame(role)
    centres = frame.vertices[frame.triangles].mean(axis=1)
    for number, name in enumerate(case.surface.region_names):
        own = centres[frame.region == number].mean(axis=0)
        away = {other: np.linalg.norm(own - x.mean(axis=0)) for other, x in voxels.items()}
        assert min(away, key=away.__getitem__) == name, away


@pytest.mark.slow
def test_leaflets_are_those_that_were_drawn(tmp_path: Path) -> None:
    name = "overlapping_empty_layer.seg.nrrd"
    case = imported("leaflets", name, tmp_path, TIPS)
    values, matrix = by_pynrrd(field_input(name))
    layers = {"anterior": values[0], "posterior": values[1]}
    drawn = {k: np.argwhere(x == 1) @ matrix[:3, :3].T + matrix[:3, 3] for k, x in layers.items()}
    check_leaflets(case, Role.REFERENCE, drawn)


@pytest.mark.slow
def test_surfaces_as_slicerheart_named_them_in_2026(tmp_path: Path) -> None:
    case = imported("slicerheart", "slicerheart_apr2026", tmp_path)
    for role, phase in ((Role.REFERENCE, "3_MD"), (Role.CLOSED, "12_MS")):
        name = f"slicerheart_apr2026/P001_mitral_frame_{phase}_mitral_{{}}_leaflet.vtk"
        leaflets = {
            region: reference(field_input(name.format(region)))[0].reshape(-1, 3)
            for region in ("anterior", "posterior")
        }
        check_leaflets(case, role, leaflets)
