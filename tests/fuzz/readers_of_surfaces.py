"""Readers of surfaces."""

import base64
from pathlib import Path

import numpy as np
import yaml

from mvest.cases.folder import read_case
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.exchange.importing.slicerheart_folder import read_batch
from mvest.exchange.regions import read_regions
from mvest.exchange.surfaces import (
    read_surface,
    write_surface,
)
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.thickening import thicken
from tests.cases.folders import plain_folder
from tests.exchange.surfaces.glb import Glb
from tests.fuzz.trial import Reader

__all__ = ["READERS"]

POINTS = np.array([[0.0, 0, 0], [20, 0, 0], [0, 20, 0.5], [20, 20, 0.25], [40, 0, 1]])
TRIANGLES = np.array([[0, 1, 2], [2, 1, 3], [1, 4, 3]])
REGIONS = {1: "anterior", 2: "posterior"}


def regions(path: Path) -> object:
    return read_regions(path, REGIONS)


def text_stl(folder: Path) -> Path:
    facets = "".join(
        "facet normal 0 0 1\n outer loop\n"
        + "".join(f"  vertex {x!r} {y!r} {z!r}\n" for x, y, z in corners.tolist())
        + " endloop\nendfacet\n"
        for corners in POINTS[TRIANGLES]
    )
    (folder / "a.stl").write_text(f"solid a\n{facets}endsolid a\n")
    return folder / "a.stl"


def binary_stl(folder: Path) -> Path:
    records = np.zeros(len(TRIANGLES), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    records["v"] = POINTS[TRIANGLES]
    count = len(TRIANGLES).to_bytes(4, "little")
    (folder / "a.stl").write_bytes(bytes(80) + count + records.tobytes())
    return folder / "a.stl"


def obj(folder: Path) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in POINTS]
    faces = [f"f {a + 1}/1/1 {b + 1}//2 {c + 1}" for a, b, c in TRIANGLES]
    groups = ["g anterior", faces[0], "g posterior", *faces[1:]]
    (folder / "a.obj").write_text("\n".join(["# made up", "o valve", *lines, *groups]) + "\n")
    return folder / "a.obj"


def glb(folder: Path) -> Path:
    file = Glb()
    below = file.node(
        "anterior", top=False, mesh=file.mesh(POINTS, TRIANGLES[:1], "<u2"), scale=[1, 1, 2]
    )
    file.node("valve", children=[below], rotation=[0, 0, 0.6, 0.8], translation=[1, 2, 3])
    file.node("posterior", mesh=file.mesh(POINTS, TRIANGLES[1:], "<u1", 16))
    return file.write(folder / "a.glb")


PLY = """ply
format {form} 1.0
comment made up
element vertex 5
property float x
property float y
property double z
property int region
element face 3
property list uchar int vertex_indices
end_header
"""


def text_ply(folder: Path) -> Path:
    points = "".join(f"{x} {y} {z} {1 + (k > 2)}\n" for k, (x, y, z) in enumerate(POINTS))
    faces = "".join(f"3 {a} {b} {c}\n" for a, b, c in TRIANGLES)
    (folder / "a.ply").write_text(PLY.format(form="ascii") + points + faces)
    return folder / "a.ply"


