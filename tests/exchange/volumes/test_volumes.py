"""Volumes of every format: what is rare is read, what is damaged or implausible is refused.

The common ways in which each format is written are `tests.exchange.volume_variants`.
"""

import gzip
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import nrrd
import numpy as np
import pytest
from pydicom.dataset import Dataset

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volume_variants import by_itk, dataset, header, nifti, philips
from tests.exchange.volumes import volumes as v

VALUES = "axis 0 index values"
TIMES = f"{VALUES}="
EVEN = np.array([0.0, 0.04, 0.08])
SEQUENCE = VolumeSequence(v.frames(), v.SPACING, v.ROTATION, v.ORIGIN, EVEN)


def read(path: Path, **given: Any) -> VolumeSequence:
    return read_volume(path, **{"modality": Modality.ULTRASOUND} | given)


def made(folder: Path, extra: str = "", **changes: str | None) -> Path:
    """A file of pynrrd with other lines of its header, or without those that are None.

    Names of key/value pairs end in "=".
    """
    path = folder / "a.nrrd"
    nrrd.write(str(path), v.frames(), header(0, "raw"))
    head, _, voxels = path.read_bytes().partition(b"\n\n")
    first, *lines = [line for line in head.decode().split("\n") if line[0] != "#"]
    pairs = [line.replace(":=", "=:", 1).split(":", 1) for line in lines]
    fields = {name: value.strip() for name, value in pairs} | {"type": "uint8"} | changes
    lines = [
        f"{name[:-1]}:={value}" if name.endswith("=") else f"{name}: {value}"
        for name, value in fields.items()
        if value is not None
    ]
    path.write_bytes("\n".join([first, *lines, f"{extra}\n"]).encode() + voxels)
    return path


def skipped(folder: Path, **skips: str) -> Path:
    skips = {name.replace("_", " "): value for name, value in skips.items()}
    path = made(folder, **{"data file": "a.raw"} | skips)
    head, end, voxels = path.read_bytes().partition(b"\n\n")
    (folder / "a.raw").write_bytes(b"one line\n12345" + voxels)
    (folder / "a.nhdr").write_bytes(head + end)
    return folder / "a.nhdr"


def test_a_left_handed_volume_stays_left_handed(tmp_path: Path) -> None:
    expected = VolumeSequence(v.frames(), v.SPACING, v.MIRRORED, v.ORIGIN, EVEN)
    path = nifti(tmp_path / "a.nii", "NIfTI-1", "uint8", "qform only", v.MIRRORED)
    v.assert_same(read(path), expected)
    for name in ("a.nrrd", "a.mha"):
        found = read(by_itk(tmp_path / name, direction=v.MIRRORED), time_unit="s")
        v.assert_same(found, expected)


@pytest.mark.parametrize("axis", [0, 1])
def test_voxels_of_other_types_along_another_axis(tmp_path: Path, axis: int) -> None:
    path = tmp_path / "a.nrrd"
    kinds = ((">i4", "int16", -50), ("<f8", "float32", 9), ("<u2", "float32", 60000))
    for stored, kind, low in kinds:
        values = v.frames("int32") + low
        nrrd.write(str(path), np.moveaxis(values.astype(stored), 0, axis), header(axis))
        found = read(path)
        assert found.frames.dtype == kind
        np.testing.assert_array_equal(found.frames, values)
    for value in (0.0, np.nan):
        voxels = v.frames("float32")
        voxels[2] = value
        nrrd.write(str(path), np.moveaxis(voxels, 0, axis), header(axis))
        with pytest.raises(InputError, match=r"a\.nrrd: data: .* frame 2 (are 0|that are no)"):
            read(path)


def test_the_hash_is_that_of_all_files(tmp_path: Path) -> None:
    one = read(made(tmp_path))
    assert one.source == "a.nrrd"
    assert one.sha256 == hashlib.sha256((tmp_path / "a.nrrd").read_bytes()).hexdigest()
    v.assert_same(read(skipped(tmp_path, line_skip="1", byte_skip="5")), SEQUENCE)
    both = [skipped(tmp_path, byteskip="-1").read_bytes(), (tmp_path / "a.raw").read_bytes()]
    assert read(tmp_path / "a.nhdr").sha256 == hashlib.sha256(b"".join(both)).hexdigest()


PHASES = {"axis 0 index type=": "text", TIMES: "ED%20frame mid ES"}
UNTIMED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "NRRD": (lambda folder: made(folder, units=None), f"{VALUES}: times without a unit"),
    "phases by name": (lambda folder: made(folder, **PHASES), "index type: no times of frames"),
    "MetaImage": (lambda folder: by_itk(folder / "a.mha"), "ElementSpacing: times without a unit"),
}


@pytest.mark.parametrize("what", UNTIMED)
def test_times_that_are_not_stated_are_those_that_are_given(tmp_path: Path, what: str) -> None:
    make, words = UNTIMED[what]
    path = make(tmp_path)
    with pytest.raises(InputError, match=words):
        read(path)
    np.testing.assert_allclose(read(path, frame_interval_s=0.05).times, [0, 0.05, 0.1])


