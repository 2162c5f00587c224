"""Damaged and hostile surface files: one line that names the file, and the next file is read."""

import base64
import struct
import zlib

import pytest

from mvest.errors import GeometryError, InputError
from mvest.exchange.surfaces import read_surface
from tests.exchange.surfaces.glb import Glb
from tests.exchange.surfaces.test_formats import (
    BINARY,
    POINTS,
    STL,
    TRIANGLES,
    ply,
)

LEGACY = "# vtk DataFile Version {}\nx\nASCII\nDATASET POLYDATA\nPOINTS {} float\n{}"
THREE = LEGACY.format("4.2", 3, "0 0 0 1 0 0 0 1 0\n")
FIVE = LEGACY.format("5.1", 3, "0 0 0 1 0 0 0 1 0\n")
XML = """<?xml version="1.0"?>{doctype}
<VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt64" {compressor}>
<PolyData><Piece NumberOfPoints="{points}" NumberOfPolys="{polygons}"><Points>
<DataArray type="Float32" NumberOfComponents="3" format="{form}">{places}</DataArray></Points>
<Polys><DataArray type="Int64" Name="connectivity" format="ascii">{corners}</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">{offsets}</DataArray></Polys>
</Piece></PolyData></VTKFile>"""
GOOD = {
    "doctype": "", "compressor": "", "points": 3, "polygons": 1, "form": "ascii",
    "places": "0 0 0 1 0 0 0 1 0", "corners": "0 1 2", "offsets": "3",
}  # fmt: skip


def xml(**change):
    return XML.format(**{**GOOD, **change})


def bomb(size):
    """A stream of zlib that holds some MB of zeros and is said to hold ``size`` bytes."""
    packed = zlib.compress(bytes(2**26), 9)
    parts = (struct.pack("<4Q", 1, size, size, len(packed)), packed)
    return {
        "compressor": 'compressor="vtkZLibDataCompressor"',
        "form": "binary",
        "places": "".join(base64.b64encode(part).decode() for part in parts),
    }


