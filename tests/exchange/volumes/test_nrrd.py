import hashlib
from pathlib import Path

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volume_variants import by_itk
from tests.exchange.volumes import volumes as v

VALUES = "axis 0 index values"
TIMES = f"{VALUES}="


def read(path: Path) -> VolumeSequence:
    return read_volume(path, modality=Modality.ULTRASOUND)


def test_the_frames_may_lie_along_any_axis(tmp_path: Path) -> None:
    fields = v.nrrd_fields(1) | {"encoding": "gzip"}
    path = v.write_nrrd(tmp_path / "a.seq.nrrd", fields, v.nrrd_voxels(1))
    found = read(path)
    v.assert_same(found, v.sequence())
    assert found.frames.flags.c_contiguous
    assert found.source == "a.seq.nrrd"
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_content_counts_and_not_the_name(tmp_path: Path) -> None:
    v.assert_same(read(v.write_nrrd(tmp_path / "a.nii.gz", v.nrrd_fields())), v.sequence())


def test_a_left_handed_volume_stays_left_handed(tmp_path: Path) -> None:
    path = v.write_nrrd(tmp_path / "a.nrrd", v.nrrd_fields(direction=v.MIRRORED))
    found = read(path)
    assert np.linalg.det(found.direction) == pytest.approx(-1)
    v.assert_same(found, v.sequence(direction=v.MIRRORED))


@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("RAS", (-1, -1, 1)),
        ("LAS", (1, -1, 1)),
        ("LPS", (1, 1, 1)),
    ],
)
def test_spaces_become_lps(tmp_path: Path, space: str, signs: tuple[int, int, int]) -> None:
    fields = v.nrrd_fields(direction=v.ROTATION * np.array(signs)[:, np.newaxis])
    fields |= {"space": space, "space origin": v.vector(v.ORIGIN * signs)}
    v.assert_same(read(v.write_nrrd(tmp_path / "a.nrrd", fields)), v.sequence())


@pytest.mark.parametrize("extra", ["space: left-posterior-superior\n", "space: LPS\n"])
def test_space_stated_twice_with_one_meaning(tmp_path: Path, extra: str) -> None:
    path = v.write_nrrd(tmp_path / "a.nrrd", v.nrrd_fields(), extra=extra)
    v.assert_same(read(path), v.sequence())


def test_carriage_returns_before_the_ends_of_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    text = v.nrrd_text(v.nrrd_fields()).replace(b"\n", b"\r\n")
    path.write_bytes(text + v.nrrd_voxels())
    v.assert_same(read(path), v.sequence())


def test_time_as_an_axis_of_the_world(tmp_path: Path) -> None:
    fields = v.nrrd_fields(3)
    steps = (v.ROTATION * v.SPACING).T
    vectors = [v.vector(np.append(step, 0.0)) for step in steps] + ["(0,0,0,40)"]
    for name in ("units", "axis 3 index values=", "axis 3 index type="):
        del fields[name]
    fields |= {
        "space": "left-posterior-superior-time",
        "space directions": " ".join(vectors),
        "space units": '"mm" "mm" "mm" "ms"',
        "space origin": v.vector(np.append(v.ORIGIN, 0.0)),
    }
    found = read(v.write_nrrd(tmp_path / "a.nrrd", fields, v.nrrd_voxels(3)))
    np.testing.assert_allclose(found.times, [0, 0.04, 0.08])
    np.testing.assert_array_equal(found.frames, v.frames())


def test_a_volume_over_time_by_itk_has_no_unit_of_time(tmp_path: Path) -> None:
    by_itk(tmp_path / "a.nrrd", "4D", "uint8", "plain")
    with pytest.raises(InputError, match=r"space directions: times without a unit.*time_unit"):
        read(tmp_path / "a.nrrd")


def test_frames_that_are_named_take_the_users_interval(tmp_path: Path) -> None:
    fields = v.nrrd_fields() | {
        "axis 0 index type=": "text",
        "axis 0 index values=": "ED%20frame mid ES",
    }
    path = v.write_nrrd(tmp_path / "a.seq.nrrd", fields)
    with pytest.raises(InputError, match=r"index type: no times of frames.* give frame_interval_s"):
        read(path)
    found = read_volume(path, modality=Modality.CT, frame_interval_s=0.05)
    np.testing.assert_allclose(found.times, [0, 0.05, 0.1])


def test_times_without_a_unit_take_the_users(tmp_path: Path) -> None:
    fields = v.nrrd_fields() | {"axis 0 index values=": "0 30 80"}
    del fields["units"]
    path = v.write_nrrd(tmp_path / "a.nrrd", fields)
    found = read_volume(path, modality=Modality.CT, time_unit="ms")
    np.testing.assert_allclose(found.times, v.TIMES)
    assert found.modality is Modality.CT
    found = read_volume(path, modality=Modality.CT, frame_interval_s=0.05)
    np.testing.assert_allclose(found.times, [0, 0.05, 0.1])
    with pytest.raises(InputError, match=r"a\.nrrd: axis 0 index values: times without a unit"):
        read(path)