def test_a_recording_lies_where_slicerheart_places_it(tmp_path: Path) -> None:
    """SlicerHeart gives 3D Slicer an image of these spacings without origin and directions.

    Slicer's world is RAS: voxel (i, j, k) is at (1.5 i, 1.25 j, k) there, which in LPS has the
    first two signs turned.
    """
    recording = read_volume(philips(tmp_path / "a.dcm"))
    np.testing.assert_array_equal(recording.frames, v.frames())
    found = recording.world(np.array([3.0, 5.0, 7.0]))
    np.testing.assert_allclose(found, [-4.5, -6.25, 7.0], atol=1e-12)


Bad = tuple[Callable[[Path], Path], str, str]


def of_nrrd(field: str, words: str, **changes: str | None) -> Bad:
    return lambda folder: made(folder, **changes), f"{field}: ", words


def of_nifti(change: Callable[[Any], object], field: str, words: str) -> Bad:
    def make(folder: Path) -> Path:
        path = nifti(folder / "a.nii", "NIfTI-1", "uint8")
        content = path.read_bytes()
        header = nibabel.Nifti1Header(content[:348])
        change(header)
        path.write_bytes(header.binaryblock + content[348:])
        return path

    return make, field, words


def of_dicom(name: str | tuple[int, int], value: object, field: str, words: str) -> Bad:
    """A value in place of an element's, or without the element."""

    def make(folder: Path) -> Path:
        data: Dataset = dataset()
        if value is None:
            del data[name]
        elif isinstance(name, str):
            setattr(data, name, value)
        else:
            data[name].value = value
        return philips(folder / "a.dcm", data=data)

    return make, field, words


PLACE, PATH = "space directions", "file in the same folder"
CM = "none (0.04,0,0) (0,0.04,0) (0,0,0.04)"
BAD: dict[str, Bad] = {
    "colour": of_nrrd("kinds", "one grey value", kinds="RGB-color domain domain domain"),
    "no spacing": of_nrrd(PLACE, "a vector in mm", **{PLACE: None}),
    "unknown space": of_nrrd("space", "left-posterior-superior", space="scanner-xyz"),
    "spacing in cm": of_nrrd(PLACE, "0.05 to 5 mm", **{PLACE: CM}),
    "origin far away": of_nrrd(
        "space origin", "coordinates in mm", **{"space origin": "(1e6,0,0)"}),
    "space units": of_nrrd(
        "space units", "mm, cm, m or um", **{"space units": '"mm" "inch" "mm"'}),
    "ms taken for s": of_nrrd(VALUES, "less than 1 s", **{TIMES: "0 30 60"}),
    "s taken for ms": of_nrrd(VALUES, "at least 0.002 s", units='"ms" "" "" ""'),
    "a time is missing": of_nrrd(VALUES, "each of 3 frames", **{TIMES: "0 0.03"}),
    "a segmentation": of_nrrd("Segmentation_A", "an image", **{"Segmentation_A=": "Leaf"}),
    "fewer voxels than bytes": of_nrrd("damaged", "", sizes="3 16 17 20"),
    "data elsewhere": of_nrrd("data file", PATH, **{"data file": "../a.raw"}),
    "no direction": of_nifti(
        lambda h: h.set_sform(None, "unknown"), "sform_code", "a direction"),
    "two spacings": of_nifti(
        lambda h: h["pixdim"].__setitem__(2, 2.5), "pixdim", "the spacing of sform"),
    "CT": of_dicom("SOPClassUID", "1.2.840.10008.5.1.4.1.1.2", "SOPClassUID", "3D Slicer"),
    "no slice spacing": of_dicom((0x3001, 0x1003), None, "(3001,1003)", "a number"),
    "more frames than bytes": of_dicom("NumberOfFrames", 4, "PixelData", "22848 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    make, field, words = BAD[what]
    v.assert_refused(make(tmp_path), field, words, modality=Modality.ULTRASOUND)


def test_what_the_file_states_is_not_contradicted(tmp_path: Path) -> None:
    path = made(tmp_path, **{"mvest.modality=": "ct"})
    assert read_volume(path).modality is Modality.CT
    for given, words in (
        ({"modality": Modality.MR}, "modality: mr, expected ct"),
        ({"frame_interval_s": 0.03}, r"frame_interval_s: 0\.03, expected none"),
        ({"time_unit": "ms"}, "time_unit: 'ms', expected 's'"),
    ):
        with pytest.raises(InputError, match=rf"a\.nrrd: {words}"):
            read_volume(path, **given)
    with pytest.raises(InputError, match=r"a\.nrrd: modality: not stated .* ultrasound, ct, mr"):
        read_volume(made(tmp_path))
    with pytest.raises(InputError, match=r"a\.dcm: modality: ct, expected ultrasound"):
        read_volume(philips(tmp_path / "a.dcm"), modality=Modality.CT)


def test_what_is_no_volume_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a folder, expected one file.* 3D Slicer"):
        read(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "missing.nrrd")
    (tmp_path / "a.nii.gz").write_bytes(gzip.compress(b"words " * 200))
    with pytest.raises(InputError, match=r"a\.nii\.gz: content: .*, expected NRRD, MetaImage"):
        read(tmp_path / "a.nii.gz")
