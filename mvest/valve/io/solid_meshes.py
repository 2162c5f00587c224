"""Reading and writing a `SolidMesh` as VTU, without loss.

Elements that VTK or meshio lacks, ``hex18``, ``hex18_thin`` and ``wedge12``, are written as four
linear ones. Pressure faces are a second block of cells. Fibres are stored per element node, as the
mesh has them, and as one mean direction per element for looking at.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.elements import FACES, element
from mvest.errors import InputError
from mvest.reading.bounded import refusing
from mvest.typing import FloatArray, IntArray
from mvest.valve.io.leaflet_surfaces import (
    cell_arrays,
    check_finite,
    region_arrays,
    region_names,
    write_cells,
)
from mvest.valve.io.vtk_xml import CellFile, read_vtu
from mvest.valve.mesh.solid_mesh import SolidMesh

__all__ = ["read_solid", "vtk_cells", "write_solid"]

VTK_ORDER: dict[str, tuple[str, list[int]]] = {
    "tet4": ("tetra", list(range(4))),
    "tet10": ("tetra10", list(range(10))),
    "wedge18": (
        "wedge18",
        [0, 1, 2, 12, 13, 14, 3, 4, 5, 15, 16, 17, 6, 7, 8, 9, 10, 11],
    ),
    "hex27": (
        "hexahedron27",
        [
            *(0, 2, 8, 6, 18, 20, 26, 24),  # corners
            *(1, 5, 7, 3, 19, 23, 25, 21, 9, 11, 17, 15),  # edges
            *(12, 14, 10, 16, 4, 22, 13),  # faces, centre
        ],
    ),
    "tri3": ("triangle", list(range(3))),
    "tri6": ("triangle6", list(range(6))),
    "quad9": ("quad9", [0, 2, 8, 6, 1, 5, 7, 3, 4]),
}
"""meshio's name of an element or face, and our node at each place of VTK's order."""

QUARTERS: dict[str, tuple[str, list[list[int]]]] = {
    "hex18": (
        "hexahedron",
        [[n, n + 1, n + 4, n + 3, n + 9, n + 10, n + 13, n + 12] for n in (0, 1, 3, 4)],
    ),
    "wedge12": (
        "wedge",
        [
            [a, b, c, a + 6, b + 6, c + 6]
            for a, b, c in ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
        ],
    ),
}
"""meshio's name and the nodes of the four linear elements that stand for one of ours."""


THIN = "_thin"
"""Ending of elements that are laid out as those without it; cell data of this name marks them."""


def _to_vtk(name: str, cells: IntArray) -> tuple[str, IntArray]:
    if name in QUARTERS:
        kind, quarters = QUARTERS[name]
        return kind, cells[:, quarters].reshape(-1, len(quarters[0]))
    kind, order = VTK_ORDER[name]
    return kind, cells[:, order]


