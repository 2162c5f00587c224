"""Surface files as VTK, trimesh and meshio write them: the same three labelled triangles."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import meshio
import numpy as np
import trimesh
from vtkmodules.util import numpy_support
from vtkmodules.vtkCommonCore import vtkIdTypeArray, vtkPoints
from vtkmodules.vtkCommonDataModel import (
    vtkCellArray,
    vtkPointSet,
    vtkPolyData,
    vtkUnstructuredGrid,
)
from vtkmodules.vtkIOGeometry import vtkOBJWriter, vtkSTLWriter
from vtkmodules.vtkIOLegacy import vtkPolyDataWriter, vtkUnstructuredGridWriter
from vtkmodules.vtkIOPLY import vtkPLYWriter
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

from tests.exchange.variant import Variant, each_option

POINTS = np.array([[0.0, 0, 0], [20, 0, 0], [0, 20, 0.5], [20, 20, 0.25], [40, 0, 1]])
TRIANGLES = np.array([[0, 1, 2], [2, 1, 3], [1, 4, 3]])
QUADS = [[0, 1, 3, 2], [1, 4, 3]]
"""The first two triangles as one cell, and the third."""
LABELS = np.array([1, 2, 2])
POINT_LABELS = np.array([1, 2, 1, 2, 2])
"""Two corners of each triangle have its label."""
WALL = np.array([1.0, 1.25, 1.5, 1.75, 2.0])
LINE = [0, 2, 3, 4]


def vtk_array(values: object, name: str, kind: str = "float64") -> object:
    """An array of VTK, where ``vtkIdType`` is a type of its own."""
    array = np.ascontiguousarray(values, dtype="int64" if kind == "vtkIdType" else kind)
    own = vtkIdTypeArray().GetDataType() if kind == "vtkIdType" else None
    made = numpy_support.numpy_to_vtk(array, deep=1, array_type=own)
    made.SetName(name)
    return made


def vtk_cells(rows: object) -> vtkCellArray:
    cells = vtkCellArray()
    for row in rows:
        cells.InsertNextCell(len(row), list(map(int, row)))
    return cells


def vtk_data(kind: str = "vtp", what: str = "", of: str = "int64", field: bool = True):
    """The surface in VTK, its labels as a field or as the scalars of its cells."""
    result: vtkPointSet = vtkPolyData() if kind == "vtp" else vtkUnstructuredGrid()
    cells = QUADS if what == "quads" else TRIANGLES
    labels = {"quads": [1, 2], "boundary lines": [9, *LABELS]}.get(what, LABELS)
    places = vtkPoints()
    places.SetData(vtk_array(POINTS, "Points", "float32" if what else "float64"))
    result.SetPoints(places)
    if kind == "vtp":
        result.SetPolys(vtk_cells(cells))
    else:
        result.SetCells([5] * len(cells), vtk_cells(cells))
    if what == "boundary lines":
        result.SetLines(vtk_cells([LINE]))
    result.GetPointData().AddArray(vtk_array(WALL, "thickness"))
    data, region = result.GetCellData(), vtk_array(labels, "region", of)
    if what == "labels of points":
        result.GetPointData().AddArray(vtk_array(POINT_LABELS, "region", "uint8"))
    else:
        data.AddArray(region) if field else data.SetScalars(region)
    return result


def saved(writer: object, data: vtkPointSet, path: Path) -> None:
    writer.SetInputData(data)
    writer.SetFileName(str(path))
    assert writer.Write()


COMPRESSION = {"plain": "None", "zlib": "ZLib", "LZ4": "LZ4", "LZMA": "LZMA"}


def xml(path: Path, mode: str, packed: str, header: str, order: str, ids: str) -> None:
    kind = path.suffix[1:]
    writer = vtkXMLPolyDataWriter() if kind == "vtp" else vtkXMLUnstructuredGridWriter()
    {"text": writer.SetDataModeToAscii, "base64": writer.SetDataModeToBinary}.get(
        mode, writer.SetDataModeToAppended
    )()
    writer.SetEncodeAppendedData(mode == "appended base64")
    getattr(writer, f"SetCompressorTypeTo{COMPRESSION[packed]}")()
    getattr(writer, f"SetHeaderTypeTo{header}")()
    getattr(writer, f"SetByteOrderTo{order}")()
    getattr(writer, f"SetIdTypeTo{ids}")()
    saved(writer, vtk_data(kind), path)


def legacy(path: Path, version: str, form: str, of: str, field: str, what: str = "") -> None:
    grid = what == "unstructured grid"
    writer = vtkUnstructuredGridWriter() if grid else vtkPolyDataWriter()
    writer.SetFileVersion(int(version.replace(".", "")))
    writer.SetFileType(2 if form == "binary" else 1)
    if what == "header of 3D Slicer":
        writer.SetHeader("3D Slicer output. SPACE=LPS")
    saved(writer, vtk_data("vtu" if grid else "vtp", what, of, field == "a field"), path)


def stl(path: Path, what: str) -> None:
    """As VTK writes it, or as other programs do."""
    writer = vtkSTLWriter()
    writer.SetFileType(2 if "binary" in what else 1)
    saved(writer, vtk_data(), path)
    content = path.read_bytes()
    if what == "capitals":
        path.write_bytes(content.upper())
    elif what == "Latin-1 name, CRLF":
        text = "solid Segelfläche\n" + content.decode().partition("\n")[2]
        path.write_bytes(text.replace("\n", "\r\n").encode("latin-1"))
    elif what == "binary named solid":
        path.write_bytes(b"solid valve".ljust(80) + content[80:])


def ply(path: Path, what: str) -> None:
    if what.startswith("meshio"):
        cells = meshio.Mesh(POINTS, [("triangle", TRIANGLES.astype(np.int32))])
        meshio.ply.write(path, cells, binary=what == "meshio binary")
    else:
        writer = vtkPLYWriter()
        writer.SetFileType(1 if what == "VTK text" else 2)
        writer.SetDataByteOrder(int(what != "VTK big endian"))
        saved(writer, vtk_data(), path)


VERTICES = [f"v {x} {y} {z}" for x, y, z in POINTS]
FACES = [" ".join(str(corner + 1) for corner in row) for row in TRIANGLES]
OBJ: dict[str, list[str]] = {
    "groups": [*VERTICES, "g anterior", f"f {FACES[0]}", "g posterior", f"f {FACES[1]}",
               f"f {FACES[2]}"],
    "negative indices": [*VERTICES, *(
        "f " + " ".join(str(corner - 5) for corner in row) for row in TRIANGLES)],
    "quads": [*VERTICES, "f 1 2 4 3", "f 2 5 4"],
    "texture and normals": [*VERTICES, "vt 0 0", "vt 1 0", "vn 0 0 1", *(
        f"f {a}/1/1 {b}/2/1 {c}/1/1" for a, b, c in (row.split() for row in FACES))],
    "colours of points": ["# Segelfläche", *(f"{v} 0.5 0.5 0.5" for v in VERTICES), "usemtl red",
                          *(f"f {row}" for row in FACES)],
}  # fmt: skip


def obj(path: Path, what: str) -> None:
    if what in OBJ:
        path.write_bytes("\n".join(OBJ[what]).encode("latin-1"))
    else:
        saved(vtkOBJWriter(), vtk_data(), path)


def glb(path: Path, what: str) -> None:
    """A scene of two objects, or one mesh."""
    scene = trimesh.Scene()
    parts = {"anterior": TRIANGLES[:1], "posterior": TRIANGLES[1:]}
    move = np.eye(4)
    move[:3, 3] = [1, 2, 3]
    for name, triangles in parts.items() if "objects" in what else {"all": TRIANGLES}.items():
        mesh = trimesh.Trimesh(POINTS - move[:3, 3], triangles, process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=move)
    scene.export(path)


def surface_variants() -> Iterator[Variant]:
    """All of them; those without labels hold ``labels=False``."""
    types = ("UInt64", "UInt32"), ("LittleEndian", "BigEndian", "BigEndian"), ("Int64", "Int32")
    modes = ("text", "base64", "appended", "appended base64")
    for kind, packed in (("vtp", [*COMPRESSION]), ("vtu", [*COMPRESSION][::-1])):
        for row in each_option(modes, tuple(packed), *types):
            yield Variant(kind.upper(), row, f"a.{kind}", lambda p, o=row: xml(p, *o))
    forms = ("4.2", "5.1"), ("text", "text", "binary", "binary")
    kinds = ("int32", "uint8", "int8", "vtkIdType", "int16", "float64", "float32", "int64")
    for row in each_option(*forms, kinds, ("scalars", "a field", "a field")):
        yield Variant("VTK", row, "a.vtk", lambda p, o=row: legacy(p, *o))
    others = ("header of 3D Slicer", "boundary lines", "quads", "unstructured grid")
    for row in each_option((*others, "labels of points"), *forms):
        write = partial(legacy, version=row[1], form=row[2], of="int32", field="", what=row[0])
        yield Variant("VTK", row, "a.vtk", write)
    names = {
        stl: ("VTK binary", "VTK text", "capitals", "Latin-1 name, CRLF", "binary named solid"),
        ply: ("VTK text", "VTK little endian", "VTK big endian", "meshio text", "meshio binary"),
        obj: ("VTK", *OBJ),
        glb: ("one mesh", "objects that nodes place"),
    }
    for make, several in names.items():
        form = make.__name__
        for what in several:
            way = partial(make, what=what)
            yield Variant(
                form.upper(), (what,), f"a.{form}", way, labels=what.startswith("objects")
            )
