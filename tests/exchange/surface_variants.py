"""Surface files as VTK, trimesh and meshio write them: the same three labelled triangles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
"""The first two triangles as one cell, beside the third."""
LABELS = np.array([1, 2, 2])
POINT_LABELS = np.array([1, 2, 1, 2, 2])
"""Two of each triangle's corners have its label."""
WALL = np.array([1.0, 1.25, 1.5, 1.75, 2.0])
STRIP, LINE = [2, 1, 3, 4], [0, 2, 3, 4]
"""The second and the third triangle; the boundary in part."""


def vtk_array(values: object, name: str, kind: str = "float64") -> object:
    """An array of VTK; ``vtkIdType`` is a type of its own there."""
    array = np.ascontiguousarray(values, dtype="int64" if kind == "vtkIdType" else kind)
    if kind == "vtkIdType":
        made = numpy_support.numpy_to_vtk(array, deep=1, array_type=vtkIdTypeArray().GetDataType())
    else:
        made = numpy_support.numpy_to_vtk(array, deep=1)
    made.SetName(name)
    return made


def vtk_cells(rows: object) -> vtkCellArray:
    cells = vtkCellArray()
    for row in rows:
        cells.InsertNextCell(len(row), list(map(int, row)))
    return cells


def vtk_data(
    kind: str = "vtp",
    cells: object = TRIANGLES,
    labels: object = LABELS,
    of: str = "int64",
    points: str = "float64",
    field: bool = True,
) -> vtkPointSet:
    """The surface in VTK, its labels as a field or as the scalars of its cells."""
    result = vtkPolyData() if kind == "vtp" else vtkUnstructuredGrid()
    places = vtkPoints()
    places.SetData(vtk_array(POINTS, "Points", points))
    result.SetPoints(places)
    if kind == "vtp":
        result.SetPolys(vtk_cells(cells))
    else:
        result.SetCells([{3: 5, 4: 9}[len(row)] for row in cells], vtk_cells(cells))
    result.GetPointData().AddArray(vtk_array(WALL, "thickness"))
    region = vtk_array(labels, "region", of)
    data = result.GetCellData()
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


def more(what: str, points: str) -> vtkPolyData:
    """Other cells beside or in place of the triangles, other types."""
    data = vtk_data(points=points)
    if what == "int8 labels":
        data = vtk_data(of="int8")
    elif what == "labels of points":
        data.GetCellData().RemoveArray("region")
        data.GetPointData().AddArray(vtk_array(POINT_LABELS, "region", "uint8"))
    elif what == "quads":
        data = vtk_data(cells=QUADS, labels=[1, 2])
    elif what == "boundary lines":
        data = vtk_data(labels=[9, *LABELS], points=points)
        data.SetLines(vtk_cells([LINE]))
    elif what == "triangle strips":
        data = vtk_data(cells=TRIANGLES[:1], labels=[1, 2])
        data.SetStrips(vtk_cells([STRIP]))
    return data


def more_xml(path: Path, what: str) -> None:
    points = "float32" if what == "single precision" else "float64"
    saved(vtkXMLPolyDataWriter(), more(what, points), path)


def legacy(path: Path, version: str, form: str, of: str, field: str) -> None:
    writer = vtkPolyDataWriter()
    writer.SetFileVersion(int(version.replace(".", "")))
    writer.SetFileType(2 if form == "binary" else 1)
    saved(writer, vtk_data(of=of, field=field == "a field"), path)


def more_legacy(path: Path, what: str, version: str, form: str) -> None:
    """Cells of other kinds, and a grid in place of a surface."""
    grid = what == "unstructured grid"
    writer = vtkUnstructuredGridWriter() if grid else vtkPolyDataWriter()
    writer.SetFileVersion(int(version.replace(".", "")))
    writer.SetFileType(2 if form == "binary" else 1)
    if what == "header of 3D Slicer":
        writer.SetHeader("3D Slicer output. SPACE=LPS")
    data = vtk_data("vtu", points="float32") if grid else more(what, "float32")
    saved(writer, data, path)


def stl(path: Path, what: str) -> None:
    """As a library writes it, or its text as other programs differ from it."""
    mesh = trimesh.Trimesh(POINTS, TRIANGLES, process=False)
    cells = meshio.Mesh(POINTS, [("triangle", TRIANGLES)])
    writer = vtkSTLWriter()
    writer.SetFileType(1 if what in ("VTK text", *STL_TEXT) else 2)
    if what.startswith("trimesh"):
        mesh.export(path, file_type="stl_ascii" if what == "trimesh text" else "stl")
    elif what.startswith("meshio"):
        meshio.stl.write(path, cells, binary=what == "meshio binary")
    else:
        saved(writer, vtk_data(), path)
    if what in STL_TEXT:
        path.write_bytes(STL_TEXT[what](path.read_text()))
    elif what in STL_BYTES:
        path.write_bytes(STL_BYTES[what](path.read_bytes()))


