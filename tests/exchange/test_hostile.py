"""Damaged and hostile files are refused in one line, by the readers and by the command."""

import base64
import gzip
import io
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest

from experiments import cli
from mvest.cases.folder import read_case
from mvest.errors import MvestError
from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_surface
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality
from tests.cases import folders
from tests.exchange.surfaces.glb import described
from tests.exchange.variants import MARKUPS, SURFACES, VOLUMES

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits are those of Linux")

MIB = 2**20
LONG = b"1" + 400 * b"0"
VARIANTS = {str(variant): variant for variant in (*SURFACES, *VOLUMES, *MARKUPS)}
VTK = "VTK: 4.2, text, int32, scalars"
STL = "STL: VTK text"
PLY = "PLY: ascii, float, uchar"
OBJ = "OBJ: groups"
VTP = "VTP: text, plain, UInt64, LittleEndian, Int64"
VTU = "VTU: text, plain, UInt64, LittleEndian, Int64"
NRRD = "NRRD by pynrrd: .seq.nrrd, frames last, gzip, uint8"
NIFTI = "NIfTI: NIfTI-1, uint8, .nii.gz"
META = "MetaImage: .mha, 4D, uint8, compressed"
DICOM = "Philips Cartesian DICOM: explicit, preamble"
Change = Callable[[bytes], bytes]