@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_data_beside_their_header(tmp_path: Path, encoding: str) -> None:
    fields = v.nrrd_fields() | {"encoding": encoding, "data file": "./a.bin"}
    attached = v.write_nrrd(tmp_path / "attached.nrrd", fields)
    text = v.nrrd_text(fields)
    (tmp_path / "a.bin").write_bytes(attached.read_bytes()[len(text) :])
    header = tmp_path / "a.nhdr"
    header.write_bytes(text)
    found = read(header)
    v.assert_same(found, v.sequence())
    both = header.read_bytes() + (tmp_path / "a.bin").read_bytes()
    assert found.sha256 == hashlib.sha256(both).hexdigest()


def test_bytes_and_lines_before_the_data_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "a.raw").write_bytes(b"one line\n12345" + v.nrrd_voxels())
    path = tmp_path / "a.nhdr"
    for skips in ({"line skip": "1", "byte skip": "5"}, {"byteskip": "-1"}):
        path.write_bytes(v.nrrd_text(v.nrrd_fields() | {"data file": "a.raw"} | skips))
        v.assert_same(read(path), v.sequence())


@pytest.mark.parametrize(
    ("stored", "endian", "kind"),
    [
        ("int8", "little", "int16"),
        ("int16", "big", "int16"),
        ("uint16", "little", "int16"),
        ("int32", "big", "int16"),
        ("float64", "little", "float32"),
    ],
)
def test_types_of_voxels(tmp_path: Path, stored: str, endian: str, kind: str) -> None:
    dtype = np.dtype(stored).newbyteorder("<" if endian == "little" else ">")
    name = {"float32": "float", "float64": "double"}.get(stored, stored)
    expected = (v.frames("int32") - (100 if stored != "uint8" and stored[0] != "u" else 0)) // 2
    voxels = expected.astype(dtype).tobytes(order="F")
    fields = v.nrrd_fields() | {"type": name, "endian": endian}
    found = read(v.write_nrrd(tmp_path / "a.nrrd", fields, voxels))
    assert found.frames.dtype == kind
    np.testing.assert_array_equal(found.frames, expected)


def test_integers_beyond_two_bytes_become_floats(tmp_path: Path) -> None:
    values = v.frames("uint16") + np.uint16(60000)
    fields = v.nrrd_fields() | {"type": "ushort"}
    found = read(v.write_nrrd(tmp_path / "a.nrrd", fields, values.tobytes(order="F")))
    assert found.frames.dtype == np.float32
    np.testing.assert_array_equal(found.frames, values)


