"""VTK PolyData (``.vtp``) files of triangles, read and written without VTK.

meshio 5.3 has no reader or writer for this format and VTK itself is too large to require, so the
part of the VTK XML format that a triangulated surface needs is here: every encoding is read
(text, base64 inline, base64 or raw appended, zlib or no compression), and base64 with zlib is
written. Format: *The VTK User's Guide*, 11th edition, section 19.3, "XML file formats".
"""

from __future__ import annotations

import base64
import re
import xml.etree.ElementTree as ET
import zlib
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray

__all__ = ["SurfaceFile", "read_vtp", "write_vtp"]

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
    """

    vertices: FloatArray
    triangles: IntArray
    point_data: dict[str, NDArray[np.generic]] = field(default_factory=dict)
    cell_data: dict[str, NDArray[np.generic]] = field(default_factory=dict)


class _Decoder:
    """Turns the ``DataArray`` elements of one file into arrays."""

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
        self.header = np.dtype(order + _TYPES[self.root.get("header_type", "UInt32")])
        compressor = self.root.get("compressor")
        if compressor not in (None, "vtkZLibDataCompressor"):
            raise InputError(f"compressor {compressor} is not known; save it with ZLib or without")
        self.compressed = compressor is not None
        self.appended = appended
        node = self.root.find("AppendedData")
        self.appended_base64 = node is not None and node.get("encoding") == "base64"

    def array(self, node: ET.Element) -> NDArray[np.generic]:
        dtype = np.dtype(self.order + _TYPES[node.attrib["type"]])
        form = node.get("format", "ascii")
        if form == "ascii":
            values: NDArray[np.generic] = np.array((node.text or "").split(), dtype=dtype)
        elif form == "binary":
            values = np.frombuffer(self._base64((node.text or "").strip().encode()), dtype)
        elif form == "appended":
            stored = self.appended[int(node.attrib["offset"]) :]
            values = np.frombuffer(
                self._base64(stored) if self.appended_base64 else self._raw(stored), dtype
            )
        else:
            raise InputError(f"DataArray format {form!r}; expected ascii, binary or appended")
        parts = int(node.get("NumberOfComponents") or 1)
        values = values.astype(dtype.newbyteorder("="))
        return values.reshape(-1, parts) if parts > 1 else values

    def _base64(self, text: bytes) -> bytes:
        if not self.compressed:
            return self._raw(base64.b64decode(_base64_run(text)))
        # The header is encoded by itself; its length follows from its first number.
        size = self.header.itemsize
        first = base64.b64decode(text[: 4 * -(-size // 3)])
        blocks = int(np.frombuffer(first[:size], self.header)[0])
        length = 4 * -(-(3 + blocks) * size // 3)
        return self._raw(
            base64.b64decode(text[:length])[: (3 + blocks) * size]
            + base64.b64decode(_base64_run(text[length:]))
        )

    def _raw(self, data: bytes) -> bytes:
        size = self.header.itemsize
        count = int(np.frombuffer(data[:size], self.header)[0])
        if not self.compressed:
            return data[size : size + count]
        sizes = np.frombuffer(data[: (3 + count) * size], self.header)[3:]
        ends = (3 + count) * size + np.cumsum(np.concatenate(([0], sizes.astype(np.int64))))
        return b"".join(zlib.decompress(data[a:b]) for a, b in pairwise(ends))


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
    try:
        decoder = _Decoder(path.read_bytes())
        grid = decoder.root.find("PolyData")
        if grid is None:
            raise InputError(f"holds {decoder.root.get('type')!r}, expected PolyData")
        pieces = grid.findall("Piece")
        if len(pieces) != 1:
            raise InputError(f"holds {len(pieces)} pieces, expected one")
        return _piece(decoder, pieces[0])
    except InputError as fault:
        raise InputError(f"{path}: {fault}") from fault
    except (ET.ParseError, KeyError, ValueError, zlib.error, IndexError) as fault:
        raise InputError(f"{path}: damaged or no VTK XML file: {fault}") from fault


def _piece(decoder: _Decoder, piece: ET.Element) -> SurfaceFile:
    for kind in ("Verts", "Lines", "Strips"):
        if int(piece.get(f"NumberOf{kind}", "0")):
            raise InputError(f"holds {kind.lower()}; expected triangles only")
    points_node = piece.find("Points/DataArray")
    polys = piece.find("Polys")
    if points_node is None or polys is None:
        raise InputError("holds no points or no polygons")
    parts = {node.attrib["Name"]: decoder.array(node) for node in polys.findall("DataArray")}
    sizes = np.diff(parts["offsets"].astype(np.int64), prepend=0)
    if (sizes != 3).any():
        raise InputError(
            f"polygon {int(np.flatnonzero(sizes != 3)[0])} has {int(sizes[sizes != 3][0])} "
            f"corners; triangulate the surface first"
        )
    return SurfaceFile(
        vertices=decoder.array(points_node).astype(np.float64).reshape(-1, 3),
        triangles=parts["connectivity"].astype(np.int64).reshape(-1, 3),
        point_data=_data(decoder, piece.find("PointData")),
        cell_data=_data(decoder, piece.find("CellData")),
    )


def _data(decoder: _Decoder, node: ET.Element | None) -> dict[str, NDArray[np.generic]]:
    arrays = [] if node is None else node.findall("DataArray")
    return {array.attrib["Name"]: decoder.array(array) for array in arrays}


def write_vtp(path: Path, data: SurfaceFile) -> None:
    """Write triangles and their data as a ``.vtp`` file (inline base64, zlib)."""
    root = ET.Element(
        "VTKFile",
        type="PolyData",
        version="1.0",
        byte_order="LittleEndian",
        header_type="UInt64",
        compressor="vtkZLibDataCompressor",
    )
    count = len(data.triangles)
    piece = ET.SubElement(
        ET.SubElement(root, "PolyData"),
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
