"""Volumes of every format: what is rare is read, what is damaged or implausible is refused.

The common ways in which each format is written are `tests.exchange.volume_variants`.
"""

import gzip
import hashlib
import re
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
from tests.exchange.volume_variants import by_itk, dataset, directions, header, nifti, philips
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


def other(folder: Path, axis: int = 0, frames: np.ndarray | None = None, **fields: Any) -> Path:
    """A file of pynrrd with the frames along an axis, and other fields."""
    frames = v.frames() if frames is None else frames
    nrrd.write(str(folder / "a.nrrd"), np.moveaxis(frames, 0, axis), header(axis) | fields)
    return folder / "a.nrrd"


LAS = np.array([1, -1, 1])
SAME: dict[str, Callable[[Path], Path]] = {
    "frames along the second axis": lambda folder: other(folder, 1),
    "left, anterior, superior": lambda folder: other(
        folder, **{"space": "LAS", "space directions": directions(0) * LAS,
                   "space origin": v.ORIGIN * LAS}),
    "a line and bytes skipped": lambda folder: skipped(folder, line_skip="1", byte_skip="5"),
}  # fmt: skip


@pytest.mark.parametrize("what", SAME)
def test_the_same_volume(tmp_path: Path, what: str) -> None:
    found = read(SAME[what](tmp_path))
    v.assert_same(found, SEQUENCE)
    assert found.frames.flags.c_contiguous


@pytest.mark.parametrize("kind", ["NRRD", "MetaImage", "NIfTI"])
def test_a_left_handed_volume_stays_left_handed(tmp_path: Path, kind: str) -> None:
    if kind == "NIfTI":
        path = nifti(tmp_path / "a.nii", "NIfTI-1", "uint8", "qform only", v.MIRRORED)
        found = read(path)
    else:
        name = {"NRRD": "a.nrrd", "MetaImage": "a.mha"}[kind]
        found = read(by_itk(tmp_path / name, direction=v.MIRRORED), time_unit="s")
    expected = VolumeSequence(v.frames(), v.SPACING, v.MIRRORED, v.ORIGIN, EVEN)
    v.assert_same(found, expected)


def test_the_hash_is_that_of_all_files(tmp_path: Path) -> None:
    one = read(made(tmp_path))
    assert one.source == "a.nrrd"
    assert one.sha256 == hashlib.sha256((tmp_path / "a.nrrd").read_bytes()).hexdigest()
    both = [skipped(tmp_path, byteskip="-1").read_bytes(), (tmp_path / "a.raw").read_bytes()]
    assert read(tmp_path / "a.nhdr").sha256 == hashlib.sha256(b"".join(both)).hexdigest()


def test_time_as_an_axis_of_the_world(tmp_path: Path) -> None:
    vectors = np.zeros((4, 4))
    vectors[:3, :3], vectors[3, 3] = (v.ROTATION * v.SPACING).T, 40
    fields = header(3) | {
        "space": "left-posterior-superior-time",
        "space directions": vectors,
        "space units": ["mm", "mm", "mm", "ms"],
        "space origin": np.append(v.ORIGIN, 0.0),
    }
    for name in ("units", "axis 3 index values", "axis 3 index type"):
        del fields[name]
    nrrd.write(str(tmp_path / "a.nrrd"), np.moveaxis(v.frames(), 0, 3), fields)
    v.assert_same(read(tmp_path / "a.nrrd"), SEQUENCE)


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


def test_times_without_a_unit_take_the_users(tmp_path: Path) -> None:
    path = made(tmp_path, units=None, **{TIMES: "0 30 80"})
    np.testing.assert_allclose(read(path, time_unit="ms").times, [0, 0.03, 0.08])


@pytest.mark.parametrize(
    ("stored", "kind", "first"),
    [(">i4", "int16", -50), ("<f8", "float32", -50), ("<u2", "float32", 60000)],
)
def test_types_of_voxels(tmp_path: Path, stored: str, kind: str, first: int) -> None:
    expected = v.frames("int32") + first
    found = read(other(tmp_path, frames=expected.astype(stored)))
    assert found.frames.dtype == kind
    np.testing.assert_array_equal(found.frames, expected)


def test_a_recording_lies_where_slicerheart_places_it(tmp_path: Path) -> None:
    """SlicerHeart gives 3D Slicer an image of these spacings without origin and directions.

    Slicer's world is RAS: voxel (i, j, k) is at (1.5 i, 1.25 j, k) there, which in LPS has the
    first two signs turned.
    """
    recording = read_volume(philips(tmp_path / "a.dcm"))
    found = recording.world(np.array([3.0, 5.0, 7.0]))
    np.testing.assert_allclose(found, [-4.5, -6.25, 7.0], atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "before"),
    [(v.SHAPE, b"\x07" * 64), ((3, 17, 19, 21), b""), ((4, 32, 32, 32), b"")],
    ids=["the last bytes", "an odd number", "not kept in memory"],
)
def test_voxels_of_a_recording(tmp_path: Path, shape: tuple[int, ...], before: bytes) -> None:
    data = dataset(shape, before)
    if before:
        del data.SOPClassUID  # its private fields tell it
    found = read_volume(philips(tmp_path / "a.dcm", data=data))
    np.testing.assert_array_equal(found.frames, v.frames(shape=shape))


Bad = tuple[Callable[[Path], Path], str, str]


