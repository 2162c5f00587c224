"""Damaged and hostile files are refused in one line, by the readers."""

import gzip
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from mvest.errors import MvestError
from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_surface
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality
from tests.exchange.variants import MARKUPS, SURFACES, VOLUMES

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits are those of Linux")

MIB = 2**20
VARIANTS = {str(variant): variant for variant in (*SURFACES, *VOLUMES, *MARKUPS)}
VTK, STL, PLY, OBJ = "VTK: 4.2, text, int32, scalars", "STL: VTK text", "PLY: VTK text", "OBJ: VTK"
VTP = "VTP: text, plain, UInt64, LittleEndian, Int64"
NRRD = "NRRD by pynrrd: .seq.nrrd, frames last, gzip, uint8"
NIFTI = "NIfTI: NIfTI-1, uint8, .nii.gz"
META = "MetaImage: .mha, 4D, uint8, compressed"
DICOM = "Philips Cartesian DICOM: explicit, preamble"
Change = Callable[[bytes], bytes]


def zeros(mib: int) -> bytes:
    """A zlib stream of zeros: after a full flush every MiB has the same bytes."""
    stream = zlib.compressobj(9)
    first, again = (stream.compress(bytes(MIB)) + stream.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    return first + again * (mib - 1) + stream.flush()


def replaced(old: bytes, new: bytes) -> Change:
    def change(whole: bytes) -> bytes:
        assert old in whole
        return whole.replace(old, new, 1)

    return change


def billion_laughs(whole: bytes) -> bytes:
    """Entities of entities: a few bytes of XML that stand for gigabytes of text."""
    rows = [b'<!ENTITY a0 "0 0 0 0 0 0 0 0 0 0 ">']
    rows += [b'<!ENTITY a%d "%s">' % (k, b"&a%d;" % (k - 1) * 10) for k in range(1, 10)]
    start = whole.index(b">", whole.index(b'Name="Points"')) + 1
    body = whole[:start] + b"&a9;" + whole[whole.index(b"</DataArray>", start) :]
    return b'<?xml version="1.0"?><!DOCTYPE VTKFile [' + b"".join(rows) + b"]>" + body


def nifti_bomb(whole: bytes) -> bytes:
    zipped = gzip.compress(b"")[:10] + zeros(4096)[2:]
    return gzip.compress(gzip.decompress(whole)[:352]) + zipped


def dicom_long(whole: bytes) -> bytes:
    """Voxels whose stated length is almost 4 GiB."""
    at = whole.index(b"\xe0\x7f\x10\x00OB\0\0") + 8
    return whole[:at] + struct.pack("<I", 0xFFFFFFF0) + whole[at + 4 :]


def flipped(whole: bytes) -> bytes:
    """One of the last bytes inverted."""
    return whole[:-2000] + bytes([whole[-2000] ^ 0xFF]) + whole[-1999:]


ABSENT = "points that do not exist"
REFUSED: tuple[tuple[str, Change, str], ...] = (
    (VTP, billion_laughs, ""),
    (VTP, lambda whole: (
        b'<!DOCTYPE l [<!ENTITY x SYSTEM "/etc/hostname">]>' + whole.replace(b"40 0 1", b"&x;")
    ), ""),
    (NRRD, replaced(b"encoding", b"line skip: 1000000000\nencoding"), "line skip"),
    (NRRD, replaced(b"16 17 21 3", b"9000 9000 9000 3"), "expected at most 4 GiB"),
    (NIFTI, nifti_bomb, "needs more than 1 GiB"),
    (NIFTI, flipped, ""),
    (META, flipped, ""),
    (META, lambda whole: whole[: whole.index(b"LOCAL")] + b"/dev/zero\n", "same folder"),
    (DICOM, dicom_long, ""),
    ("Markups: 1.0.3, LPS", lambda _: b"[" * 10**6, ""),
    (VTK, lambda _: b"# vtk DataFile Version 4.2\nx\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n0 1",
     "damaged: Error reading ascii"),
    (VTK, replaced(b"40 0 1", b"nan 0 1"), r"points \[4\] are not finite"),
    (VTK, replaced(b"3 1 4 3", b"3 1 5 3"), ABSENT),
    (VTK, replaced(b"SCALARS region int \nLOOKUP_TABLE default",
                   b"FIELD f 1\nregion 1 9 int\n1 2 2 1 2 2"),
     "'region' has 9 rows, expected 3 cells"),
    (VTK, lambda _: b"# vtk DataFile Version 4.2\nx\nASCII\nDATASET STRUCTURED_POINTS\n"
     b"DIMENSIONS 1 1 1\nORIGIN 0 0 0\nSPACING 1 1 1\n", "expected PolyData"),
    (STL, lambda _: bytes(80) + b"\xff\xff\xff\xff" + bytes(150), "expected 214748364834 for"),
    (PLY, replaced(b"vertex 5", b"vertex 4"), "expected 4 vertices and 3 faces"),
    (OBJ, lambda _: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
    (OBJ, replaced(b"f 2 5 4", b"f 2 9 4"), ABSENT),
    (OBJ, replaced(b"f 2 5 4", b"f 2 0 4"), "damaged: Unexpected point index"),
)  # fmt: skip
"""A kind of file, a change of its bytes, and words of the error."""


def read(path: Path) -> object:
    if path.suffix == ".json":
        return read_markups(path)
    if path.suffix in (".nrrd", ".gz", ".mha", ".dcm"):
        unit = {"time_unit": "s"} if path.suffix == ".mha" else {}
        return read_volume(path, modality=Modality.ULTRASOUND, **unit)
    return read_surface(path)


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_a_damaged_file_is_refused_in_one_line(number: int, tmp_path: Path) -> None:
    kind, change, words = REFUSED[number]
    path = tmp_path / VARIANTS[kind].file
    VARIANTS[kind].write(path)
    whole = path.read_bytes()
    path.write_bytes(change(whole))
    with pytest.raises(MvestError, match=words or None) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()
    assert len(message) < 400 + len(str(path))
    # Even if the child was stopped, another file is read.
    path.write_bytes(whole)
    read(path)


def test_missing_files_and_unknown_suffixes_are_named(tmp_path: Path) -> None:
    for name, words in (
        ("a.stl", "no such file"),
        ("a.off", r"extension '\.off', expected .*\.stl"),
    ):
        with pytest.raises(MvestError, match=words):
            read(tmp_path / name)


CUT = (
    *("VTP: base64, zlib, UInt32, BigEndian, Int32", "GLB: one mesh", VTK, STL, "STL: VTK binary"),
    *("VTK: 5.1, binary, int64, a field", "PLY: VTK little endian", PLY, NRRD, META, NIFTI, DICOM),
)


@pytest.mark.parametrize("name", CUT)
def test_a_truncated_file_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / VARIANTS[name].file
    VARIANTS[name].write(path)
    whole = path.read_bytes()
    for share in (0.3, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(MvestError):
            read(path)
