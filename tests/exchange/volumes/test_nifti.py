import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import volumes as v

TIMES = np.array([0.0, 0.04, 0.08])
RAS = np.array([-1.0, -1.0, 1.0])


def affine(direction: np.ndarray = v.ROTATION) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = direction * v.SPACING * RAS[:, np.newaxis]
    result[:3, 3] = v.ORIGIN * RAS
    return result


def image(
    values: np.ndarray, kind: Any = nibabel.Nifti1Image, direction: np.ndarray = v.ROTATION
) -> Any:
    """Let nibabel make the image, with 40 ms between frames."""
    result = kind(np.moveaxis(values, 0, 3), affine(direction))
    result.header.set_xyzt_units("mm", "msec")
    result.header["pixdim"][4] = 40
    return result


def expected(dtype: str = "uint8", direction: np.ndarray = v.ROTATION) -> VolumeSequence:
    return VolumeSequence(v.frames(dtype), v.SPACING, direction, v.ORIGIN, TIMES)


def read(path: Path) -> VolumeSequence:
    return read_volume(path, modality=Modality.MR)


@pytest.mark.parametrize("of", ["sform", "qform"])
def test_a_left_handed_volume_stays_left_handed(tmp_path: Path, of: str) -> None:
    made = image(v.frames(), direction=v.MIRRORED)
    if of == "qform":
        made.set_qform(affine(v.MIRRORED), "scanner")
        made.set_sform(None, "unknown")
    nibabel.save(made, tmp_path / "a.nii")
    v.assert_same(read(tmp_path / "a.nii"), expected(direction=v.MIRRORED))


def test_scaled_voxels_have_their_values(tmp_path: Path) -> None:
    made = image(v.frames("int16"))
    made.header.set_slope_inter(2.0, -1024.0)
    nibabel.save(made, tmp_path / "a.nii")
    found = read(tmp_path / "a.nii").frames
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, 2 * v.frames("int16") - 1024)


def test_bytes_in_the_other_order(tmp_path: Path) -> None:
    header = nibabel.Nifti1Header(endianness=">")
    made = nibabel.Nifti1Image(np.moveaxis(v.frames("int16"), 0, 3), affine(), header)
    made.header.set_xyzt_units("mm", "sec")
    made.header["pixdim"][4] = 0.04
    nibabel.save(made, tmp_path / "a.nii")
    v.assert_same(read(tmp_path / "a.nii"), expected("int16"))


def test_times_without_a_unit_take_the_users(tmp_path: Path) -> None:
    made = image(v.frames())
    made.header.set_xyzt_units("mm", "unknown")
    path = tmp_path / "a.nii"
    nibabel.save(made, path)
    with pytest.raises(InputError, match=r"a\.nii: pixdim\[4\].*: times without a unit"):
        read(path)
    found = read_volume(path, modality=Modality.CT, frame_interval_s=0.05)
    np.testing.assert_allclose(found.times, [0, 0.05, 0.1])


def test_no_times_at_all(tmp_path: Path) -> None:
    made = image(v.frames())
    made.header["pixdim"][4] = 0
    nibabel.save(made, tmp_path / "a.nii")
    with pytest.raises(InputError, match=r"a\.nii: pixdim\[4\].*: no times of frames"):
        read(tmp_path / "a.nii")


def sheared(header: Any) -> None:
    matrix = affine()
    matrix[:3, 1] += 0.1 * matrix[:3, 0]
    header.set_sform(matrix, "scanner")
    header["pixdim"][2] = np.linalg.norm(matrix[:3, 1])


BAD: dict[str, tuple[Callable[[Any], object], str, str]] = {
    "no direction": (lambda h: h.set_sform(None, "unknown"), "sform_code", "a direction"),
    "two spacings": (lambda h: h["pixdim"].__setitem__(2, 2.5), "pixdim", "the spacing of sform"),
    "axes not at right angles": (sheared, "sform or qform", "right angles"),
    "metres": (lambda h: h.set_xyzt_units("meter", "msec"), "sform or qform", "0.05 to 5 mm"),
    "hertz": (lambda h: h.set_xyzt_units("mm", "hz"), "xyzt_units", "a fourth axis of time"),
    "40 s": (lambda h: h.set_xyzt_units("mm", "sec"), "pixdim[4] with", "less than 1 s"),
    "five axes": (lambda h: h.set_data_shape((20, 24, 28, 1, 3)), "dim", "3 or 4 axes"),
    "few voxels": (lambda h: h.set_data_shape((20, 24, 10, 3)), "dim", "at least 16"),
    "truncated": (lambda h: h.set_data_shape((20, 24, 29, 3)), "data", "bytes that the header"),
    "longer": (lambda h: h.set_data_shape((20, 24, 27, 3)), "data", "bytes that the header"),
    "colour": (lambda h: h.set_data_dtype("RGB"), "data", "no colour"),
    "complex": (lambda h: h.set_data_dtype(np.complex64), "data", "no colour"),
    "offset": (lambda h: h.__setitem__("vox_offset", 1e9), "data", "bytes that the header"),
    "magic of two files": (lambda h: h.__setitem__("magic", b"ni1"), "magic", "one file"),
    "unknown type": (lambda h: h.__setitem__("datatype", 77), "damaged", ""),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    change, field, words = BAD[what]
    path = tmp_path / "bad.nii"
    nibabel.save(image(v.frames()), path)
    content = path.read_bytes()
    header = nibabel.Nifti1Header(content[:348])
    change(header)
    path.write_bytes(header.binaryblock + content[348:])
    v.assert_refused(path, field, words, modality=Modality.MR)


def test_something_else_compressed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.nii.gz"
    path.write_bytes(gzip.compress(b"words " * 200))
    with pytest.raises(InputError, match=r"a\.nii\.gz: content: .*, expected NRRD, MetaImage"):
        read(path)
