"""Sequences and segmentations for 3D Slicer: written, read again here and by other libraries."""

from pathlib import Path

import nrrd
import numpy as np
import pytest
import SimpleITK
from scipy import ndimage
from scipy.spatial import ConvexHull

from mvest.errors import InputError
from mvest.exchange.segmentations import (
    voxelise_leaflets,
    write_segmentation,
    write_sequence_nrrd,
)
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import volumes as v

NAMES = {1: "anterior leaflet", 2: "posterior leaflet", 3: "none of it"}


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
@pytest.mark.parametrize("direction", [v.ROTATION, v.MIRRORED], ids=["right", "left"])
def test_a_sequence_is_read_again(tmp_path: Path, dtype: str, direction: np.ndarray) -> None:
    s = v.sequence(dtype, direction)
    made = VolumeSequence(s.frames, s.spacing, direction, s.origin, s.times, Modality.CT)
    path = write_sequence_nrrd(tmp_path / "a.seq.nrrd", made)
    found = read_volume(path)
    assert (found.frames.dtype, found.modality) == (dtype, Modality.CT)
    np.testing.assert_array_equal(found.frames, made.frames)
    np.testing.assert_array_equal(found.times, made.times)
    np.testing.assert_allclose(found.direction, made.direction, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.spacing, made.spacing, rtol=1e-14)
    np.testing.assert_array_equal(found.origin, made.origin)
    # The same content gives the same bytes, without the time of writing.
    again = write_sequence_nrrd(tmp_path / "2.seq.nrrd", made).read_bytes()
    assert again == path.read_bytes()
    assert b"#" not in again.partition(b"\n\n")[0]


def test_a_single_frame(tmp_path: Path) -> None:
    s = v.sequence()
    made = VolumeSequence(s.frames[1:2], s.spacing, s.direction, s.origin, s.times[1:2])
    found = read_volume(write_sequence_nrrd(tmp_path / "a.seq.nrrd", made))
    np.testing.assert_array_equal(found.frames, made.frames)
    assert found.times.tolist() == [0.03]


def test_slicer_and_itk_read_the_same_sequence(tmp_path: Path) -> None:
    """ITK, on which Slicer builds, takes the frames for components of a vector."""
    made = v.sequence(direction=v.MIRRORED)
    path = write_sequence_nrrd(tmp_path / "a.seq.nrrd", made)
    header = nrrd.read_header(str(path))
    assert header["kinds"] == ["list", "domain", "domain", "domain"]
    assert (header["labels"], header["units"]) == (["time", "", "", ""], ["s", "", "", ""])
    assert header["axis 0 index type"] == "numeric"
    assert header["axis 0 index values"] == "0.0 0.03 0.08"
    assert header["DataNodeClassName"] == "vtkMRMLScalarVolumeNode"
    image = SimpleITK.ReadImage(str(path))
    assert image.GetNumberOfComponentsPerPixel() == len(made.frames)
    index = (5, 7, 11)
    np.testing.assert_array_equal(image.GetPixel(index), made.frames[(slice(None), *index)])
    np.testing.assert_allclose(
        image.TransformIndexToPhysicalPoint(index), made.world(np.array(index)), atol=1e-9
    )


def labels() -> np.ndarray:
    result = np.zeros(v.SHAPE[1:], dtype=np.int64)
    result[3:6, 4:9, 20] = 1
    result[10, 4, 5:9] = 2
    return result


def test_a_segmentation_is_what_slicer_reads(tmp_path: Path) -> None:
    slicerio = pytest.importorskip("slicerio")
    volume = v.sequence(direction=v.MIRRORED)
    path = write_segmentation(tmp_path / "a.seg.nrrd", volume, labels(), NAMES)
    voxels, header = nrrd.read(str(path))
    np.testing.assert_array_equal(voxels, labels())
    assert voxels.dtype == np.uint8
    assert header["space"] == "left-posterior-superior"
    np.testing.assert_allclose(header["space directions"].T, v.MIRRORED * v.SPACING)
    np.testing.assert_allclose(header["space origin"], v.ORIGIN)
    assert header["Segmentation_SourceRepresentation"] == "Binary labelmap"
    assert len({header[f"Segment{n}_ID"] for n in range(3)}) == 3
    extents = [header[f"Segment{n}_Extent"] for n in range(3)]
    assert extents == ["3 5 4 8 20 20", "10 10 4 4 5 8", "0 -1 0 -1 0 -1"]
    found = slicerio.read_segmentation(str(path))
    assert {s["labelValue"]: s["name"] for s in found["segments"]} == NAMES
    own = read_labels(path)
    np.testing.assert_array_equal(own.frames[0], labels())
    assert {s.label: s.name for s in own.segments} == NAMES
    with pytest.raises(InputError, match="a segmentation or label map, expected an image"):
        read_volume(path, modality=Modality.ULTRASOUND)