def zeros(mib: int) -> bytes:
    """Zeros as zlib packs them, soon: each MiB but the first is packed alike after a full flush."""
    stream = zlib.compressobj(9)
    first, again = (stream.compress(bytes(MIB)) + stream.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    return first + again * (mib - 1) + stream.flush()


def gzip_of_zeros(mib: int) -> bytes:
    return gzip.compress(b"")[:10] + zeros(mib)[2:]


def replaced(old: bytes, new: bytes) -> Change:
    def change(whole: bytes) -> bytes:
        assert old in whole
        return whole.replace(old, new, 1)

    return change


def vtk_bomb(whole: bytes, mib: int = 4096) -> bytes:
    """Points that are one compressed block of zeros."""
    packed = zeros(mib)
    head = struct.pack("<4Q", 1, mib * MIB, 0, len(packed))
    whole = whole.replace(b"<VTKFile ", b'<VTKFile compressor="vtkZLibDataCompressor" ')
    start = whole.index(b'format="ascii"', whole.index(b'Name="Points"'))
    text = base64.b64encode(head) + base64.b64encode(packed)
    return whole[:start] + b'format="binary">' + text + whole[whole.index(b"</DataArray>", start) :]


def billion_laughs(whole: bytes) -> bytes:
    """Entities of entities: a few bytes of XML that stand for gigabytes of text."""
    rows = [b'<!ENTITY a0 "0 0 0 0 0 0 0 0 0 0 ">']
    rows += [b'<!ENTITY a%d "%s">' % (k, b"&a%d;" % (k - 1) * 10) for k in range(1, 10)]
    start = whole.index(b">", whole.index(b'Name="Points"')) + 1
    body = whole[:start] + b"&a9;" + whole[whole.index(b"</DataArray>", start) :]
    return b'<?xml version="1.0"?><!DOCTYPE VTKFile [' + b"".join(rows) + b"]>" + body


def nrrd_bomb(whole: bytes) -> bytes:
    """Voxels of 17 kB by their header, which inflate to 4 GiB."""
    return whole[: whole.index(b"\n\n") + 2] + gzip_of_zeros(4096)


def nifti_bomb(whole: bytes) -> bytes:
    return gzip.compress(gzip.decompress(whole)[:352]) + gzip_of_zeros(4096)


def meta_bomb(whole: bytes) -> bytes:
    return whole[: whole.index(b"LOCAL\n") + 6] + zeros(4096)


def dicom_long(whole: bytes) -> bytes:
    """Voxels whose length is said to be almost 4 GiB."""
    at = whole.index(b"\xe0\x7f\x10\x00OB\0\0") + 8
    return whole[:at] + struct.pack("<I", 0xFFFFFFF0) + whole[at + 4 :]


def damaged(whole: bytes) -> bytes:
    """One of the last bits but some is another."""
    return whole[:-2000] + bytes([whole[-2000] ^ 0xFF]) + whole[-1999:]


def dicom_huge(whole: bytes) -> bytes:
    data = pydicom.dcmread(io.BytesIO(whole))
    data.Rows = data.Columns = data[0x3001, 0x1001].value = 9000
    pydicom.dcmwrite(content := io.BytesIO(), data)
    return content.getvalue()


HELD = "expected at most 4 GiB"
HUGE = replaced(b"16 17 21 3", b"9000 9000 9000 3")
ABSENT = "points that do not exist"
Hostile = tuple[str, Change, str]
HOSTILE: dict[str, Hostile] = {
    "VTP inflates to 4 GiB": (VTP, vtk_bomb, ""),
    "VTP of entities of entities": (VTP, billion_laughs, ""),
    "VTP of an entity outside": (VTP, lambda whole: (
        b'<!DOCTYPE l [<!ENTITY x SYSTEM "/etc/hostname">]>' + whole.replace(b"40 0 1", b"&x;")
    ), ""),
    "OBJ in another encoding": (OBJ, lambda whole: whole.decode().encode("utf-16"), ""),
    "NRRD inflates to 4 GiB": (NRRD, nrrd_bomb, "needs more than 1 GiB"),
    "NRRD of 9000^3 voxels": (NRRD, HUGE, HELD),
    "NRRD skips 10^9 lines": (
        NRRD, replaced(b"encoding", b"line skip: 1000000000\nencoding"), "line skip"),
    "NRRD of damaged gzip": (NRRD, damaged, ""),
    "NIfTI inflates to 4 GiB": (NIFTI, nifti_bomb, "needs more than 1 GiB"),
    "NIfTI of damaged gzip": (NIFTI, damaged, ""),
    "MetaImage inflates to 4 GiB": (META, meta_bomb, "needs more than 1 GiB"),
    "MetaImage of 9000^3 voxels": (META, HUGE, HELD),
    "MetaImage of damaged zlib": (META, damaged, ""),
    "MetaImage of 10^400 voxels": (META, replaced(b"16 17 21 3", b"16 17 21 " + LONG), ""),
    "MetaImage in another folder": (
        META, lambda whole: whole[: whole.index(b"LOCAL")] + b"/dev/zero\n", "same folder"),
    "DICOM with a value of 4 GiB": (DICOM, dicom_long, ""),
    "DICOM of 9000^3 voxels": (DICOM, dicom_huge, HELD),
    "markups of 5000 digits": ("Markups: 1.0.3, LPS", replaced(b"-6.25", b"1" * 5000), ""),
    "nested markups": ("Markups: 1.0.3, LPS", lambda _: b"[" * 10**6, ""),
}  # fmt: skip
STRUCTURED = b"# vtk DataFile Version 4.2\nx\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 1 1 1\n"
CELLS = b"POLYGONS 3 12\n3 0 1 2 \n3 2 1 3 \n3 1 4 3 \n"
DAMAGED: tuple[tuple[str, bytes | None, bytes, str], ...] = (
    (VTK, None, b"", "damaged"),
    (VTK, b"POINTS 5", b"POINTS 2147483648", "damaged"),
    (VTK, None, b"# vtk DataFile Version 4.2\nx\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n0 0 1",
     "damaged: Error reading ascii"),
    (VTK, b"40 0 1", b"nan 0 1", r"points \[4\] are not finite"),
    (VTK, b"3 1 4 3", b"3 1 5 3", ABSENT),
    (VTK, b"3 1 4 3", b"3 1 4 -1", ABSENT),
    ("VTK: 5.1, text, int32, scalars", b"0 3 6 9", b"0 900 6 9", ABSENT),
    (VTK, b"SCALARS region int \nLOOKUP_TABLE default", b"FIELD f 1\nregion 1 9 int\n1 2 2 1 2 2",
     "'region' has 9 rows, expected 3 cells"),
    (VTK, CELLS, CELLS.replace(b"POLYGONS", b"LINES"), "no triangles"),
    (VTK, None, STRUCTURED + b"ORIGIN 0 0 0\nSPACING 1 1 1\n", "expected PolyData"),
    (VTP, None, b"nonsense", "damaged: Error parsing XML"),
    (VTP, None, b"<VTKFile type='ImageData'/>", "damaged: Cannot find PolyData"),
    (VTP, b'NumberOfPolys="3"', b'NumberOfPolys="2147483648"', "damaged"),
    (VTP, b"1 4 3", b"1 5 3", ABSENT),
    (VTP, b"0 1 2", b"0 1 " + LONG, ""),
    (VTU, b"3 6 9", b"6 3 9", ""),
    (STL, None, b"", "0 bytes, expected 84"),
    (STL, None, bytes(80) + b"\xff\xff\xff\xff" + bytes(150), "expected 214748364834 for"),
    (STL, None, bytes(84), "no points"),
    (STL, b"endsolid", b"", "9 corners, expected three of each facet and endsolid"),
    (STL, b"vertex 40", b"vertex x", "damaged"),
    (PLY, None, b"nonsense", "damaged or no PLY"),
    (PLY, b"ascii", b"EBCDIC", "format EBCDIC, expected ascii, binary_"),
    (PLY, b"vertex 5", b"vertex 2147483648", "rows too early"),
    (PLY, b"float x", b"float w", "no element vertex with x, y and z"),
    (PLY, b"3 1 4 3", b"3 1 4 3 5", "1 numbers more than its header says"),
    (OBJ, None, b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
    (OBJ, b"f 2 5 4", b"f 2 9 4", ABSENT),
    (OBJ, b"f 2 5 4", b"f 2 0 4", ABSENT),
    (OBJ, b"f 2 5 4", b"f 2 -6 4", ABSENT),
    (OBJ, b"v 40.0", b"v 1e12", r"points \[4\] .* 1e\+09"),
    (OBJ, b"v 40.0 0.0 1.0", b"v 40.0 0.0", "damaged"),
)  # fmt: skip
"""A piece of a file (None: all of it), what replaces it, and words of the error."""
for number, (kind, before, after, words) in enumerate(DAMAGED):
    change = (lambda _, content=after: content) if before is None else replaced(before, after)
    HOSTILE[f"{kind}: {number}"] = kind, change, words


def read(path: Path) -> object:
    if path.suffix == ".json":
        return read_markups(path)
    if path.suffix in (".nrrd", ".gz", ".nii", ".mha", ".dcm"):
        unit = {"time_unit": "s"} if path.suffix == ".mha" else {}
        return read_volume(path, modality=Modality.ULTRASOUND, **unit)
    return read_surface(path)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_damaged_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    kind, change, words = HOSTILE[name]
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
    # Whatever became of the child, another file is read.
    path.write_bytes(whole)
    read(path)


def test_files_that_are_not_there_or_of_no_kind_are_named(tmp_path: Path) -> None:
    with pytest.raises(MvestError, match=r"a\.stl: no such file"):
        read(tmp_path / "a.stl")
    with pytest.raises(
        MvestError, match=r"extension '\.off', expected .*\.stl, \.obj, \.ply, \.vtk"
    ):
        read(tmp_path / "a.off")


SCENES: dict[str, tuple[Callable[[Any], object], str]] = {
    "compressed": (lambda d: d.update(extensionsRequired=["KHR_draco"]), "needs KHR_draco"),
    "data elsewhere": (lambda d: d["buffers"][0].update(uri="a.bin"), "damaged"),
    "far more": (lambda d: d["accessors"][0].update(count=2**40), "damaged"),
    "sparse": (lambda d: d["accessors"][0].update(sparse={}), "needs sparse or compressed arrays"),
    "far away": (lambda d: d["nodes"][0].update(translation=[1e300, 0, 0]), "not finite numbers"),
    "no nodes": (lambda d: d["scenes"][0].update(nodes=[]), "no points"),
    "version 1": (lambda _: None, "only GLTF 2"),
}


@pytest.mark.parametrize("name", SCENES)
def test_scenes_that_are_damaged_or_packed_otherwise(name: str, tmp_path: Path) -> None:
    change, words = SCENES[name]
    path = tmp_path / "a.glb"
    VARIANTS["GLB: one mesh"].write(path)
    version = 1 if name == "version 1" else 2
    path.write_bytes(described(path.read_bytes(), change, version))
    with pytest.raises(MvestError, match=words):
        read(path)


CUT = (
    *("VTP: base64, zlib, UInt32, LittleEndian, Int32", "GLB: one mesh"),
    *("VTK: 4.2, text, int32, scalars", "VTK: 5.1, binary, int32, scalars"),
    *("STL: VTK binary", STL, PLY, "PLY: binary little endian, float, uchar"),
    *(NRRD, META, "MetaImage: .mha, 4D, uint8, plain", NIFTI, DICOM, "Markups: 1.0.3, LPS"),
)


@pytest.mark.parametrize("name", CUT)
def test_a_file_cut_anywhere_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / VARIANTS[name].file
    VARIANTS[name].write(path)
    whole = path.read_bytes()
    for share in (0.01, 0.3, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(MvestError):
            read(path)


def zip_bomb(path: Path, mib: int = 4096) -> None:
    """4 GiB of zeros as each array of a ``.npz``, 12 MB large."""
    text = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({mib * MIB},), }}".encode()
    head = np.lib.format.magic(1, 0) + struct.pack("<H", 118) + text.ljust(117) + b"\n"
    stream = zlib.compressobj(9, wbits=-zlib.MAX_WBITS)
    packed = stream.compress(head) + stream.flush(zlib.Z_FULL_FLUSH) + zeros(mib)[2:-4]
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("frames", "vertices", "tips"):
            archive.writestr(f"{name}.npy", packed)
        # The directory at the end, which is what counts, says that they are compressed.
        for member in archive.infolist():
            member.compress_type, member.file_size = zipfile.ZIP_DEFLATED, len(head) + mib * MIB


def test_a_zip_bomb_in_a_case(tmp_path: Path) -> None:
    document = folders.plain_folder(tmp_path / "case")
    document["observation"] = {
        "std_mm": 0.7, "correlation_length_mm": 10, "error_samples": "errors.npz"
    }  # fmt: skip
    folders.save(tmp_path / "case", document)
    zip_bomb(tmp_path / "case" / "errors.npz")
    with pytest.raises(MvestError, match=r"errors\.npz: \d+ bytes of arrays"):
        read_case(tmp_path / "case")


@pytest.mark.parametrize("name", ["gzip", "zip"])
def test_a_bomb_is_one_line_of_the_command(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.nii.gz"
    if name == "zip":
        zip_bomb(path)
    else:
        VARIANTS[NIFTI].write(path)
        path.write_bytes(nifti_bomb(path.read_bytes()))
    given = ["tips=[-16,0,-25,16,0,-25]"]
    assert cli.main(["import", "leaflets", str(path), str(tmp_path / "case"), *given]) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert path.name in said.err
    assert not (tmp_path / "case").exists()