BAD: dict[str, tuple[dict[str, str | None], str, str]] = {
    "colour": ({"kinds": "RGB-color domain domain domain"}, "kinds", "one grey value"),
    "five axes": ({"dimension": "5"}, "dimension", "3 (one volume) or 4"),
    "sizes and dimension": ({"sizes": "3 20 24"}, "dimension", "3 (one volume) or 4"),
    "no sizes": ({"sizes": None}, "sizes", "a number for each axis"),
    "no spacing": ({"space directions": None}, "space directions", "a vector in mm"),
    "no origin": ({"space origin": None}, "space origin", "centre of the first voxel"),
    "no space": ({"space": None}, "space", "left-posterior-superior"),
    "unknown space": ({"space": "scanner-xyz"}, "space", "left-posterior-superior"),
    "all axes in space": (
        {"space directions": "(1,0,0) (0,1,0) (0,0,1) (1,1,0)"},
        "space directions",
        "three, and 'none' for the frames",
    ),
    "no axes at right angles": (
        {"space directions": "none (1,0,0) (0.1,1,0) (0,0,1)"},
        "space directions",
        "right angles",
    ),
    "spacing in cm": (
        {"space directions": "none (0.04,0,0) (0,0.04,0) (0,0,0.04)"},
        "space directions",
        "0.05 to 5 mm",
    ),
    "small extent": (
        {"space directions": "none (0.1,0,0) (0,0.1,0) (0,0,0.1)"},
        "space directions",
        "20 to 500 mm",
    ),
    "few voxels": ({"sizes": "3 20 24 8"}, "sizes", "at least 16"),
    "no frames": ({"sizes": "0 20 24 28"}, "sizes", "at least one frame"),
    "origin far away": ({"space origin": "(1e6,0,0)"}, "space origin", "coordinates in mm"),
    "units of length": ({"units": '"s" "deg" "" ""'}, "units", "mm"),
    "space units": ({"space units": '"mm" "inch" "mm"'}, "space units", "mm, cm, m or um"),
    "time runs back": ({TIMES: "0 0.05 0.03"}, VALUES, "increasing times"),
    "same time twice": ({TIMES: "0 0 0.03"}, VALUES, "increasing times"),
    "ms taken for s": ({TIMES: "0 30 60"}, VALUES, "less than 1 s"),
    "s taken for ms": ({"units": '"ms" "" "" ""'}, VALUES, "at least 0.002 s"),
    "a time is missing": ({TIMES: "0 0.03"}, VALUES, "each of 3 frames"),
    "a time is no number": ({TIMES: "0 0.03 end"}, VALUES, "numbers"),
    "a time is nan": ({TIMES: "0 nan 0.03"}, VALUES, "each of 3 frames"),
    "percent of a beat": ({"units": '"%" "" "" ""', TIMES: "0 5 10"}, VALUES, "times in s or ms"),
    "a segmentation": ({"Segment0_ID=": "Leaf"}, "Segment0_ID", "an image"),
    "a label map": (
        {"DataNodeClassName=": "vtkMRMLLabelMapVolumeNode"},
        "DataNodeClassName",
        "an image",
    ),
    "unknown modality": ({"mvest.modality=": "pet"}, "mvest.modality", "ultrasound, ct, mr"),
    "other encoding": ({"encoding": "zrl"}, "damaged", ""),
    "unknown type": ({"type": "block"}, "header", ""),
    "no order of bytes": ({"endian": None, "type": "short"}, "header", ""),
    "a number that is none": ({"sizes": "3 20 x 28"}, "header", ""),
    "more voxels than bytes": ({"sizes": "3 20 24 29"}, "damaged", ""),
    "fewer voxels than bytes": ({"sizes": "3 20 24 27"}, "damaged", ""),
    "data elsewhere": ({"data file": "../a.raw"}, "data file", "file in the same folder"),
    "data at an absolute path": ({"data file": "/etc/hostname"}, "data file", "the same folder"),
    "data in several files": ({"data file": "LIST"}, "data file", "a file in the same folder"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    changes, field, expected = BAD[what]
    fields = {k: value for k, value in (v.nrrd_fields() | changes).items() if value is not None}
    path = v.write_nrrd(tmp_path / "bad.nrrd", fields)
    v.assert_refused(path, f"{field}: ", expected, modality=Modality.ULTRASOUND)


def test_a_data_file_that_is_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "out.raw").write_bytes(v.nrrd_voxels())
    (folder / "a.raw").symlink_to(tmp_path / "out.raw")
    (folder / "a.nhdr").write_bytes(v.nrrd_text(v.nrrd_fields() | {"data file": "a.raw"}))
    with pytest.raises(InputError, match="data file"):
        read(folder / "a.nhdr")


@pytest.mark.parametrize(
    "extra", ["space: right-anterior-superior\n", "sizes: 3 20 28 24\n", "no field\n"]
)
def test_a_contradiction_is_refused(tmp_path: Path, extra: str) -> None:
    path = v.write_nrrd(tmp_path / "a.nrrd", v.nrrd_fields(), extra=extra)
    with pytest.raises(InputError, match=r"a\.nrrd: header: .*expected fields and keys"):
        read(path)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_a_frame_that_shows_nothing_is_refused(tmp_path: Path, value: float) -> None:
    voxels = v.frames("float32")
    voxels[2] = value
    if value:
        voxels[2, :10] = 1.0
    fields = v.nrrd_fields() | {"type": "float"}
    path = v.write_nrrd(tmp_path / "a.nrrd", fields, voxels.tobytes(order="F"))
    with pytest.raises(InputError, match=r"a\.nrrd: data: .* frame 2 (are 0|that are no)"):
        read(path)


def test_a_header_without_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    whole = v.nrrd_text(v.nrrd_fields())
    path.write_bytes(whole[:-1] + b"# more\n" * 200_000)
    with pytest.raises(InputError, match=r"header: no end in 1048576 bytes"):
        read(path)


def test_what_the_file_states_is_not_contradicted(tmp_path: Path) -> None:
    fields = v.nrrd_fields() | {"mvest.modality=": "ct"}
    path = v.write_nrrd(tmp_path / "a.nrrd", fields)
    assert read_volume(path).modality is Modality.CT
    with pytest.raises(InputError, match=r"a\.nrrd: modality: mr, expected ct"):
        read_volume(path, modality=Modality.MR)
    with pytest.raises(InputError, match=r"a\.nrrd: frame_interval_s: 0\.03, expected none"):
        read_volume(path, frame_interval_s=0.03)
    with pytest.raises(InputError, match=r"a\.nrrd: time_unit: 'ms', expected 's'"):
        read_volume(path, time_unit="ms")


def test_modality_must_be_known(tmp_path: Path) -> None:
    path = v.write_nrrd(tmp_path / "a.nrrd", v.nrrd_fields())
    with pytest.raises(InputError, match=r"a\.nrrd: modality: not stated .* ultrasound, ct, mr"):
        read_volume(path)