def test_what_cannot_be_written(tmp_path: Path) -> None:
    for name, dtype, words in (
        ("a.nrrd", "uint8", r"expected one that ends in \.seq\.nrrd"),
        ("a.seq.nrrd", "float64", "frames of type float64, expected uint8"),
        ("missing/a.seq.nrrd", "uint8", "cannot write"),
    ):
        with pytest.raises(InputError, match=words):
            write_sequence_nrrd(tmp_path / name, v.sequence(dtype))
    for name, names, words in (
        ("a.seg.nrrd", {1: "a", 2: "b\nspace: x"}, "words in one line"),
        ("a.nrrd", NAMES, r"ends in \.seg\.nrrd"),
    ):
        with pytest.raises(InputError, match=words):
            write_segmentation(tmp_path / name, v.sequence(), labels(), names)
    assert list(tmp_path.iterdir()) == []


def grid(direction: np.ndarray, origin: np.ndarray) -> VolumeSequence:
    """30 voxels of 1 mm along each axis."""
    empty = np.zeros((1, 30, 30, 30), np.uint8)
    return VolumeSequence(empty, np.ones(3), direction, origin, np.zeros(1))


PLAIN = grid(np.eye(3), np.zeros(3))


def test_a_plate_has_its_thickness_and_its_place() -> None:
    volume = grid(v.MIRRORED, v.ORIGIN)
    corners = np.array([[6.0, 6, 15], [22, 6, 15], [22, 22, 15], [6, 22, 15]])
    plate = (np.array([[0, 1, 2], [0, 2, 3]]), np.array([0, 1]), np.full(4, 4.2))
    found = voxelise_leaflets(volume, volume.world(corners), *plate)
    inside = found[10:19, 10:19]
    assert (inside[:, :, 13:18] > 0).all()
    assert not inside[:, :, :13].any()
    assert not inside[:, :, 18:].any()
    # The first triangle holds the corner (22, 6), the second one (6, 22).
    assert (found[20, 8, 15], found[8, 20, 15]) == (1, 2)
    # Rounded edges: within half the thickness of the border, not beyond.
    assert (found[4, 14, 15], found[3, 14, 15]) == (2, 0)
    assert not voxelise_leaflets(volume, volume.world(corners + 100), *plate).any()


def test_a_thin_leaflet_has_no_holes() -> None:
    """A sphere thinner than a voxel parts what is inside it from what is outside."""
    height, turn = np.linspace(-1, 1, 600), np.pi * (3 - np.sqrt(5)) * np.arange(600)
    around = np.sqrt(1 - height**2)
    points = 14.4 + 8.3 * np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1)
    triangles = ConvexHull(points).simplices
    region = np.zeros(len(triangles), dtype=int)
    found = voxelise_leaflets(PLAIN, points, triangles, region, np.full(600, 0.1))
    parts, count = ndimage.label(found == 0)
    assert count == 2
    assert parts[0, 0, 0] != parts[14, 14, 14]
    distance = np.linalg.norm(np.stack(np.indices(found.shape), axis=-1) - 14.4, axis=-1)
    assert np.abs(distance[found > 0] - 8.3).max() < 0.6


def test_thickness_varies_over_a_triangle() -> None:
    corners, one = np.array([[4.0, 4, 15], [24, 4, 15], [4, 24, 15]]), np.array([[0, 1, 2]])
    found = voxelise_leaflets(PLAIN, corners, one, np.array([0]), np.array([8.0, 2.0, 8.0]))
    assert np.count_nonzero(found[5, 10]) > np.count_nonzero(found[17, 6]) > 1