def of_nrrd(field: str, words: str, **changes: str | None) -> Bad:
    return lambda folder: made(folder, **changes), f"{field}: ", words


def of_metaimage(pattern: str, by: str, field: str) -> Bad:
    def make(folder: Path) -> Path:
        path = by_itk(folder / "a.mha")
        head, mark, voxels = path.read_bytes().partition(b"LOCAL\n")
        text, count = re.subn(pattern, by, (head + mark).decode(), count=1)
        assert count == 1
        path.write_bytes(text.encode() + voxels)
        return path

    return make, field, ""


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


def steps(text: str) -> dict[str, str]:
    return {"space directions": f"none {text}"}


PLACE, PATH = "space directions", "file in the same folder"
BAD: dict[str, Bad] = {
    "colour": of_nrrd("kinds", "one grey value", kinds="RGB-color domain domain domain"),
    "no spacing": of_nrrd(PLACE, "a vector in mm", **{PLACE: None}),
    "no origin": of_nrrd("space origin", "centre of the first voxel", **{"space origin": None}),
    "unknown space": of_nrrd("space", "left-posterior-superior", space="scanner-xyz"),
    "all axes in space": of_nrrd(
        PLACE, "three, and 'none' for the frames", **{PLACE: "(1,0,0) (0,1,0) (0,0,1) (1,1,0)"}),
    "no right angles": of_nrrd(PLACE, "right angles", **steps("(1,0,0) (0.1,1,0) (0,0,1)")),
    "spacing in cm": of_nrrd(PLACE, "0.05 to 5 mm", **steps("(0.04,0,0) (0,0.04,0) (0,0,0.04)")),
    "origin far away": of_nrrd(
        "space origin", "coordinates in mm", **{"space origin": "(1e6,0,0)"}),
    "space units": of_nrrd(
        "space units", "mm, cm, m or um", **{"space units": '"mm" "inch" "mm"'}),
    "time runs back": of_nrrd(VALUES, "increasing times", **{TIMES: "0 0.05 0.03"}),
    "ms taken for s": of_nrrd(VALUES, "less than 1 s", **{TIMES: "0 30 60"}),
    "s taken for ms": of_nrrd(VALUES, "at least 0.002 s", units='"ms" "" "" ""'),
    "a time is missing": of_nrrd(VALUES, "each of 3 frames", **{TIMES: "0 0.03"}),
    "a segmentation": of_nrrd("Segment0_ID", "an image", **{"Segment0_ID=": "Leaf"}),
    "fewer voxels than bytes": of_nrrd("damaged", "", sizes="3 16 17 20"),
    "data elsewhere": of_nrrd("data file", PATH, **{"data file": "../a.raw"}),
    "MetaImage: no spacing": of_metaimage(r"ElementSpacing = .*\n", "", "ElementSpacing"),
    "no offset": of_metaimage(r"Offset = .*\n", "", "Offset"),
    "space and time": of_metaimage(r"(TransformMatrix = .*) 0 1\n", r"\1 0.5 1\n", "Transform"),
    "more voxels": of_metaimage(r"DimSize = 16", "DimSize = 17", "ElementDataFile"),
    "channels": of_metaimage(r"ElementType", "ElementNumberOfChannels = 3\nElementType", "Element"),
    "an offset of data": of_metaimage(r"ElementType", "HeaderSize = 12\nElementType", "HeaderSize"),
    "NIfTI: no direction": of_nifti(
        lambda h: h.set_sform(None, "unknown"), "sform_code", "a direction"),
    "two spacings": of_nifti(
        lambda h: h["pixdim"].__setitem__(2, 2.5), "pixdim", "the spacing of sform"),
    "hertz": of_nifti(
        lambda h: h.set_xyzt_units("mm", "hz"), "xyzt_units", "a fourth axis of time"),
    "RGB": of_nifti(lambda h: h.set_data_dtype("RGB"), "data", "no colour"),
    "CT": of_dicom("SOPClassUID", "1.2.840.10008.5.1.4.1.1.2", "SOPClassUID", "3D Slicer"),
    "no slice spacing": of_dicom((0x3001, 0x1003), None, "(3001,1003)", "a number"),
    "no cm": of_dicom("PhysicalUnitsXDirection", 4, "PhysicalUnitsXDirection", "which is cm"),
    "two bytes": of_dicom("BitsAllocated", 16, "BitsAllocated", "one grey value of a byte"),
    "more frames than bytes": of_dicom("NumberOfFrames", 4, "PixelData", "22848 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    make, field, words = BAD[what]
    path = make(tmp_path)
    unit = {"time_unit": "s"} if path.suffix == ".mha" else {}
    v.assert_refused(path, field, words, modality=Modality.ULTRASOUND, **unit)


def test_a_data_file_that_is_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "inside").mkdir()
    path = skipped(tmp_path / "inside", byteskip="-1")
    (tmp_path / "inside" / "a.raw").rename(tmp_path / "out.raw")
    (tmp_path / "inside" / "a.raw").symlink_to(tmp_path / "out.raw")
    with pytest.raises(InputError, match="data file"):
        read(path)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_frame_that_shows_nothing_is_refused(tmp_path: Path, value: float) -> None:
    voxels = v.frames("float32")
    voxels[2] = value
    if value:
        voxels[2, :10] = 1.0
    path = other(tmp_path, frames=voxels)
    with pytest.raises(InputError, match=r"a\.nrrd: data: .* frame 2 (are 0|that are no)"):
        read(path)


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
