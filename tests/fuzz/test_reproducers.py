"""What once took gigabytes or minutes, or ended in a traceback, each by itself."""

import base64
import gzip
import struct
import sys
import zlib
from collections.abc import Callable, Iterator

import nibabel
import numpy as np
import pytest

from tests.exchange.volumes import volumes as v
from tests.fuzz import readers_of_surfaces as surfaces
from tests.fuzz import readers_of_volumes as volumes
from tests.fuzz.child import Child
from tests.fuzz.readers import READERS
from tests.fuzz.trial import Bench

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits are those of Linux")

MIB = 2**20
LONG = "1" + 400 * "0"


def zeros(mib: int) -> bytes:
    """Zeros as zlib packs them, soon: each MiB but the first is packed alike after a full flush."""
    stream = zlib.compressobj(9)
    first, again = (stream.compress(bytes(MIB)) + stream.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    return first + again * (mib - 1) + stream.flush()


def gzip_of_zeros(mib: int) -> bytes:
    return gzip.compress(b"")[:10] + zeros(mib)[2:]


def vtk_bomb(kind: str, form: str, mib: int = 2048) -> bytes:
    """Points of a surface that are one compressed block of zeros."""
    packed = zeros(mib)
    head = struct.pack("<4Q", 1, mib * MIB, 0, len(packed))
    plain = surfaces.vtk_text(kind, "ascii").replace(
        b"<VTKFile ", b'<VTKFile compressor="vtkZLibDataCompressor" '
    )
    start = plain.index(b'format="ascii"')
    end = plain.index(b"</DataArray>", start)
    if form == "binary":
        text = base64.b64encode(head) + base64.b64encode(packed)
        return plain[:start] + b'format="binary">' + text + plain[end:]
    tail = b'<AppendedData encoding="raw">\n_' + head + packed + b"</AppendedData>\n</VTKFile>\n"
    return (
        plain[:start]
        + b'format="appended" offset="0">'
        + plain[end:].replace(b"</VTKFile>\n", tail)
    )


def many_arrays_of_the_same_bytes(whole: bytes) -> bytes:
    content = bytes(8 * 60000)
    array = b'<DataArray type="Float64" Name="a%d" format="appended" offset="0"/>'
    arrays = b"".join(array % k for k in range(4000))
    tail = b"_" + struct.pack("<Q", len(content)) + content + b"</AppendedData>\n</VTKFile>\n"
    return whole.replace(b"</CellData>", arrays + b"</CellData>").replace(
        b"</VTKFile>\n", b'<AppendedData encoding="raw">\n' + tail
    )


def nrrd(**fields: str) -> bytes:
    named = {name.replace("_", " "): value for name, value in fields.items()}
    return v.nrrd_text(volumes.nrrd_fields(0) | named) + volumes.nrrd_voxels(0)


def nrrd_packed(whole: bytes) -> bytes:
    """40 kB that declare 3.9 GiB."""
    fields = volumes.nrrd_fields(3) | {"encoding": "gzip", "sizes": "1000 1000 1000 4"}
    fields |= {
        "axis 3 index values=": "0 0.04 0.08 0.12",
        "space directions": "(0.1,0,0) (0,0.1,0) (0,0,0.1) none",
    }
    return v.nrrd_text(fields) + gzip_of_zeros(39)


def nifti_packed(whole: bytes) -> bytes:
    made = nibabel.Nifti1Header(gzip.decompress(whole)[:348])
    made.set_data_shape((1000, 1000, 1000, 2))
    return gzip.compress(made.binaryblock + b"\0\0\0\0") + gzip_of_zeros(39)


def metaimage(name: str, value: str) -> Callable[[bytes], bytes]:
    def change(whole: bytes) -> bytes:
        lines = whole.split(b"\n")
        at = next(k for k, line in enumerate(lines) if line.startswith(name.encode()))
        lines[at] = f"{name} = {value}".encode()
        return b"\n".join(lines)

    return change


def metaimage_packed(whole: bytes) -> bytes:
    size = metaimage("DimSize", "1000 1000 1000 2")
    head = metaimage("CompressedDataSize", "39000")(size(whole))
    return head[: head.index(b"LOCAL\n") + 6] + zeros(39)


def dicom_deflated(whole: bytes) -> bytes:
    """Zeros of 2 GiB behind a header that says that what follows is deflated."""
    uid = b"1.2.840.10008.1.2.1"
    length = len(uid) + 1
    longer = b"1.2.840.10008.1.2.1.99"
    short, long = struct.pack("<H", length) + uid + b"\0", struct.pack("<H", 22) + longer
    assert whole.count(short) == 1
    head = whole.replace(short, long)
    group = head.index(b"\x02\x00\x00\x00UL\x04\x00") + 8
    (size,) = struct.unpack_from("<I", head, group)
    size += 22 - length
    head = head[:group] + struct.pack("<I", size) + head[group + 4 :]
    return head[: group + 4 + size] + zeros(2048)[2:]


def dicom_long(whole: bytes) -> bytes:
    """Voxels whose length is said to be almost 4 GiB."""
    at = whole.index(b"\xe0\x7f\x10\x00OB\0\0") + 8
    return whole[:at] + struct.pack("<I", 0xFFFFFFF0) + whole[at + 4 :]


def replaced(old: str, new: str) -> Callable[[bytes], bytes]:
    def change(whole: bytes) -> bytes:
        assert old.encode() in whole
        return whole.replace(old.encode(), new.encode(), 1)

    return change


def far_point(whole: bytes) -> bytes:
    """A text STL of 8000 triangles within what is taken for one point beside a far one."""
    draw = np.random.default_rng(1)
    corners = draw.uniform(0, 1, (8000, 3, 3))
    corners[0, 0] = 1e8
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in points)
        + "endloop\nendfacet\n"
        for points in corners.tolist()
    )
    return f"solid a\n{facets}endsolid\n".encode()


