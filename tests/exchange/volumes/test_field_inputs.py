"""Files of kinds that users have are read as the reference readers read them, or refused."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from mvest.errors import InputError
from mvest.exchange.volumes import LabelMap, read_labels, read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import volumes as v
from tests.places import field_input


def assert_as_simpleitk(found: LabelMap | VolumeSequence, path: Path) -> None:
    """Same voxels at the same places as SimpleITK has them, frames last or as a fourth axis."""
    image = SimpleITK.ReadImage(str(path))
    n, voxels = image.GetDimension(), SimpleITK.GetArrayFromImage(image)
    if image.GetNumberOfComponentsPerPixel() > 1:
        voxels = np.moveaxis(voxels, -1, 0)
    expected = voxels.reshape((-1, *voxels.shape[-3:])).transpose(0, 3, 2, 1)
    np.testing.assert_array_equal(found.frames, expected)
    np.testing.assert_allclose(found.spacing, image.GetSpacing()[:3], rtol=1e-6)
    np.testing.assert_allclose(found.origin, image.GetOrigin()[:3], rtol=1e-6)
    direction = np.reshape(image.GetDirection(), (n, n))[:3, :3]
    np.testing.assert_allclose(found.direction, direction, atol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        "overlapping.seg.nrrd",
        "overlapping_empty_layer.seg.nrrd",
        "sparse4d_ms.nii.gz",
        "full4d_default_times.nii.gz",
        "mvseg_posterior1_anterior2.nii.gz",
        "int64_labels.nrrd",
        "child_cropped.nii.gz",
        "scene_mitral_frame_3_MD_anterior_leaflet.nrrd",
        "scene_mitral_frame_3_MD_posterior_leaflet.nrrd",
    ],
)
def test_label_maps(name: str) -> None:
    path = field_input(name)
    found = read_labels(path)
    assert_as_simpleitk(found, path)
    assert found.is_layers == name.startswith("overlapping")


@pytest.mark.parametrize("name", ["overlapping.seg.nrrd", "overlapping_empty_layer.seg.nrrd"])
def test_segments_are_those_of_slicerio(name: str) -> None:
    slicerio = pytest.importorskip("slicerio")
    path = field_input(name)
    expected = slicerio.read_segmentation(str(path), skip_voxels=True)["segments"]
    assert [(s.name, s.label, s.layer) for s in read_labels(path).segments] == [
        (s["name"], s["labelValue"], s["layer"]) for s in expected
    ]


@pytest.mark.parametrize(
    ("name", "option", "refused"),
    [
        ("itk3d.nhdr", {}, ""),
        ("itk4d.nrrd", {"time_unit": "s"}, "times without a unit"),
        ("slicer_text_index.seq.nrrd", {"frame_interval_s": 0.04}, "give frame_interval_s"),
        ("rec.seq.nrrd", {}, ""),
    ],
)
def test_volumes(name: str, option: dict[str, object], refused: str) -> None:
    path = field_input(name)
    found = read_volume(path, modality=Modality.ULTRASOUND, **option)  # type: ignore[arg-type]
    assert_as_simpleitk(found, path)
    if len(found.times) > 1:
        np.testing.assert_allclose(found.times, [0, 0.04, 0.08])
    if refused:
        with pytest.raises(InputError, match=refused):
            read_volume(path, modality=Modality.ULTRASOUND)


def test_a_recording_lies_where_slicerheart_saves_it() -> None:
    recording = read_volume(field_input("rec.dcm"))
    v.assert_same(recording, read_volume(field_input("rec.seq.nrrd"), modality=Modality.ULTRASOUND))
