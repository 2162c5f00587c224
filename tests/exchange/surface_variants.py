"""Surface files in all variants that VTK, trimesh, meshio and programs like MeshLab write.

All hold the same three triangles with the labels 1, 2 and 2, so that the reader can be compared
with what was written. Nothing of the readers takes part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import cycle, product
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

from tests.exchange.variant import Variant

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

Write = Callable[[Path], object]


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


def ply(path: Path, form: str, real: str, count: str, more: str = "") -> None:
    """As the format's description has it: VTK and trimesh write a few of these variants only."""
    order = ">" if form == "binary big endian" else "<"
    kinds = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}
    faces = QUADS if more == "quads" else TRIANGLES.tolist()
    text = ["ply", f"format {form.replace(' ', '_')} 1.0", "comment made up", "element vertex 5"]
    text += [f"property {real} {axis}" for axis in "xyz"]
    text += ["property uchar region"] if more == "labels of points" else []
    text += [f"property uchar {name}" for name in ("red", "green", "blue") if more == "colours"]
    name = "vertex_index" if more == "vertex_index" else "vertex_indices"
    text += [f"element face {len(faces)}", f"property list {count} int {name}"]
    text += ["property list uchar float texcoord"] if more == "texcoord" else []
    text += ["property int region"] if more == "labels of faces" else []
    rows: list[list[tuple[str, object]]] = []
    for k, point in enumerate(POINTS):
        rows.append([(real, x) for x in point])
        rows[-1] += [("uchar", POINT_LABELS[k])] if more == "labels of points" else []
        rows[-1] += [("uchar", 40 * k)] * 3 if more == "colours" else []
    for k, face in enumerate(faces):
        rows.append([(count, len(face)), *(("int", corner) for corner in face)])
        rows[-1] += [("uchar", 6), *[("float", 0.5)] * 6] if more == "texcoord" else []
        rows[-1] += [("int", LABELS[k])] if more == "labels of faces" else []
    head = "\n".join([*text, "end_header\n"]).encode()
    if form == "ascii":
        body = "".join(" ".join(f"{x:g}" for _, x in row) + "\n" for row in rows).encode()
    else:
        body = b"".join(np.array(x, order + kinds[of]).tobytes() for row in rows for of, x in row)
    path.write_bytes(head + body)


def ply_of_library(path: Path, what: str) -> None:
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
GROUPED = ["g anterior", f"f {FACES[0]}", "g posterior", f"f {FACES[1]}", f"f {FACES[2]}"]
OBJ: dict[str, list[str]] = {
    "groups": [*VERTICES, *GROUPED],
    "objects": [*VERTICES, *(line.replace("g ", "o ") for line in GROUPED)],
    "groups of an object": ["o valve", *VERTICES, *GROUPED],
    "negative indices": [*VERTICES, *(
        "f " + " ".join(str(corner - 5) for corner in row) for row in TRIANGLES)],
    "quads": [*VERTICES, "f 1 2 4 3", "f 2 5 4"],
    "texture and normals": [*VERTICES, "vt 0 0", "vn 0 0 1", *(
        "f " + " ".join(f"{corner}/1/1" for corner in row.split()) for row in FACES)],
    "colours of points": [*(f"{line} 0.5 0.5 0.5" for line in VERTICES), *GROUPED],
    "materials and smoothing": ["mtllib a.mtl", *VERTICES, "usemtl red", "s 1", *GROUPED, "s off"],
    "Latin-1 comment": ["# Segelfläche", *VERTICES, *GROUPED],
}  # fmt: skip


def obj_of_library(path: Path, what: str) -> None:
    if what.startswith("VTK"):
        saved(vtkOBJWriter(), vtk_data(), path)
        if what == "VTK with tabs":
            path.write_text(path.read_text().replace(" ", "\t"))
    else:
        meshio.obj.write(path, meshio.Mesh(POINTS, [("triangle", TRIANGLES)]))


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
    modes = ("text", "base64", "appended", "appended base64")
    types = cycle(product(("UInt64", "UInt32"), ("LittleEndian", "BigEndian"), ("Int64", "Int32")))
    for kind, *way in product(("vtp", "vtu"), modes, COMPRESSION):
        options = (*way, *next(types))
        yield Variant(kind.upper(), options, f"a.{kind}", lambda p, o=options: xml(p, *o))
    for what in ("single precision", "int8 labels", "labels of points", "boundary lines",
                 "triangle strips", "quads"):  # fmt: skip
        yield Variant("VTP", (what,), "a.vtp", lambda p, w=what: more_xml(p, w))
    kinds = ("int8", "uint8", "int16", "int32", "int64", "vtkIdType", "float32", "float64")
    for options in product(("4.2", "5.1"), ("text", "binary"), kinds, ("scalars", "a field")):
        yield Variant("VTK", options, "a.vtk", lambda p, o=options: legacy(p, *o))
    others = ("header of 3D Slicer", "boundary lines", "triangle strips", "quads",
              "unstructured grid")  # fmt: skip
    for options in product(others, ("4.2", "5.1"), ("text", "binary")):
        yield Variant("VTK", options, "a.vtk", lambda p, o=options: more_legacy(p, *o))
    for what in STL:
        yield Variant("STL", (what,), "a.stl", lambda p, w=what: stl(p, w), labels=False)
    forms = ("ascii", "binary little endian", "binary big endian")
    for options in product(forms, ("float", "double"), ("uchar", "int")):
        yield Variant("PLY", options, "a.ply", lambda p, o=options: ply(p, *o), labels=False)
    for what, form in product(
        ("labels of points", "labels of faces", "quads", "texcoord", "colours", "vertex_index"),
        forms,
    ):
        yield Variant(
            "PLY", (what, form), "a.ply", lambda p, w=what, f=form: ply(p, f, "float", "uchar", w),
            labels="labels" in what,
        )  # fmt: skip
    for what in PLY:
        yield Variant("PLY", (what,), "a.ply", lambda p, w=what: ply_of_library(p, w), labels=False)
    for what, lines in OBJ.items():
        text = "\n".join(lines)
        yield Variant(
            "OBJ",
            (what,),
            "a.obj",
            lambda p, t=text: p.write_bytes(t.encode("latin-1")),
            labels="anterior" in text,
        )
    for what in ("VTK", "VTK with tabs", "meshio"):
        yield Variant("OBJ", (what,), "a.obj", lambda p, w=what: obj_of_library(p, w), labels=False)
    for what in ("one mesh", "objects", "objects that nodes place"):
        yield Variant("GLB", (what,), "a.glb", lambda p, w=what: glb(p, w), labels="ob" in what)
