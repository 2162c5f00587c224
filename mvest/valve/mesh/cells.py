"""Elements that fill the cells of a regular lattice, and the outer faces of any mesh.

A lattice has two steps along each axis of a cell, so that mid-edge nodes are lattice points. A cell
is one brick, two wedges or six tetrahedra.
"""

import numpy as np

from mvest.elements import element
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray

EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
"""Corners between which the nodes 4, 5, ... of a ``tet10`` lie."""

# A prism 0 1 2 (bottom) 3 4 5 (top) as three tetrahedra. The diagonal of each quadrilateral side
# runs from the bottom node with the smaller number, so that neighbours agree.
_PRISM = np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])
_HALVES = (((0, 0), (2, 0), (2, 2)), ((0, 0), (0, 2), (2, 2)))
_TRIANGLES = (
    ((0, 0), (2, 0), (2, 2), (1, 0), (2, 1), (1, 1)),
    ((0, 0), (2, 2), (0, 2), (1, 1), (1, 2), (0, 1)),
)
_MIRRORED = {"quad9": [2, 1, 0, 5, 4, 3, 8, 7, 6], "tri6": [0, 2, 1, 5, 4, 3]}
"""Nodes of a face in the order that reverses its normal."""


def _cell(element_type: str) -> IntArray:
    """Nodes ``(p, t, k, 3)`` on the lattice of the elements of one cell, in p groups of t."""
    if element_type.startswith("tet"):
        corners = np.array([[(*at, k) for k in (0, 2) for at in half] for half in _HALVES])
        corners = corners[:, _PRISM]
        turned = np.linalg.det(corners[..., 1:, :] - corners[..., :1, :]) < 0
        corners[turned] = corners[turned][:, [0, 1, 3, 2]]
        middles = corners[..., EDGES, :].sum(axis=-2) // 2
        return corners if element_type == "tet4" else np.concatenate([corners, middles], axis=2)
    levels = (0, 1, 2) if element_type in ("hex27", "wedge18") else (0, 2)
    brick = element_type.startswith("hex")
    plane = [[(i, j) for j in range(3) for i in range(3)]] if brick else _TRIANGLES
    return np.array([[[(*at, k) for k in levels for at in part] for part in plane]])


def lattice_elements(
    element_type: str, cells: tuple[int, int, int], *, left_handed: bool = False
) -> IntArray:
    """Nodes ``(m, k, 3)`` on the lattice of the elements of all cells.

    Parameters
    ----------
    element_type : str
    cells : tuple of int
        Along the first (fastest), second and third axis; the third is the thickness.
    left_handed : bool
        Whether the lattice has left-handed axes.
    """
    reference, local = element(element_type), _cell(element_type)
    if left_handed and reference.layered:
        size = len(reference.top_face)
        levels = np.arange(0, reference.n_nodes, size)
        local = local[:, :, (levels[:, None] + _MIRRORED[reference.face]).ravel()]
    elif left_handed:
        local = local[:, :, [0, 1, 3, 2, 4, 8, 7, 6, 5, 9][: reference.n_nodes]]
    first = 2 * np.stack(np.meshgrid(*map(np.arange, cells[::-1]), indexing="ij")[::-1], axis=-1)
    grid = first.reshape(-1, 1, 1, 3) + local[:, None]
    return np.asarray(grid.reshape(-1, *local.shape[2:]))


def numbered(grid: IntArray, points: tuple[int, int, int]) -> tuple[IntArray, IntArray]:
    """Elements ``(m, k)`` and lattice positions ``(n, 3)`` of their nodes."""
    number = np.ravel_multi_index(tuple(np.moveaxis(grid, -1, 0)), points, order="F")
    used, elements = np.unique(number, return_inverse=True)
    at = np.stack(np.unravel_index(used, points, order="F"), axis=-1)
    return elements.reshape(number.shape).astype(np.int64), at


def box(
    element_type: str, cells: tuple[int, int, int], size: tuple[float, float, float]
) -> tuple[FloatArray, IntArray]:
    """Nodes ``(n, 3)`` mm and elements ``(m, k)`` of the block ``[0, size]``.

    InputError if the element is unknown, or a size or number of cells is not positive.

    Parameters
    ----------
    element_type : str
        Any element; each cell becomes one brick, two wedges or six tetrahedra.
    cells : tuple of int
        Cells along x, y and z; z is the thickness.
    size : tuple of float
        mm.
    """
    if min(cells) < 1 or not min(size) > 0:
        raise InputError(f"box of {cells} cells and size {size} mm, expected all > 0")
    steps = 2 * np.array(cells)
    elements, at = numbered(lattice_elements(element_type, cells), tuple(steps + 1))
    return at / steps * np.array(size, dtype=float), elements


def local_faces(element_type: str) -> IntArray:
    """Local nodes ``(f, kf)`` of an element's faces, with outward normals.

    Layered elements have two faces only, those across the thickness, on which pressure acts. Nodes
    have the order of the face element (:mod:`mvest.elements`).
    """
    reference = element(element_type)
    if reference.layered:
        top = reference.top_face
        return np.array([np.arange(len(top))[_MIRRORED[reference.face]], top])
    faces = [[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]]
    return np.array(faces)[:, : 3 if element_type == "tet4" else 6]


def boundary(elements: IntArray, element_type: str) -> tuple[IntArray, IntArray]:
    """Faces of one element only: their elements ``(f,)`` and local numbers ``(f,)``.

    GeometryError if a face belongs to more than two elements.
    """
    local = local_faces(element_type)
    faces = np.sort(elements[:, local].reshape(-1, local.shape[1]), axis=1)
    _, inverse, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    if (count > 2).any():
        owners = np.unique(np.flatnonzero(count[inverse.ravel()] > 2) // len(local))
        raise GeometryError(
            f"{int((count > 2).sum())} faces belong to more than two elements (elements "
            f"{owners[:8].tolist()}); expected at most two"
        )
    outer = np.flatnonzero(count[inverse.ravel()] == 1)
    return outer // len(local), outer % len(local)


def outer_faces(elements: IntArray, element_type: str) -> IntArray:
    """Faces ``(f, kf)`` of one element only, with outward normals (see `local_faces`)."""
    elements = np.asarray(elements)
    owner, which = boundary(elements, element_type)
    return np.asarray(elements[owner[:, None], local_faces(element_type)[which]])


def with_middles(nodes: FloatArray, tetrahedra: IntArray) -> tuple[FloatArray, IntArray]:
    """Nodes ``(n + edges, 3)`` mm, corners first, and elements ``(m, 10)`` of a ``tet10`` mesh."""
    pairs = np.sort(tetrahedra[:, EDGES].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    middle = len(nodes) + inverse.reshape(-1, 6)
    return (
        np.concatenate([nodes, nodes[edges].mean(axis=1)]),
        np.concatenate([tetrahedra, middle], axis=1),
    )
