"""Binary glTF 2.0 written from its specification, for tests."""

import json
import struct
from pathlib import Path

import numpy as np

COMPONENT = {"<u1": 5121, "<u2": 5123, "<u4": 5125, "<f4": 5126}


class Glb:
    """A file in the making."""

    def __init__(self):
        self.binary = b""
        self.document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{}],
        }

    def array(self, values, dtype, stride=None):
        """The number of an accessor."""
        rows = np.ascontiguousarray(values, dtype=dtype)
        size = rows[0].nbytes
        data = b"".join(row.tobytes().ljust(stride or size, b"\xff") for row in rows)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        if stride:
            view["byteStride"] = stride
        self.binary += data.ljust(-(-len(data) // 4) * 4, b"\0")
        self.document["bufferViews"].append(view)
        self.document["accessors"].append(
            {
                "bufferView": len(self.document["bufferViews"]) - 1,
                "componentType": COMPONENT[dtype],
                "count": len(rows),
                "type": "SCALAR" if rows.ndim == 1 else "VEC3",
            }
        )
        return len(self.document["accessors"]) - 1

    def mesh(self, points, triangles=None, dtype="<u4", stride=None):
        """The number of a mesh."""
        primitive = {"attributes": {"POSITION": self.array(points, "<f4", stride)}}
        if triangles is not None:
            primitive["indices"] = self.array(np.ravel(triangles), dtype)
        self.document["meshes"].append({"primitives": [primitive]})
        return len(self.document["meshes"]) - 1

    def node(self, name=None, top=True, **content):
        """The number of a node, in the scene unless it is not at its top."""
        self.document["nodes"].append(({"name": name} if name else {}) | content)
        number = len(self.document["nodes"]) - 1
        if top:
            self.document["scenes"][0]["nodes"].append(number)
        return number

    def write(self, path: Path, version=2) -> Path:
        """The path."""
        self.document["buffers"][0]["byteLength"] = len(self.binary)
        text = json.dumps(self.document).encode()
        text = text.ljust(-(-len(text) // 4) * 4)
        parts = struct.pack("<I4s", len(text), b"JSON") + text
        parts += struct.pack("<I4s", len(self.binary), b"BIN\0") + self.binary
        path.write_bytes(struct.pack("<4sII", b"glTF", version, 12 + len(parts)) + parts)
        return path


def write_parts(path: Path, parts) -> Path:
    """Write named surfaces (points, triangles), each an object of its own."""
    file = Glb()
    for name, (points, triangles) in parts.items():
        file.node(name, mesh=file.mesh(points, triangles))
    return file.write(path)