def _from_vtk(name: str, cells: IntArray) -> IntArray:
    if name in QUARTERS:
        result = np.empty((len(cells) // 4, element(name).n_nodes), dtype=np.int64)
        for quarter, places in enumerate(QUARTERS[name][1]):
            result[:, places] = cells[quarter::4]
        return result
    result = np.empty_like(cells)
    result[:, VTK_ORDER[name][1]] = cells
    return result


def vtk_cells(mesh: SolidMesh) -> list[tuple[str, IntArray]]:
    """Elements and pressure faces as two blocks of cells in VTK's order."""
    blocks = [_to_vtk(mesh.element_type.removesuffix(THIN), mesh.elements)]
    if len(mesh.pressure_faces):
        blocks.append(_to_vtk(mesh.reference.face, mesh.pressure_faces))
    return blocks


def vtk_cell_data(mesh: SolidMesh) -> dict[str, list[Any]]:
    """Cell data of those blocks: region (-1 on faces), fibre, and fibres of the element's nodes."""
    pieces = 4 if mesh.element_type.removesuffix(THIN) in QUARTERS else 1
    lead = mesh.fibre[:, :1]
    sign = np.where((mesh.fibre * lead).sum(axis=2, keepdims=True) < 0, -1.0, 1.0)
    solid: dict[str, NDArray[np.generic]] = {
        **region_arrays(mesh.region, mesh.region_names),
        "fibre": (sign * mesh.fibre).mean(axis=1),
        "node_fibres": mesh.fibre.reshape(len(mesh.elements), -1),
    }
    if mesh.element_type.endswith(THIN):
        solid[THIN] = np.ones(len(mesh.elements), dtype=np.int8)
    solid = {name: np.repeat(values, pieces, axis=0) for name, values in solid.items()}
    if not len(mesh.pressure_faces):
        return cell_arrays([solid])
    count = len(mesh.pressure_faces)
    faces = {
        name: np.zeros((count, *values.shape[1:]), dtype=values.dtype)
        for name, values in solid.items()
    }
    faces["region"] = np.full(count, -1, dtype=np.int64)
    return cell_arrays([solid, faces])


def write_solid(
    path: Path | str, mesh: SolidMesh, point_data: dict[str, FloatArray] | None = None
) -> Path:
    """Write a solid mesh as ``.vtu``, with further `point_data` ``(n,)`` or ``(n, c)`` to look at.

    Raises
    ------
    InputError
        Another extension, wrong shapes, or a file that cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() != ".vtu":
        raise InputError(f"{target}: extension {target.suffix!r}, expected .vtu")
    for name, values in (point_data or {}).items():
        if np.ndim(values) not in (1, 2) or len(values) != len(mesh.nodes):
            raise InputError(
                f"point data {name!r}: shape {np.shape(values)}, expected ({len(mesh.nodes)},) or "
                f"({len(mesh.nodes)}, c)"
            )
    write_cells(target, mesh.nodes, vtk_cells(mesh), point_data or {}, vtk_cell_data(mesh))
    return target


def read_solid(path: Path | str) -> SolidMesh:
    """Read what `write_solid` wrote.

    Raises
    ------
    InputError, GeometryError
        Missing, damaged or foreign file, or an inadmissible mesh.
    """
    source = Path(path)
    if source.suffix.lower() != ".vtu":
        raise InputError(f"{source}: extension {source.suffix!r}, expected .vtu")
    with refusing(source, "solid mesh"):
        return _solid(read_vtu(source))


def _solid(mesh: CellFile) -> SolidMesh:
    check_finite(mesh.points)
    names = {kind: name for name, (kind, _) in (*VTK_ORDER.items(), *QUARTERS.items())}
    blocks = {names.get(kind, kind): (start, cells) for kind, start, cells in mesh.blocks}
    solids = [name for name in blocks if name in names.values() and name not in FACES]
    if len(solids) != 1 or len(mesh.blocks) > 2:
        kinds = ", ".join(kind for kind, _, _ in mesh.blocks) or "none"
        raise InputError(f"cells of type {kinds}, expected one kind of solid element and its faces")
    missing = [name for name in ("region", "node_fibres") if name not in mesh.cell_data]
    if missing:
        raise InputError(f"no cell data {', '.join(missing)}; not written by mvest?")
    name = solids[0]
    reference = element(name)
    start, cells = blocks[name]
    pieces = 4 if name in QUARTERS else 1
    if len(cells) % pieces:
        raise InputError(f"{len(cells)} cells, expected {pieces} for each element")
    rows = slice(start, start + len(cells), pieces)
    elements = _from_vtk(name, cells)
    faces = np.zeros((0, FACES[reference.face].n_nodes), dtype=np.int64)
    if reference.face in blocks:
        faces = _from_vtk(reference.face, blocks[reference.face][1])
    return SolidMesh(
        nodes=mesh.points,
        elements=elements,
        element_type=name + THIN if THIN in mesh.cell_data else name,
        region=np.asarray(mesh.cell_data["region"][rows], dtype=np.int64),
        region_names=region_names(mesh.cell_data),
        fibre=np.asarray(
            mesh.cell_data["node_fibres"][rows].reshape(len(elements), -1, 3), dtype=np.float64
        ),
        pressure_faces=faces,
    )
