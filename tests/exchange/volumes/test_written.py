"""Sequences for 3D Slicer: written, and read here and by other libraries."""

from pathlib import Path

import nrrd
import numpy as np
import pytest
import SimpleITK

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume, write_sequence_nrrd
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import volumes as v


@pytest.mark.parametrize(
    ("dtype", "direction"), [("uint8", v.ROTATION), ("int16", v.MIRRORED), ("float32", v.ROTATION)]
)
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


def test_slicer_and_itk_read_the_same_sequence(tmp_path: Path) -> None:
    """ITK, on which Slicer builds, takes the frames for components of a vector."""
    made = v.sequence(direction=v.MIRRORED)
    path = write_sequence_nrrd(tmp_path / "a.seq.nrrd", made)
    header = nrrd.read_header(str(path))
    assert header["kinds"] == ["list", "domain", "domain", "domain"]
    assert (header["labels"], header["units"]) == (["time", "", "", ""], ["s", "", "", ""])
    assert header["axis 0 index values"] == "0.0 0.03 0.08"
    image = SimpleITK.ReadImage(str(path))
    assert image.GetNumberOfComponentsPerPixel() == len(made.frames)
    index = (5, 7, 11)
    np.testing.assert_array_equal(image.GetPixel(index), made.frames[(slice(None), *index)])
    np.testing.assert_allclose(
        image.TransformIndexToPhysicalPoint(index), made.world(np.array(index)), atol=1e-9
    )


def test_what_cannot_be_written(tmp_path: Path) -> None:
    for name, dtype, words in (
        ("a.nrrd", "uint8", r"expected one that ends in \.seq\.nrrd"),
        ("a.seq.nrrd", "float64", "frames of type float64, expected uint8"),
        ("missing/a.seq.nrrd", "uint8", "cannot write"),
    ):
        with pytest.raises(InputError, match=words):
            write_sequence_nrrd(tmp_path / name, v.sequence(dtype))
    assert list(tmp_path.iterdir()) == []
