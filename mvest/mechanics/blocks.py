"""Rectangular blocks of any element: sheets, strips and patches for examples and verification."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

import numpy as np

from mvest.elements import element
from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray

# All local nodes on the grid that halves every cell, in the node orders of mvest.elements.
_EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
_TRIANGLES = (
    ((0, 0), (2, 0), (2, 2), (1, 0), (2, 1), (1, 1)),
    ((0, 0), (2, 2), (0, 2), (1, 1), (1, 2), (0, 1)),
)


def _tetrahedra(quadratic: bool) -> list[list[tuple[int, ...]]]:
    """Six tetrahedra of a cube around its diagonal (Kuhn 1960), positively oriented."""
    tetrahedra = []
    for axes in permutations(range(3)):
        steps = np.eye(3, dtype=np.int64)[list(axes)] * 2
        corners = np.vstack([np.zeros((1, 3), dtype=np.int64), np.cumsum(steps, axis=0)])
        if np.linalg.det(steps) < 0:
            corners = corners[[0, 1, 3, 2]]
        middles = [(corners[a] + corners[b]) // 2 for a, b in _EDGES] if quadratic else []
        tetrahedra.append([tuple(map(int, c)) for c in (*corners, *middles)])
    return tetrahedra


def _templates(element_type: str) -> list[list[tuple[int, ...]]]:
    element(element_type)
    if element_type in ("tet4", "tet10"):
        return _tetrahedra(element_type == "tet10")
    levels = (0, 1, 2) if element_type in ("hex27", "wedge18") else (0, 2)
    plane: Iterable[Iterable[tuple[int, int]]]
    if element_type.startswith("hex"):
        plane = ([(i, j) for j in range(3) for i in range(3)],)
    else:
        plane = _TRIANGLES
    return [[(i, j, k) for k in levels for i, j in cell] for cell in map(list, plane)]


def box(
    element_type: str, cells: tuple[int, int, int], size: tuple[float, float, float]
) -> tuple[FloatArray, IntArray]:
    """Nodes and elements of the block ``[0, size]``, its third axis being the thickness.

    Parameters
    ----------
    element_type : str
        Any element; each cell becomes one brick, two wedges or six tetrahedra.
    cells : tuple of int
        Cells along x, y and z.
    size : tuple of float
        mm.

    Returns
    -------
    nodes : ndarray
        ``(n, 3)`` mm.
    elements : ndarray
        ``(m, k)`` node indices.

    Raises
    ------
    InputError
        If the element is unknown, or a size or number of cells is not positive.
    """
    if min(cells) < 1 or not min(size) > 0:
        raise InputError(f"box of {cells} cells and size {size} mm, expected all > 0")
    first = 2 * np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    local = np.array(_templates(element_type))
    grid = (first[:, None, None, :] + local[None]).reshape(-1, local.shape[1], 3)
    points = 2 * np.array(cells) + 1
    number = np.ravel_multi_index(tuple(np.moveaxis(grid, -1, 0)), tuple(points))
    used, elements = np.unique(number, return_inverse=True)
    at = np.stack(np.unravel_index(used, tuple(points)), axis=-1)
    nodes = at / (points - 1) * np.array(size, dtype=float)
    return nodes, elements.reshape(number.shape).astype(np.int64)


def outer_faces(elements: IntArray, element_type: str) -> IntArray:
    """Faces that belong to one element only, normals pointing out of the solid.

    Of layered elements (bricks and wedges) only the two faces across the thickness are considered:
    those are the ones that pressure acts on.

    Parameters
    ----------
    elements : ndarray
        ``(m, k)``.
    element_type : str

    Returns
    -------
    faces : ndarray
        ``(f, kf)`` in the node order of the element's face (see :mod:`mvest.elements`).
    """
    reference = element(element_type)
    elements = np.asarray(elements)
    if element_type in ("tet4", "tet10"):
        # The middles of edges 01, 12, 20 follow the corners of each face.
        local = np.array(
            [[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]]
        )[:, : 3 if element_type == "tet4" else 6]
    else:
        top = reference.top_face
        mirrored = [2, 1, 0, 5, 4, 3, 8, 7, 6] if len(top) == 9 else [0, 2, 1, 5, 4, 3]
        local = np.array([np.arange(len(top))[mirrored], top])
    faces = elements[:, local].reshape(-1, local.shape[1])
    _, inverse, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return faces[count[inverse.ravel()] == 1]
