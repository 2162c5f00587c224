from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality
from tests.exchange.volumes import volumes as v

PHILIPS = "1.2.840.113543.6.6.1.3.10002"


def dataset(shape: tuple[int, int, int, int] = v.SHAPE, before: bytes = b"") -> Dataset:
    """What QLAB exports, of frames, columns, rows and slices."""
    t, i, j, k = shape
    voxels = before + v.frames(shape=shape).transpose(0, 3, 2, 1).tobytes()
    data = Dataset()
    data.SOPClassUID = PHILIPS
    data.Modality = "US"
    data.Manufacturer = "PMS QLAB Cart Export"
    data.FrameTime = "40"
    data.PhysicalUnitsXDirection = 3
    data.PhysicalUnitsYDirection = 3
    data.PhysicalDeltaX = 0.15
    data.PhysicalDeltaY = 0.125
    data.SamplesPerPixel = 1
    data.PhotometricInterpretation = "MONOCHROME2"
    data.NumberOfFrames = t
    data.Rows = j
    data.Columns = i
    data.BitsAllocated = 8
    data.BitsStored = 8
    data.HighBit = 7
    data.PixelRepresentation = 0
    data.add_new((0x3001, 0x0010), "LO", "Philips3D")
    data.add_new((0x3001, 0x1001), "UL", k)
    data.add_new((0x3001, 0x1002), "US", 3)
    data.add_new((0x3001, 0x1003), "FD", 0.1)
    data.add_new((0x7FE0, 0x0010), "OB", voxels + b"\0" * (len(voxels) % 2))
    return data


def save(path: Path, data: Dataset, explicit: bool = True, preamble: bool = False) -> Path:
    if preamble:
        data.file_meta = FileMetaDataset()
        data.file_meta.TransferSyntaxUID = (
            ExplicitVRLittleEndian if explicit else ImplicitVRLittleEndian
        )
        data.file_meta.MediaStorageSOPClassUID = PHILIPS
        data.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
        pydicom.dcmwrite(path, data, enforce_file_format=True)
    else:
        pydicom.dcmwrite(path, data, implicit_vr=not explicit, little_endian=True)
    return path


def test_the_volume_lies_where_slicerheart_places_it(tmp_path: Path) -> None:
    """SlicerHeart gives 3D Slicer an image of these spacings without origin and directions.

    Slicer's world is RAS: voxel (i, j, k) is at (1.5 i, 1.25 j, k) there, which in LPS has the
    first two signs turned. The sequence that Slicer saves of it is read into the same place, so a
    landmark placed in Slicer marks the same voxel of both files.
    """
    recording = read_volume(save(tmp_path / "a.dcm", dataset()))
    index = np.array([3.0, 5.0, 7.0])
    np.testing.assert_allclose(recording.world(index), [-4.5, -6.25, 7.0], atol=1e-12)
    fields = v.nrrd_fields() | {
        "space": "right-anterior-superior",
        "space directions": "none (1.5,0,0) (0,1.25,0) (0,0,1)",
        "space origin": "(0,0,0)",
        "axis 0 index values=": "0 0.04 0.08",
    }
    saved = v.write_nrrd(tmp_path / "a.seq.nrrd", fields)
    v.assert_same(recording, read_volume(saved, modality=Modality.ULTRASOUND))


def test_voxels_are_the_last_bytes(tmp_path: Path) -> None:
    found = read_volume(save(tmp_path / "a.dcm", dataset(before=b"\x07" * 64)))
    np.testing.assert_array_equal(found.frames, v.frames())


def test_an_odd_number_of_voxels(tmp_path: Path) -> None:
    shape = (3, 17, 19, 21)
    found = read_volume(save(tmp_path / "a.dcm", dataset(shape)))
    np.testing.assert_array_equal(found.frames, v.frames(shape=shape))


def test_a_file_without_its_class_but_with_its_private_fields(tmp_path: Path) -> None:
    data = dataset()
    del data.SOPClassUID
    found = read_volume(save(tmp_path / "a", data))
    np.testing.assert_array_equal(found.frames, v.frames())


def test_pixels_beyond_what_is_kept_in_memory(tmp_path: Path) -> None:
    """The larger file is read with its pixels left in place."""
    shape = (4, 32, 32, 32)
    found = read_volume(save(tmp_path / "a.dcm", dataset(shape)))
    np.testing.assert_array_equal(found.frames, v.frames(shape=shape))


def setter(field: str, value: object) -> Callable[[Dataset], None]:
    return lambda data: setattr(data, field, value)


def remover(field: str | tuple[int, int]) -> Callable[[Dataset], None]:
    return lambda data: data.__delitem__(field)


def private(number: int, value: object) -> Callable[[Dataset], None]:
    return lambda data: setattr(data[0x3001, number], "value", value)


BAD: dict[str, tuple[Callable[[Dataset], None], str, str]] = {
    "CT": (setter("SOPClassUID", "1.2.840.10008.5.1.4.1.1.2"), "SOPClassUID", "3D Slicer"),
    "2D echo": (setter("SOPClassUID", "1.2.840.10008.5.1.4.1.1.3.1"), "SOPClassUID", "3D Slicer"),
    "no slices": (remover((0x3001, 0x1001)), "(3001,1001)", "a number"),
    "no slice spacing": (remover((0x3001, 0x1003)), "(3001,1003)", "a number"),
    "no spacing": (remover("PhysicalDeltaX"), "PhysicalDeltaX", "a number"),
    "no units": (remover("PhysicalUnitsYDirection"), "PhysicalUnitsYDirection", "a number"),
    "no cm": (setter("PhysicalUnitsXDirection", 4), "PhysicalUnitsXDirection", "which is cm"),
    "no cm between slices": (private(0x1002, 4), "(3001,1002)", "which is cm"),
    "no frame time": (remover("FrameTime"), "FrameTime", "a number"),
    "40 s": (setter("FrameTime", "40000"), "FrameTime", "less than 1 s"),
    "no frames": (remover("NumberOfFrames"), "NumberOfFrames", "a number"),
    "colour": (setter("SamplesPerPixel", 3), "SamplesPerPixel", "one grey value"),
    "two bytes": (setter("BitsAllocated", 16), "BitsAllocated", "one grey value of a byte"),
    "mm in place of cm": (setter("PhysicalDeltaX", 1.5), "PhysicalDeltaX", "0.05 to 5 mm"),
    "mirrored spacing": (setter("PhysicalDeltaX", -0.15), "PhysicalDeltaX", "positive lengths"),
    "more frames than bytes": (setter("NumberOfFrames", 4), "PixelData", "53760 bytes"),
    "no pixels": (remover("PixelData"), "PixelData", "the voxels"),
}


@pytest.mark.parametrize("explicit", [True, False], ids=["explicit", "implicit"])
@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, what: str, explicit: bool) -> None:
    change, field, words = BAD[what]
    data = dataset()
    change(data)
    path = save(tmp_path / "bad.dcm", data, explicit)
    v.assert_refused(path, field, words)


def test_another_modality_contradicts_the_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.dcm: modality: ct, expected ultrasound"):
        read_volume(save(tmp_path / "a.dcm", dataset()), modality=Modality.CT)


def test_a_folder_of_slices_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a folder, expected one file.* 3D Slicer"):
        read_volume(tmp_path, modality=Modality.CT)
    with pytest.raises(InputError, match="no such file"):
        read_volume(tmp_path / "missing.nrrd")