def binary_ply(folder: Path) -> Path:
    points = np.zeros(5, [("x", "<f4"), ("y", "<f4"), ("z", "<f8"), ("region", "<i4")])
    for name, values in zip("xyz", POINTS.T, strict=True):
        points[name] = values
    points["region"] = [1, 1, 1, 2, 2]
    faces = np.zeros(3, [("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, TRIANGLES
    head = PLY.format(form="binary_little_endian").encode()
    (folder / "a.ply").write_bytes(head + points.tobytes() + faces.tobytes())
    return folder / "a.ply"


ARRAYS = {
    "points": ("Float64", POINTS),
    "connectivity": ("Int64", TRIANGLES),
    "offsets": ("Int64", np.array([3, 6, 9])),
    "types": ("UInt8", np.full(3, 5, dtype=np.uint8)),
    "region": ("Int64", np.array([1, 2, 2])),
}


def vtk_text(kind: str, form: str) -> bytes:
    """A VTK XML file with its numbers in it, as text or base64, or raw at its end."""
    appended = b""

    def array(name: str) -> str:
        nonlocal appended
        of, values = ARRAYS[name]
        raw = len(values.tobytes()).to_bytes(8, "little") + values.tobytes()
        parts = 3 if name == "points" else 1
        head = f'<DataArray type="{of}" Name="{name}" NumberOfComponents="{parts}"'
        if form == "appended":
            head += f' format="appended" offset="{len(appended)}"/>\n'
            appended += raw
            return head
        text = " ".join(map(str, values.ravel()))
        if form == "binary":
            text = base64.b64encode(raw).decode()
        return f'{head} format="{form}">{text}</DataArray>\n'

    cells, shape = ("Cells", "UnstructuredGrid") if kind == "vtu" else ("Polys", "PolyData")
    names = ["connectivity", "offsets", *(["types"] if kind == "vtu" else [])]
    text = (
        f'<?xml version="1.0"?>\n<VTKFile type="{shape}" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n<{shape}>\n<Piece NumberOfPoints="5" NumberOf{cells}="3">\n'
        f"<Points>{array('points')}</Points>\n"
        f"<{cells}>{''.join(map(array, names))}</{cells}>\n"
        f"<CellData>{array('region')}</CellData>\n</Piece>\n</{shape}>\n"
    ).encode()
    if form == "appended":
        text += b'<AppendedData encoding="raw">\n_' + appended + b"</AppendedData>\n"
    return text + b"</VTKFile>\n"


def vtk(path: Path, form: str) -> Path:
    path.write_bytes(vtk_text(path.suffix[1:], form))
    return path


def legacy_vtk(folder: Path, version: str, *, binary: bool) -> Path:
    """A legacy VTK file with polygons, a strip, normals and a field."""

    def put(values: list[list[float]], kind: str) -> bytes:
        if binary:
            return np.concatenate(values).astype(kind).tobytes() + b"\n"
        return "".join(" ".join(f"{x:g}" for x in row) + "\n" for row in values).encode()

    old = version < "5"
    corners = [[3.0, *map(float, row)] for row in TRIANGLES[:2]]
    if old:
        polygons = b"POLYGONS 2 8\n" + put(corners, ">i4")
        strips = b"TRIANGLE_STRIPS 1 5\n" + put([[4.0, 0, 1, 2, 3]], ">i4")
    else:
        flat = [[0.0, 1, 2, 2, 1, 3]]
        polygons = b"POLYGONS 3 6\nOFFSETS vtktypeint64\n" + put([[0.0, 3, 6]], ">i8")
        polygons += b"CONNECTIVITY vtktypeint64\n" + put(flat, ">i8")
        strips = b"TRIANGLE_STRIPS 2 4\nOFFSETS vtktypeint64\n" + put([[0.0, 4]], ">i8")
        strips += b"CONNECTIVITY vtktypeint64\n" + put([[0.0, 1, 2, 3]], ">i8")
    head = f"# vtk DataFile Version {version}\n3D Slicer output. SPACE=LPS\n"
    head += f"{'BINARY' if binary else 'ASCII'}\nDATASET POLYDATA\nPOINTS 5 float\n"
    parts = (
        head.encode(),
        put(POINTS.tolist(), ">f4"),
        polygons,
        strips,
        b"CELL_DATA 3\nSCALARS region int 1\nLOOKUP_TABLE default\n",
        put([[1.0, 2, 2]], ">i4"),
        b"POINT_DATA 5\nNORMALS Normals double\n",
        put(POINTS.tolist(), ">f8"),
        b"METADATA\nINFORMATION 0\n\nFIELD FieldData 1\nwall%20thickness 1 5 float\n",
        put([[1.0, 2, 3, 4, 5]], ">f4"),
    )
    (folder / "a.vtk").write_bytes(b"".join(parts))
    return folder / "a.vtk"


def slicerheart(folder: Path, damaged: str) -> Path:
    """A folder of SlicerHeart with one phase, of which a file is damaged."""
    for leaflet in ("anterior", "posterior"):
        file = legacy_vtk(folder, "4.2", binary=False)
        file.rename(folder / f"A_mitral_frame_1_MD_atrial_{leaflet}_leaflet.vtk")
    points = [f"A,MD,1,mitral,{k}.25,-2.50,3.75,{'ALC' if k == 2 else ''}" for k in range(9)]
    head = "AnnulusContourX,AnnulusContourY,AnnulusContourZ,AnnulusContourLabel"
    (folder / "AnnulusContourPoints.csv").write_text(
        f"Filename,Phase,FrameNumber,Valve,{head}\n" + "\n".join(points) + "\n"
    )
    (folder / "ValveLandmarkPoints.csv").write_text(
        "Filename,Phase,Valve,FrameNumber,LandmarkLabel,LandmarkR,LandmarkA,LandmarkS\n"
        "A,MD,mitral,1,A,1.00,2.00,3.00\nA,MD,mitral,1,PMC,-1.50,2.00,3.00\n"
    )
    return folder / damaged


def case(folder: Path) -> Path:
    """A case folder of which the reference surface is damaged."""
    document = plain_folder(folder)
    (folder / "case.yaml").write_text(yaml.safe_dump(document))
    return folder / "open.vtp"


def thick(folder: Path) -> Path:
    surface = thicken(Template(TemplateParameters()).valve(24, 6).surface)
    write_surface(folder / "a.stl", surface.vertices, surface.triangles)
    return folder / "a.stl"


def thick_leaflets(path: Path) -> object:
    tips = (-16.0, -0.24, -25.0, 16.0, -0.24, -25.0)
    return import_leaflets(path, LeafletsOptions(units="mm", tips=tips, edge_mm=4.0))


READERS = (
    Reader("import.solid", thick_leaflets, (thick,)),
    Reader("case.surface", lambda path: read_case(path.parent), (case,)),
    Reader("surface.stl", read_surface, (text_stl, binary_stl)),
    Reader("surface.stl-merged", lambda path: read_regions(path, {1: "both"}), (text_stl,)),
    Reader("surface.obj", regions, (obj,)),
    Reader("surface.glb", regions, (glb,)),
    Reader("surface.ply", regions, (text_ply, binary_ply)),
    *(
        Reader(
            f"surface.{kind}",
            regions,
            tuple(
                lambda folder, name=f"a.{kind}", form=form: vtk(folder / name, form)
                for form in ("ascii", "binary", "appended")
            ),
        )
        for kind in ("vtp", "vtu")
    ),
    Reader(
        "surface.vtk",
        regions,
        tuple(
            lambda folder, v=version, b=binary: legacy_vtk(folder, v, binary=b)
            for version in ("4.2", "5.1")
            for binary in (False, True)
        ),
    ),
    Reader(
        "slicerheart",
        lambda path: read_batch(path.parent, None),
        tuple(
            lambda folder, name=name: slicerheart(folder, name)
            for name in ("AnnulusContourPoints.csv", "ValveLandmarkPoints.csv")
        ),
    ),
)
