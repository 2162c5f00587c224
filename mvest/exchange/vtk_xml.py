"""VTK XML files of surfaces and meshes (``.vtp``, ``.vtu``), read without VTK.

VTK itself is too large to require, and meshio 5.3 knows no ``.vtp`` and inflates without bound. So
the part of the format that a surface or a mesh needs is here: every encoding is read (text, base64
inline, base64 or raw appended; zlib, LZMA or no compression), and PolyData are written as base64
with zlib. Format: *The VTK User's Guide*, 11th edition, section 19.3, "XML file formats".
"""

from __future__ import annotations

import base64
import re
import xml.etree.ElementTree as ET
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.errors import GeometryError, InputError
from mvest.reading.bounded import array_of_words, inflate, max_inflated, refusing
from mvest.reading.text import read_bytes
from mvest.typing import FloatArray, IntArray

MAX_SURFACE = 2**28
"""Bytes of a file with a surface or a mesh; a fine leaflet has some MB."""
CELLS = {
    5: ("triangle", 3),
    9: ("quad", 4),
    10: ("tetra", 4),
    12: ("hexahedron", 8),
    13: ("wedge", 6),
    22: ("triangle6", 6),
    24: ("tetra10", 10),
    28: ("quad9", 9),
    29: ("hexahedron27", 27),
    32: ("wedge18", 18),
}
"""Name, as meshio has it, and number of nodes by VTK's number of a type."""
WEDGE = [0, 2, 1, 3, 5, 4]
"""Nodes of VTK's linear wedge in the order that meshio, which writes it, and all others have."""
_COMPRESSORS = {None: False, "vtkZLibDataCompressor": False, "vtkLZMADataCompressor": True}
"""Whether they are LZMA."""

_TYPES = {
    f"{kind}{bits}": f"{code}{bits // 8}"
    for kind, code, sizes in (
        ("Float", "f", (32, 64)),
        ("Int", "i", (8, 16, 32, 64)),
        ("UInt", "u", (8, 16, 32, 64)),
    )
    for bits in sizes
}
_NAMES = {code: name for name, code in _TYPES.items()}
_BLOCK = 32768


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFile:
    """A triangulated surface as it stands in a file.

    Attributes
    ----------
    vertices
        ``(n, 3)`` mm.
    triangles
        ``(m, 3)``.
    point_data, cell_data
        Named arrays with n or m rows; empty for STL and OBJ.
    groups
        Name of the group of each triangle, or of its object, of an OBJ file.
    """

    vertices: FloatArray
    triangles: IntArray
    point_data: dict[str, NDArray[np.generic]] = field(default_factory=dict)
    cell_data: dict[str, NDArray[np.generic]] = field(default_factory=dict)
    groups: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CellFile:
    """Cells of several kinds as they stand in a file.

    Attributes
    ----------
    points
        ``(n, 3)`` mm.
    blocks
        Of each run of cells of one kind its name, the number of the first one, and its nodes
        ``(m, k)``.
    point_data, cell_data
        Named arrays with a row for each point, or for each cell of all blocks.
    """

    points: FloatArray
    blocks: tuple[tuple[str, int, IntArray], ...]
    point_data: dict[str, NDArray[np.generic]]
    cell_data: dict[str, NDArray[np.generic]]


