from pathlib import Path

import nrrd
import numpy as np
import pytest
import SimpleITK

from mvest.errors import InputError
from mvest.exchange.segmentations import write_sequence_nrrd
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import volumes as v


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
@pytest.mark.parametrize("direction", [v.ROTATION, v.MIRRORED], ids=["right", "left"])
def test_what_is_written_is_read_again(tmp_path: Path, dtype: str, direction: np.ndarray) -> None:
    made = v.sequence(dtype, direction)
    path = write_sequence_nrrd(tmp_path / "a.seq.nrrd", made)
    found = read_volume(path)
    assert found.frames.dtype == dtype
    np.testing.assert_array_equal(found.frames, made.frames)
    np.testing.assert_array_equal(found.times, made.times)
    np.testing.assert_allclose(found.direction, made.direction, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.spacing, made.spacing, rtol=1e-14)
    np.testing.assert_array_equal(found.origin, made.origin)


def test_modality_is_kept(tmp_path: Path) -> None:
    s = v.sequence("int16")
    made = VolumeSequence(s.frames, s.spacing, s.direction, s.origin, s.times, Modality.CT)
    assert read_volume(write_sequence_nrrd(tmp_path / "a.seq.nrrd", made)).modality is Modality.CT


def test_a_single_frame(tmp_path: Path) -> None:
    s = v.sequence()
    made = VolumeSequence(s.frames[1:2], s.spacing, s.direction, s.origin, s.times[1:2])
    found = read_volume(write_sequence_nrrd(tmp_path / "a.seq.nrrd", made))
    np.testing.assert_array_equal(found.frames, made.frames)
    assert found.times.tolist() == [0.03]


def test_the_fields_that_slicer_reads(tmp_path: Path) -> None:
    path = write_sequence_nrrd(tmp_path / "a.seq.nrrd", v.sequence())
    header = nrrd.read_header(str(path))
    assert header["kinds"] == ["list", "domain", "domain", "domain"]
    assert header["labels"] == ["time", "", "", ""]
    assert header["units"] == ["s", "", "", ""]
    assert header["axis 0 index type"] == "numeric"
    assert header["axis 0 index values"] == "0.0 0.03 0.08"
    assert header["DataNodeClassName"] == "vtkMRMLScalarVolumeNode"


def test_itk_reads_the_same_world(tmp_path: Path) -> None:
    """ITK, on which Slicer builds, takes the frames for components of a vector."""
    made = v.sequence(direction=v.MIRRORED)
    path = write_sequence_nrrd(tmp_path / "a.seq.nrrd", made)
    image = SimpleITK.ReadImage(str(path))
    assert image.GetNumberOfComponentsPerPixel() == len(made.frames)
    index = (5, 7, 11)
    np.testing.assert_array_equal(image.GetPixel(index), made.frames[(slice(None), *index)])
    np.testing.assert_allclose(
        image.TransformIndexToPhysicalPoint(index), made.world(np.array(index)), atol=1e-9
    )


def test_the_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    one = write_sequence_nrrd(tmp_path / "1.seq.nrrd", v.sequence()).read_bytes()
    assert write_sequence_nrrd(tmp_path / "2.seq.nrrd", v.sequence()).read_bytes() == one
    assert b"#" not in one.partition(b"\n\n")[0]


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected one that ends in \.seq\.nrrd"):
        write_sequence_nrrd(tmp_path / "a.nrrd", v.sequence())
    with pytest.raises(InputError, match="frames of type float64, expected uint8"):
        write_sequence_nrrd(tmp_path / "a.seq.nrrd", v.sequence("float64"))
    with pytest.raises(InputError, match="cannot write"):
        write_sequence_nrrd(tmp_path / "missing" / "a.seq.nrrd", v.sequence())
    assert list(tmp_path.iterdir()) == []