def band(columns: int, rows: int, shuffled: bool) -> bytes:
    """A whole band of triangles, as it is or with its vertices anywhere."""
    i, j = np.divmod(np.arange(columns * (rows - 1)), rows - 1)
    a, b = i * rows + j, (i + 1) % columns * rows + j
    triangles = np.concatenate([np.stack([a, b, a + 1], 1), np.stack([b, b + 1, a + 1], 1)])
    phi, z = np.divmod(np.arange(columns * rows), rows)
    angle = 2 * np.pi * phi / columns
    points = np.column_stack([16 * np.cos(angle), 14 * np.sin(angle), -20 * z / (rows - 1)])
    if shuffled:
        points = np.random.default_rng(0).uniform(-15, 15, points.shape)
    count = len(triangles)
    region = (np.concatenate([i, i]) < columns // 2).astype(np.int8)
    arrays = {
        "points": ("Float64", points),
        "connectivity": ("Int64", triangles),
        "offsets": ("Int64", 3 * np.arange(1, count + 1)),
        "region": ("Int8", region),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces, "ARRAYS", arrays)
        return surfaces.vtk_text("vtp", "appended")


# Reader, number of its example, what is made of it, words of the message.
CASES: dict[str, tuple[str, int, Callable[[bytes], bytes], str]] = {
    "VTP inflates to 2 GiB": (
        *("surface.vtp", 1, lambda _: vtk_bomb("vtp", "binary"), "hold more than"),
    ),
    "appended VTP inflates to 2 GiB": (
        *("surface.vtp", 2, lambda _: vtk_bomb("vtp", "appended"), "hold more than"),
    ),
    "VTU inflates to 2 GiB": (
        *("surface.vtu", 1, lambda _: vtk_bomb("vtu", "binary"), "hold more than"),
    ),
    "many VTP arrays of the same bytes": (
        *("surface.vtp", 0, many_arrays_of_the_same_bytes, "more than a file of its size may"),
    ),
    "VTP of an unknown encoding": (
        *("surface.vtp", 0, replaced('version="1.0"?', 'version="1.0" encoding="x"?'), "damaged"),
    ),
    "VTP with an index of 400 digits": ("surface.vtp", 0, replaced("0 1 2", f"0 1 {LONG}"), "dam"),
    "VTP with an index that only Python reads": (
        *("surface.vtp", 0, replaced("0 1 2", "0 1 0_2"), "damaged numbers"),
    ),
    "VTP with offsets that fall": ("surface.vtp", 0, replaced("3 6 9", "6 3 9"), "offsets"),
    "VTU with offsets that fall": ("surface.vtu", 0, replaced("3 6 9", "6 3 9"), "offsets"),
    "VTP with arrays elsewhere": (
        *("surface.vtp", 2, replaced('offset="0"', f'offset="{LONG}"'), "offset"),
    ),
    "VTP with components without end": (
        *("surface.vtp", 0, replaced('Components="3"', 'Components="' + "9" * 30 + '"'), "damaged"),
    ),
    "OBJ with an index of 400 digits": ("surface.obj", 0, replaced("2//2", LONG), "damaged num"),
    "OBJ in another encoding": (
        *("surface.obj", 0, lambda whole: whole.decode().encode("utf-16"), "no triangles"),
    ),
    "OBJ that only Python reads": ("surface.obj", 0, replaced("20.0", "2_0"), "damaged numbers"),
    "PLY of 10^12 vertices": (
        *("surface.ply", 1, replaced("vertex 5", "vertex 1000000000000"), "ends within"),
    ),
    "PLY of corners without end": (
        *("surface.ply", 1, replaced("uchar int", "uint double"), "ends within"),
    ),
    "case of a surface of shuffled vertices": (
        *("case.surface", 0, lambda _: band(300, 40, True), "self-intersection"),
    ),
    "case of too many triangles": (
        *("case.surface", 0, lambda _: band(300, 90, False), "expected at most 50000"),
    ),
    "STL of 2^32 triangles": (
        *("surface.stl", 1, lambda whole: whole[:80] + b"\xff" * 4 + whole[84:], "bytes, expected"),
    ),
    "STL with a point far away": ("surface.stl-merged", 0, far_point, "far away"),
    "NRRD skips 10^9 lines": (
        *("volume.nrrd", 0, lambda _: nrrd(line_skip="1000000000"), "byte skip"),
    ),
    "NRRD skips 10^30 bytes": ("volume.nrrd", 0, lambda _: nrrd(byte_skip="1e30"), "byte skip"),
    "NRRD skips many bytes": (
        *("volume.nrrd", 0, lambda _: nrrd(byte_skip="1" + "0" * 30), "byte skip"),
    ),
    "NRRD of 3.9 GiB": ("volume.nrrd", 1, nrrd_packed, "compressed to"),
    "NRRD of 100 000 fields": (
        *("volume.nrrd", 0, lambda _: nrrd(**{f"a{k}": "x" for k in range(100000)}), "header"),
    ),
    "NIfTI of 3.9 GiB": ("volume.nifti", 1, nifti_packed, "compressed to"),
    "MetaImage of 3.9 GiB": ("volume.metaimage", 1, metaimage_packed, "compressed to"),
    "MetaImage of 1e200 voxels": (
        *("volume.metaimage", 0, metaimage("DimSize", "1e200 1e200 20 2"), "DimSize"),
    ),
    "MetaImage of a size of 400 digits": (
        *("volume.metaimage", 0, metaimage("DimSize", f"20 {LONG} 20 2"), "DimSize"),
    ),
    "deflated DICOM": ("volume.philips", 0, dicom_deflated, "TransferSyntaxUID"),
    "DICOM with a value of 4 GiB": ("volume.philips", 0, dicom_long, "PixelData"),
    "markups with 400 digits": ("markups", 0, replaced("-2.5e1", LONG), "position"),
    "markups with 5000 digits": ("markups", 0, replaced("-2.5e1", "1" * 5000), "content"),
    "nested markups": ("markups", 0, lambda _: b"[" * 10**6, "content"),
}


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Bench]]:
    folder = tmp_path_factory.mktemp("reproducers")
    with Child() as child:
        yield {
            name: Bench(READERS[name], folder, child)
            for name in {case[0] for case in CASES.values()}
        }


@pytest.mark.parametrize("name", CASES)
def test_what_was_not_refused_is(name: str, benches: dict[str, Bench]) -> None:
    reader, number, change, words = CASES[name]
    bench = benches[reader]
    found = bench.tried(change(bench.contents[number]), number)
    assert found.kind == "refused", found
    assert words in found.words