class _Decoder:
    """Turns the ``DataArray`` elements of one file into arrays of bounded size together."""

    def __init__(self, content: bytes) -> None:
        head, appended = content, b""
        mark = re.search(rb"<AppendedData[^>]*>\s*_", content)
        if mark:
            end = content.rfind(b"</AppendedData>")
            appended = content[mark.end() : end]
            head = content[: mark.end() - 1] + content[end:]
        self.root = ET.fromstring(head)
        order = "<" if self.root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
        self.order = order
        self.header = self._dtype(self.root.get("header_type", "UInt32"))
        self.compressor = self.root.get("compressor")
        if self.compressor not in _COMPRESSORS:
            raise InputError(
                f"compressor {self.compressor} is not known; save it with ZLib or without"
            )
        self.appended = appended
        node = self.root.find("AppendedData")
        self.appended_base64 = node is not None and node.get("encoding") == "base64"
        # Of all arrays: several may refer to the same bytes.
        self.left = max_inflated(len(content))

    def _dtype(self, name: str | None) -> np.dtype[np.generic]:
        if name not in _TYPES:
            raise InputError(f"numbers of type {name!r}, expected {', '.join(_TYPES)}")
        return np.dtype(self.order + _TYPES[name])

    def array(self, node: ET.Element) -> NDArray[np.generic]:
        dtype = self._dtype(node.get("type"))
        form = node.get("format", "ascii")
        if form == "ascii":
            values = array_of_words((node.text or "").split(), dtype)
        elif form == "binary":
            values = self._values(self._base64((node.text or "").strip().encode()), dtype)
        elif form == "appended":
            offset = int(node.attrib["offset"])
            if not 0 <= offset < len(self.appended):
                raise InputError(
                    f"offset {offset} of an array, with {len(self.appended)} bytes appended"
                )
            stored = self.appended[offset:]
            raw = self._base64(stored) if self.appended_base64 else self._raw(stored)
            values = self._values(raw, dtype)
        else:
            raise InputError(f"DataArray format {form!r}; expected ascii, binary or appended")
        parts = int(node.get("NumberOfComponents") or 1)
        values = values.astype(dtype.newbyteorder("="))
        return values.reshape(-1, parts) if parts > 1 else values

    def named(self, parent: ET.Element | None) -> dict[str, NDArray[np.generic]]:
        """All arrays of a part of the file."""
        arrays = [] if parent is None else parent.findall("DataArray")
        return {array.get("Name", ""): self.array(array) for array in arrays}

    @staticmethod
    def _values(raw: bytes, dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
        if len(raw) % dtype.itemsize:
            raise InputError(f"{len(raw)} bytes of an array, whose numbers have {dtype.itemsize}")
        return np.frombuffer(raw, dtype)

    def _base64(self, text: bytes) -> bytes:
        if self.compressor is None:
            return self._raw(base64.b64decode(_base64_run(text)))
        # The header is encoded by itself; its length follows from its first number.
        size = self.header.itemsize
        blocks = self._first(base64.b64decode(text[: 4 * -(-size // 3)]))
        length = 4 * -(-(3 + blocks) * size // 3)
        return self._raw(
            base64.b64decode(text[:length])[: (3 + blocks) * size]
            + base64.b64decode(_base64_run(text[length:]))
        )

    def _raw(self, data: bytes) -> bytes:
        size, count = self.header.itemsize, self._first(data)
        if self.compressor is None:
            result = data[size : size + count]
            if len(result) != count:
                raise InputError(f"{len(result)} bytes of an array, expected {count}")
            self._spend(count)
            return result
        if (3 + count) * size > len(data):
            raise InputError(f"{count} compressed blocks in {len(data)} bytes")
        sizes = np.frombuffer(data[: (3 + count) * size], self.header)[3:].tolist()
        at, blocks = (3 + count) * size, []
        for stored in sizes:
            block = inflate(
                data[at : at + stored], self.left, of_lzma=_COMPRESSORS[self.compressor]
            )
            self._spend(len(block))
            blocks.append(block)
            at += stored
        return b"".join(blocks)

    def _first(self, data: bytes) -> int:
        size = self.header.itemsize
        if len(data) < size:
            raise InputError("an array without its length")
        return int(np.frombuffer(data[:size], self.header)[0])

    def _spend(self, count: int) -> None:
        self.left -= count
        if self.left < 0:
            raise InputError("arrays hold more than a file of its size may")


def _base64_run(text: bytes) -> bytes:
    """The leading run of base64 characters: appended arrays follow each other without a gap."""
    run = re.match(rb"[A-Za-z0-9+/]*={0,2}", text)
    return run.group() if run else b""


def read_vtp(path: Path) -> SurfaceFile:
    """Read a ``.vtp`` file of triangles.

    Raises
    ------
    InputError
        The file is no PolyData file, or holds polygons other than triangles, lines or strips.
    """
    with refusing(path, "VTK XML file"):
        decoder, piece = _piece(path, "PolyData")
        for kind in ("Verts", "Lines", "Strips"):
            if int(piece.get(f"NumberOf{kind}", "0")):
                raise InputError(f"holds {kind.lower()}; expected triangles only")
        sizes, connectivity, _ = _cells(decoder, piece, "Polys")
        if (sizes != 3).any():
            raise InputError(
                f"polygon {int(np.flatnonzero(sizes != 3)[0])} has {int(sizes[sizes != 3][0])} "
                f"corners; triangulate the surface first"
            )
        return SurfaceFile(
            vertices=_points(decoder, piece),
            triangles=connectivity.reshape(-1, 3),
            point_data=decoder.named(piece.find("PointData")),
            cell_data=decoder.named(piece.find("CellData")),
        )


def read_vtu(path: Path) -> CellFile:
    """Read a ``.vtu`` file of cells of the kinds of `CELLS`.

    Raises
    ------
    InputError
        The file is no UnstructuredGrid file, or holds other cells.
    """
    with refusing(path, "VTU file"):
        decoder, piece = _piece(path, "UnstructuredGrid")
        sizes, connectivity, types = _cells(decoder, piece, "Cells")
        if len(types) != len(sizes):
            raise InputError(f"{len(types)} types of {len(sizes)} cells")
        points = _points(decoder, piece)
        if connectivity.size and not 0 <= connectivity.min() <= connectivity.max() < len(points):
            raise GeometryError("cells name points that do not exist")
        starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(types.astype(np.int64)))])
        ends, at = [*starts[1:].tolist(), len(types)], 0
        blocks = []
        for start, end in zip(starts.tolist(), ends, strict=True) if len(types) else ():
            number = int(types[start])
            name, width = CELLS.get(number, (f"number {number} of VTK", -1))
            if (sizes[start:end] != width).any():
                raise GeometryError(f"holds cells of type {name}, or with other than their nodes")
            block = connectivity[at : at + (end - start) * width].reshape(-1, width)
            if name == "wedge":
                block = block[:, WEDGE]
            blocks.append((name, start, block))
            at += block.size
        cell_data = decoder.named(piece.find("CellData"))
        for key, values in cell_data.items():
            if len(values) != len(types):
                raise InputError(f"data {key!r} has {len(values)} rows, expected {len(types)}")
        return CellFile(points, tuple(blocks), decoder.named(piece.find("PointData")), cell_data)


def _piece(path: Path, kind: str) -> tuple[_Decoder, ET.Element]:
    decoder = _Decoder(read_bytes(path, MAX_SURFACE))
    grid = decoder.root.find(kind)
    if grid is None:
        raise InputError(f"holds {decoder.root.get('type')!r}, expected {kind}")
    pieces = grid.findall("Piece")
    if len(pieces) != 1:
        raise InputError(f"holds {len(pieces)} pieces, expected one")
    return decoder, pieces[0]


def _points(decoder: _Decoder, piece: ET.Element) -> FloatArray:
    node = piece.find("Points/DataArray")
    if node is None:
        raise InputError("holds no points")
    points = decoder.array(node).astype(np.float64)
    if points.size % 3 or (points.ndim == 2 and points.shape[1] != 3):
        raise InputError(f"points of shape {points.shape}, expected (n, 3)")
    return points.reshape(-1, 3)


def _cells(
    decoder: _Decoder, piece: ET.Element, name: str
) -> tuple[IntArray, IntArray, NDArray[np.generic]]:
    """Number of corners of each cell, all corners one after another, and the cells' types."""
    parts = decoder.named(piece.find(name))
    if not {"connectivity", "offsets"} <= set(parts):
        raise InputError(f"holds no points or no {name.lower().replace('polys', 'polygons')}")
    whole = {key: _whole(parts[key], key) for key in ("connectivity", "offsets")}
    sizes = np.diff(whole["offsets"], prepend=0)
    if (sizes < 0).any() or sizes.sum() != len(whole["connectivity"]):
        raise InputError("offsets do not fit the corners of the cells")
    return sizes, whole["connectivity"], parts.get("types", np.zeros(0, dtype=np.uint8)).ravel()


def _whole(values: NDArray[np.generic], name: str) -> IntArray:
    if values.dtype.kind not in "iu":
        raise InputError(f"{name} of {values.dtype}, expected whole numbers")
    return values.astype(np.int64).ravel()


def write_vtp(path: Path, data: SurfaceFile, space: str = "") -> None:
    """Write triangles and their data as a ``.vtp`` file (inline base64, zlib).

    ``space`` (``LPS``) is the name of the axes, which 3D Slicer looks for among the field data.
    """
    root = ET.Element(
        "VTKFile",
        type="PolyData",
        version="1.0",
        byte_order="LittleEndian",
        header_type="UInt64",
        compressor="vtkZLibDataCompressor",
    )
    count = len(data.triangles)
    whole = ET.SubElement(root, "PolyData")
    if space:
        words = ET.SubElement(
            ET.SubElement(whole, "FieldData"),
            "Array",
            type="String",
            Name="SPACE",
            NumberOfTuples="1",
            format="ascii",
        )
        # VTK writes text as the numbers of its bytes, each string with a zero at its end.
        words.text = " ".join(str(byte) for byte in (*space.encode("ascii"), 0))
    piece = ET.SubElement(
        whole,
        "Piece",
        NumberOfPoints=str(len(data.vertices)),
        NumberOfVerts="0",
        NumberOfLines="0",
        NumberOfStrips="0",
        NumberOfPolys=str(count),
    )
    for name, arrays in (
        ("PointData", data.point_data),
        ("CellData", data.cell_data),
        ("Points", {"Points": data.vertices}),
        (
            "Polys",
            {"connectivity": data.triangles.ravel(), "offsets": 3 * np.arange(1, count + 1)},
        ),
    ):
        parent = ET.SubElement(piece, name)
        for key, values in arrays.items():
            _add_array(parent, key, values)
    ET.ElementTree(root).write(path, xml_declaration=True, encoding="utf-8")


def _add_array(parent: ET.Element, name: str, values: NDArray[np.generic]) -> None:
    array = np.ascontiguousarray(values)
    code = f"{array.dtype.kind}{array.dtype.itemsize}"
    if code not in _NAMES:
        raise InputError(f"data {name!r}: type {array.dtype} has no place in a VTK file")
    node = ET.SubElement(parent, "DataArray", type=_NAMES[code], Name=name, format="binary")
    if array.ndim > 1:
        node.set("NumberOfComponents", str(array.shape[1]))
    raw = array.astype(array.dtype.newbyteorder("<")).tobytes()
    blocks = [zlib.compress(raw[i : i + _BLOCK]) for i in range(0, len(raw), _BLOCK)]
    last = len(raw) % _BLOCK
    header = np.array([len(blocks), _BLOCK, last, *map(len, blocks)], dtype="<u8").tobytes()
    node.text = base64.b64encode(header).decode() + base64.b64encode(b"".join(blocks)).decode()