STL_TEXT: dict[str, Callable[[str], bytes]] = {
    "two solids": lambda t: (t[: t.index("endfacet") + 8] + "\nendsolid\nsolid b\n" + t[
        t.index("endfacet") + 8 :]).encode(),
    "capitals": lambda t: t.upper().encode(),
    "CRLF": lambda t: t.replace("\n", "\r\n").encode(),
    "Latin-1 name": lambda t: ("solid Segelfläche\n" + t.partition("\n")[2]).encode("latin-1"),
}  # fmt: skip
STL_BYTES: dict[str, Callable[[bytes], bytes]] = {
    "binary named solid": lambda b: b"solid valve".ljust(80) + b[80:],
    "colour of all": lambda b: b"COLOR=\xff\x80\x40\xff,MATERIAL=".ljust(80, b"\0") + b[80:],
}
STL = (
    *("VTK binary", "VTK text", "trimesh binary", "trimesh text", "meshio binary"),
    *("meshio text", *STL_TEXT, *STL_BYTES),
)


def ply(path: Path, what: str) -> None:
    mesh = trimesh.Trimesh(POINTS, TRIANGLES, process=False)
    if what.startswith("trimesh"):
        coloured = what == "trimesh colours"
        mesh.visual.vertex_colors = np.arange(20).reshape(5, 4) if coloured else None
        mesh.export(path, encoding="ascii" if what == "trimesh text" else "binary")
    elif what.startswith("meshio"):
        cells = meshio.Mesh(POINTS, [("triangle", TRIANGLES.astype(np.int32))])
        meshio.ply.write(path, cells, binary=what == "meshio binary")
    else:
        writer = vtkPLYWriter()
        writer.SetFileType(1 if what == "VTK text" else 2)
        writer.SetDataByteOrder(int(what != "VTK big endian"))
        saved(writer, vtk_data(), path)


PLY = (
    *("VTK text", "VTK little endian", "VTK big endian", "trimesh text", "trimesh binary"),
    *("trimesh colours", "meshio text", "meshio binary"),
)
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


BY_OBJ = ("VTK", "VTK with tabs", "meshio")


def obj(path: Path, what: str) -> None:
    if what in OBJ:
        path.write_bytes("\n".join(OBJ[what]).encode("latin-1"))
    elif what == "meshio":
        meshio.obj.write(path, meshio.Mesh(POINTS, [("triangle", TRIANGLES)]))
    else:
        saved(vtkOBJWriter(), vtk_data(), path)
        if what == "VTK with tabs":
            path.write_text(path.read_text().replace(" ", "\t"))


def glb(path: Path, what: str) -> None:
    """A scene of two objects, or one mesh."""
    scene = trimesh.Scene()
    parts = {"anterior": TRIANGLES[:1], "posterior": TRIANGLES[1:]}
    for name, triangles in parts.items() if "objects" in what else {"all": TRIANGLES}.items():
        move = np.eye(4)
        if what == "objects that nodes place":
            move[:3, 3] = [1, 2, 3]
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
    for what in ("single precision", "int8 labels", "labels of points", "boundary lines",
                 "triangle strips", "quads"):  # fmt: skip
        yield Variant("VTP", (what,), "a.vtp", partial(more_xml, what=what))
    forms = ("4.2", "5.1"), ("text", "text", "binary", "binary")
    kinds = ("int32", "uint8", "int8", "vtkIdType", "int16", "float64", "float32", "int64")
    for row in each_option(*forms, kinds, ("scalars", "a field", "a field")):
        yield Variant("VTK", row, "a.vtk", lambda p, o=row: legacy(p, *o))
    others = ("header of 3D Slicer", "boundary lines", "triangle strips", "quads",
              "unstructured grid")  # fmt: skip
    for row in each_option(others, *forms):
        yield Variant("VTK", row, "a.vtk", lambda p, o=row: more_legacy(p, *o))
    for make, form, names in ((stl, "STL", STL), (ply, "PLY", PLY), (obj, "OBJ", (*OBJ, *BY_OBJ))):
        for what in names:
            file = f"a.{form.lower()}"
            yield Variant(form, (what,), file, partial(make, what=what), labels=False)
    for what in ("one mesh", "objects that nodes place"):
        yield Variant("GLB", (what,), "a.glb", partial(glb, what=what), labels="ob" in what)
