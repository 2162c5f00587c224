from pathlib import Path

import nrrd
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import ConvexHull

from mvest.errors import InputError
from mvest.exchange.segmentations import voxelise_leaflets, write_segmentation
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import volumes as v

NAMES = {1: "anterior leaflet", 2: "posterior leaflet", 3: "none of it"}


def labels() -> np.ndarray:
    result = np.zeros(v.SHAPE[1:], dtype=np.int64)
    result[3:6, 4:9, 20] = 1
    result[10, 4, 5:9] = 2
    return result


def test_the_fields_that_slicer_reads(tmp_path: Path) -> None:
    volume = v.sequence(direction=v.MIRRORED)
    path = write_segmentation(tmp_path / "a.seg.nrrd", volume, labels(), NAMES)
    voxels, header = nrrd.read(str(path))
    np.testing.assert_array_equal(voxels, labels())
    assert voxels.dtype == np.uint8
    assert header["space"] == "left-posterior-superior"
    np.testing.assert_allclose(header["space directions"].T, v.MIRRORED * v.SPACING)
    np.testing.assert_allclose(header["space origin"], v.ORIGIN)
    assert header["Segmentation_SourceRepresentation"] == "Binary labelmap"
    assert [header[f"Segment{n}_Name"] for n in range(3)] == list(NAMES.values())
    assert [header[f"Segment{n}_LabelValue"] for n in range(3)] == ["1", "2", "3"]
    assert len({header[f"Segment{n}_ID"] for n in range(3)}) == 3
    assert header["Segment0_Extent"] == "3 5 4 8 20 20"
    assert header["Segment1_Extent"] == "10 10 4 4 5 8"
    assert header["Segment2_Extent"] == "0 -1 0 -1 0 -1"


def test_another_reader_finds_the_segments(tmp_path: Path) -> None:
    slicerio = pytest.importorskip("slicerio")
    path = write_segmentation(tmp_path / "a.seg.nrrd", v.sequence(), labels(), NAMES)
    found = slicerio.read_segmentation(str(path))
    assert [segment["name"] for segment in found["segments"]] == list(NAMES.values())
    assert [segment["labelValue"] for segment in found["segments"]] == [1, 2, 3]
    np.testing.assert_array_equal(found["voxels"], labels())


def test_what_is_written_is_read_as_labels_and_not_as_an_image(tmp_path: Path) -> None:
    path = write_segmentation(tmp_path / "a.seg.nrrd", v.sequence(), labels(), NAMES)
    found = read_labels(path)
    np.testing.assert_array_equal(found.frames[0], labels())
    assert {s.label: s.name for s in found.segments} == NAMES
    with pytest.raises(InputError, match="a segmentation or label map, expected an image"):
        read_volume(path, modality=Modality.ULTRASOUND)


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="words in one line"):
        write_segmentation(
            tmp_path / "a.seg.nrrd", v.sequence(), labels(), {1: "a", 2: "b\nspace: x"}
        )
    with pytest.raises(InputError, match=r"ends in \.seg\.nrrd"):
        write_segmentation(tmp_path / "a.nrrd", v.sequence(), labels(), NAMES)
    assert list(tmp_path.iterdir()) == []


def plate(thickness: float) -> tuple[VolumeSequence, np.ndarray]:
    """A plane square of 16 mm across the third axis of a mirrored volume, and its labels."""
    volume = VolumeSequence(
        np.zeros((1, 30, 30, 30), np.uint8), np.ones(3), v.MIRRORED, v.ORIGIN, np.zeros(1)
    )
    corners = np.array([[6, 6, 15], [22, 6, 15], [22, 22, 15], [6, 22, 15]], dtype=float)
    found = voxelise_leaflets(
        volume,
        volume.world(corners),
        np.array([[0, 1, 2], [0, 2, 3]]),
        np.array([0, 1]),
        np.full(4, thickness),
    )
    return volume, found


def test_a_plate_has_its_thickness_and_its_place() -> None:
    _, found = plate(4.2)
    inside = found[10:19, 10:19]
    assert (inside[:, :, 13:18] > 0).all()
    assert not inside[:, :, :13].any()
    assert not inside[:, :, 18:].any()
    # The first triangle holds the corner (22, 6), the second one (6, 22).
    assert found[20, 8, 15] == 1
    assert found[8, 20, 15] == 2
    # Rounded edges: within half the thickness of the border, not beyond.
    assert found[4, 14, 15] == 2
    assert found[3, 14, 15] == 0


def test_a_thin_leaflet_has_no_holes() -> None:
    """A sphere thinner than a voxel parts what is inside it from what is outside."""
    height, turn = np.linspace(-1, 1, 600), np.pi * (3 - np.sqrt(5)) * np.arange(600)
    around = np.sqrt(1 - height**2)
    points = 14.4 + 8.3 * np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1)
    triangles = ConvexHull(points).simplices
    volume = VolumeSequence(
        np.zeros((1, 30, 30, 30), np.uint8), np.ones(3), np.eye(3), np.zeros(3), np.zeros(1)
    )
    found = voxelise_leaflets(
        volume, points, triangles, np.zeros(len(triangles), dtype=int), np.full(600, 0.1)
    )
    parts, count = ndimage.label(found == 0)
    assert count == 2
    assert parts[0, 0, 0] != parts[14, 14, 14]
    distance = np.linalg.norm(np.stack(np.indices(found.shape), axis=-1) - 14.4, axis=-1)
    assert np.abs(distance[found > 0] - 8.3).max() < 0.6


def test_thickness_varies_over_a_triangle() -> None:
    volume = VolumeSequence(
        np.zeros((1, 30, 30, 30), np.uint8), np.ones(3), np.eye(3), np.zeros(3), np.zeros(1)
    )
    corners = np.array([[4.0, 4, 15], [24, 4, 15], [4, 24, 15]])
    found = voxelise_leaflets(
        volume, corners, np.array([[0, 1, 2]]), np.array([0]), np.array([8.0, 2.0, 8.0])
    )
    assert np.count_nonzero(found[5, 10]) > np.count_nonzero(found[17, 6]) > 1


def test_a_leaflet_outside_the_volume_leaves_no_mark() -> None:
    volume, _ = plate(2.0)
    corners = volume.world(np.array([[100.0, 0, 0], [110, 0, 0], [100, 10, 0]]))
    found = voxelise_leaflets(
        volume, corners, np.array([[0, 1, 2]]), np.array([0]), np.full(3, 2.0)
    )
    assert not found.any()
