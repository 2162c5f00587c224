"""Binary glTF 2.0 by trimesh, and with another description of its scene."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import trimesh


def write_parts(path: Path, parts: dict[str, Any]) -> Path:
    """Write named surfaces (points, triangles), each an object of its own."""
    scene = trimesh.Scene()
    for name, (points, triangles) in parts.items():
        mesh = trimesh.Trimesh(points, triangles, process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    scene.export(path)
    return path


def described(whole: bytes, change: Callable[[Any], object], version: int = 2) -> bytes:
    """A file of glTF whose description was changed."""
    end = 20 + int.from_bytes(whole[12:16], "little")
    document = json.loads(whole[20:end])
    change(document)
    text = json.dumps(document).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    size = 20 + len(text) + len(whole) - end
    head = struct.pack("<4sIII4s", b"glTF", version, size, len(text), b"JSON")
    return head + text + whole[end:]