OUTSIDE = '<!DOCTYPE l [<!ENTITY x SYSTEM "next.vtp">]>'
VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
ASCII_PLY = ply("ascii", TRIANGLES.tolist()).decode()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.vtk", "", "damaged"),
        ("a.vtk", LEGACY.format("4.2", 2**31, "0 0 0\n"), "damaged"),
        ("a.vtk", LEGACY.format("4.2", -3, "0 0 0\n"), "damaged"),
        ("a.vtk", LEGACY.format("4.2", 3, "0 0 0 1 0 0 0 1\n"), "damaged: Error reading ascii"),
        ("a.vtk", LEGACY.format("4.2", 3, "0 0 0 1 x 0 0 1 0\n"), "damaged: Error reading ascii"),
        ("a.vtk", LEGACY.format("4.2", 3, "0 0 0 1 nan 0 0 1 0\nPOLYGONS 1 4\n3 0 1 2\n"),
         r"points \[1\] are not finite"),
        ("a.vtk", THREE + f"POLYGONS {2**31} {2**33}\n3 0 1 2\n", "damaged"),
        ("a.vtk", THREE + "POLYGONS 1 4\n3 0 1 3\n", "points that do not exist"),
        ("a.vtk", THREE + "POLYGONS 1 4\n3 0 1 -1\n", "points that do not exist"),
        ("a.vtk", THREE + "POLYGONS 1 4\n300 0 1 2\n", "points that do not exist"),
        ("a.vtk", FIVE + "POLYGONS 3 3\nOFFSETS vtktypeint64\n0 900 3\nCONNECTIVITY vtktypeint64\n"
         "0 1 2\n", "points that do not exist"),
        ("a.vtk", THREE + "POLYGONS 1 4\n3 0 1 2\nCELL_DATA 1\nFIELD f 1\nregion 1 3 int\n1 2 3\n",
         "'region' has 3 rows, expected 1 cells"),
        ("a.vtk", THREE + "LINES 1 3\n2 0 1\n", "no triangles"),
        ("a.vtk", THREE.replace("POLYDATA", "UNSTRUCTURED_GRID"), "no triangles"),
        ("a.vtk", "# vtk DataFile Version 4.2\nx\nASCII\nDATASET STRUCTURED_POINTS\n"
         "DIMENSIONS 9000 9000 9000\nORIGIN 0 0 0\nSPACING 1 1 1\nPOINT_DATA 729000000000\n"
         "SCALARS a double 1\nLOOKUP_TABLE default\n1\n", "a.vtk: "),
        ("a.vtk", "# vtk DataFile Version 4.2\nx\nASCII\nDATASET STRUCTURED_POINTS\n"
         "DIMENSIONS 1 1 1\nORIGIN 0 0 0\nSPACING 1 1 1\n", "expected PolyData"),
        ("a.vtp", "nonsense", "damaged: Error parsing XML"),
        ("a.vtu", "nonsense", "damaged: Error parsing XML"),
        ("a.vtp", "<VTKFile type='ImageData'/>", "damaged: Cannot find PolyData"),
        ("a.vtp", xml(polygons=2**31), "damaged"),
        ("a.vtp", xml(points=2**31), "damaged"),
        ("a.vtp", xml(points=2**62), "damaged"),
        ("a.vtp", xml(corners="0 1 3"), "points that do not exist"),
        ("a.vtp", xml(offsets="900"), "damaged"),
        ("a.vtp", xml(places="0 0 0 1 x 0"), "damaged"),
        ("a.vtp", xml(**bomb(36)), "damaged"),
        ("a.vtp", xml(doctype=OUTSIDE, places="&x;"), "damaged"),
        ("a.stl", "", "0 bytes, expected 84"),
        ("a.stl", bytes(80) + b"\xff\xff\xff\xff" + BINARY, "expected 214748364834 for"),
        ("a.stl", bytes(84), "no points"),
        ("a.stl", STL[:-12], "9 corners, expected three of each facet and endsolid"),
        ("a.stl", STL.replace("e+00 ", " ", 1).replace("vertex", "vertex x", 1), "damaged"),
        ("a.ply", "nonsense", "damaged or no PLY"),
        ("a.ply", ASCII_PLY.replace("ascii", "EBCDIC"), "format EBCDIC, expected ascii, binary_"),
        ("a.ply", ASCII_PLY.replace("end_header", ""), "damaged or no PLY file"),
        ("a.ply", ASCII_PLY.replace("vertex 6", f"vertex {2**31}"), "rows too early"),
        ("a.ply", ASCII_PLY.replace("vertex 6", "vertex -6"), "damaged"),
        ("a.ply", ASCII_PLY.replace("float x", "float w"), "no element vertex with x, y and z"),
        ("a.ply", ASCII_PLY + "5\n", "1 numbers more than its header says"),
        ("a.obj", VERTICES, "no triangles"),
        ("a.obj", VERTICES + "f 1 2 9\n", "points that do not exist"),
        ("a.obj", VERTICES + "f 1 2 0\n", "points that do not exist"),
        ("a.obj", VERTICES + "f 1 2 -4\n", "points that do not exist"),
        ("a.obj", VERTICES + f"f 1 2 {10**30}\n", "damaged"),
        ("a.obj", VERTICES.replace("1 0 0", "1e12 0 0") + "f 1 2 3\n", r"points \[1\] .* 1e\+09"),
        ("a.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "damaged"),
        ("a.off", "", r"extension '\.off', expected .*\.stl, \.obj, \.ply, \.vtk, \.glb"),
    ],
)  # fmt: skip
def test_one_line_that_names_the_file(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises((InputError, GeometryError), match=message) as raised:
        read_surface(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)
    # Whatever became of the child, another file is read.
    (tmp_path / "next.vtp").write_text(xml())
    assert len(read_surface(tmp_path / "next.vtp").triangles) == 1


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"a\.stl: no such file"):
        read_surface(tmp_path / "a.stl")


def spoilt(change):
    file = Glb()
    file.node("valve", mesh=file.mesh(POINTS, TRIANGLES))
    change(file.document)
    return file


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "needs KHR_draco"),
        (lambda d: d["buffers"][0].update(uri="a.bin"), "damaged"),
        (lambda d: d["accessors"][0].update(count=7), "damaged"),
        (lambda d: d["accessors"][0].update(count=2**40), "damaged"),
        (lambda d: d["accessors"][0].pop("bufferView"), "needs sparse or compressed arrays"),
        (lambda d: d["accessors"][0].update(sparse={}), "needs sparse or compressed arrays"),
        (lambda d: d["bufferViews"][0].update(byteLength=10**6), "damaged"),
        (lambda d: d["scenes"][0].update(nodes=[-1]), "damaged"),
        (lambda d: d["nodes"][0].update(translation=[1e300, 0, 0]), "not finite numbers of at"),
        (lambda d: d["scenes"][0].update(nodes=[]), "no points"),
    ],
)
def test_scenes_that_are_damaged_or_packed_otherwise(change, message, tmp_path):
    path = spoilt(change).write(tmp_path / "a.glb")
    with pytest.raises((InputError, GeometryError), match=message):
        read_surface(path)


def test_a_scene_of_another_version(tmp_path):
    with pytest.raises(InputError, match="only GLTF 2"):
        read_surface(spoilt(lambda _: None).write(tmp_path / "a.glb", version=1))
