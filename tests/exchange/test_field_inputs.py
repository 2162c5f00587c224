"""Files of kinds that people have: read as the reference library reads them.

The files lie beside the checkout and are no part of it. Others of each kind are among those that
other programs' libraries make (`tests.exchange.variants`).
"""

from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK

from experiments import cli
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.exchange.abaqus.deck import Deck
from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_surface
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality
from tests.places import field_input

TIPS = "tips=[-16,-0.24,-25,16,-0.24,-25]"


@pytest.mark.parametrize(
    ("name", "regions"),
    [("cells_idtype.vtk", 2), ("pv_region_uint8_ascii.vtk", 2), ("obj_tabs.obj", 0),
     ("ply_ascii_tex.ply", 0)],
)  # fmt: skip
def test_surfaces_are_read_with_their_regions(name: str, regions: int) -> None:
    found = read_surface(field_input(name))
    assert len(found.triangles)
    assert len(np.unique(found.cell_data.get("region", []))) == regions


@pytest.mark.parametrize(("name", "unit"), [("itk3d.nhdr", None), ("itk4d.nrrd", "s")])
def test_volumes_are_as_simpleitk_reads_them(name: str, unit: str | None) -> None:
    image = SimpleITK.ReadImage(str(field_input(name)))
    found = read_volume(field_input(name), modality=Modality.ULTRASOUND, time_unit=unit)
    values = SimpleITK.GetArrayFromImage(image).reshape(-1, *image.GetSize()[2::-1])
    np.testing.assert_array_equal(found.frames, values.transpose(0, 3, 2, 1))
    np.testing.assert_allclose(found.spacing, image.GetSpacing()[:3], rtol=1e-6)
    np.testing.assert_allclose(found.origin, image.GetOrigin()[:3], rtol=0, atol=1e-6)


def test_a_recording_lies_where_slicerheart_puts_it() -> None:
    dicom = read_volume(field_input("rec.dcm"))
    saved = read_volume(field_input("rec.seq.nrrd"), modality=Modality.ULTRASOUND)
    np.testing.assert_allclose(dicom.times, saved.times, atol=1e-9)
    for index in np.array([[0.0, 0, 0], [5, 7, 9], [19, 23, 27]]):
        np.testing.assert_allclose(dicom.world(index), saved.world(index), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(dicom.frames, saved.frames)


@pytest.mark.parametrize("name", ["no_system.mrk.json", "line_and_points.mrk.json"])
def test_points_are_read_next_to_other_lists(name: str) -> None:
    assert "Fiducial" in {points.kind for points in read_markups(field_input(name)).values()}


def test_a_deck_has_a_heading_in_latin_1() -> None:
    assert list(Deck(field_input("latin1.inp")).sets["ELSET"]) == ["ALL"]


@pytest.mark.parametrize(
    "name",
    ["sparse4d_ms.nii.gz", "full4d_default_times.nii.gz", "mvseg_posterior1_anterior2.nii.gz",
     "child_cropped.nii.gz"],
)  # fmt: skip
def test_labels_are_as_nibabel_reads_them(name: str) -> None:
    image = nibabel.load(field_input(name))
    values = np.asarray(image.dataobj).reshape(*image.shape[:3], -1)
    matrix = np.diag([-1, -1, 1, 1]) @ image.affine
    found = read_labels(field_input(name))
    np.testing.assert_array_equal(found.frames, np.moveaxis(values, 3, 0))
    np.testing.assert_allclose(found.direction * found.spacing, matrix[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found.origin, matrix[:3, 3], atol=1e-6)


@pytest.mark.parametrize(
    "name",
    ["overlapping.seg.nrrd", "int64_labels.nrrd", "scene_mitral_frame_3_MD_anterior_leaflet.nrrd",
     "scene_mitral_frame_3_MD_posterior_leaflet.nrrd"],
)  # fmt: skip
def test_label_maps_in_nrrd_are_read(name: str) -> None:
    values, _ = nrrd.read(str(field_input(name)))
    assert np.count_nonzero(read_labels(field_input(name)).frames) == np.count_nonzero(values)


def test_phases_with_names_have_the_stated_interval() -> None:
    path = field_input("slicer_text_index.seq.nrrd")
    found = read_volume(path, modality=Modality.ULTRASOUND, frame_interval_s=0.03)
    np.testing.assert_allclose(found.times, [0, 0.03, 0.06])


@pytest.mark.slow
def test_leaflets_are_those_that_were_drawn(tmp_path: Path) -> None:
    name = "overlapping_empty_layer.seg.nrrd"
    folder = tmp_path / "case"
    assert cli.main(["import", "leaflets", str(field_input(name)), str(folder), TIPS]) == 0
    case = read_case(folder)
    values, header = nrrd.read(str(field_input(name)))
    assert header["space"] == "left-posterior-superior"
    steps, origin = header["space directions"][-3:], header["space origin"]
    layers = {"anterior": values[0], "posterior": values[1]}
    drawn = {k: np.argwhere(x == 1) @ steps + origin for k, x in layers.items()}
    frame = case.frame(Role.REFERENCE)
    centres = frame.vertices[frame.triangles].mean(axis=1)
    for number, leaflet in enumerate(case.surface.region_names):
        own = centres[frame.region == number].mean(axis=0)
        away = {other: np.linalg.norm(own - x.mean(axis=0)) for other, x in drawn.items()}
        assert min(away, key=away.__getitem__) == leaflet, away


def test_surfaces_as_slicerheart_named_them_in_2026(tmp_path: Path) -> None:
    source = field_input("slicerheart_apr2026")
    folder = tmp_path / "case"
    assert cli.main(["import", "slicerheart", str(source), str(folder)]) == 0
    case = read_case(folder)
    for role, phase in ((Role.REFERENCE, "3_MD"), (Role.CLOSED, "12_MS")):
        frame = case.frame(role)
        for number, region in enumerate(case.surface.region_names):
            drawn = read_surface(source / f"P001_mitral_frame_{phase}_mitral_{region}_leaflet.vtk")
            own = frame.vertices[frame.triangles[frame.region == number]].mean(axis=(0, 1))
            corners = drawn.vertices[drawn.triangles].mean(axis=(0, 1))
            # Slicer's models are in RAS.
            assert min(np.linalg.norm(own - corners * s) for s in ([1, 1, 1], [-1, -1, 1])) < 3.0
