"""Tetrahedral meshes as plain arrays: orientation, outer faces, midside nodes, content hash."""

from __future__ import annotations

import hashlib

import numpy as np

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray

_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of the face opposite to each corner, normals outwards when the volume is positive."""

_MIDDLES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
"""Corners whose middle is node 4, 5, ... of a ``tet10`` (order of `mvest.elements`)."""


def volumes(nodes: FloatArray, tetrahedra: IntArray) -> FloatArray:
    """Signed volume ``(m,)`` mm³ of every tetrahedron."""
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    result: FloatArray = np.linalg.det(edges) / 6.0
    return result


def orient(nodes: FloatArray, tetrahedra: IntArray) -> IntArray:
    """Tetrahedra with two corners exchanged wherever the volume is negative."""
    result = np.array(tetrahedra, dtype=np.int64)
    negative = volumes(nodes, result) < 0
    result[negative, 2], result[negative, 3] = result[negative, 3], result[negative, 2].copy()
    return result


def drop_unused_nodes(nodes: FloatArray, elements: IntArray) -> tuple[FloatArray, IntArray]:
    """Nodes that some element uses, and the elements with the new numbers."""
    used, inverse = np.unique(elements, return_inverse=True)
    return nodes[used], inverse.reshape(elements.shape)


def outer_faces(tetrahedra: IntArray) -> tuple[IntArray, IntArray]:
    """Faces that bound the mesh, normals outwards.

    Returns
    -------
    faces
        ``(f, 3)`` corner nodes.
    owner
        ``(f,)`` the tetrahedron of each.

    Raises
    ------
    GeometryError
        A face belongs to more than two tetrahedra.
    """
    faces = tetrahedra[:, :4][:, _FACES].reshape(-1, 3)
    _, inverse, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if (count > 2).any():
        owners = np.unique(np.flatnonzero(np.isin(inverse, np.flatnonzero(count > 2))) // 4)
        raise GeometryError(
            f"{int((count > 2).sum())} faces belong to more than two tetrahedra (elements "
            f"{owners[:8].tolist()}); expected at most two"
        )
    outer = np.flatnonzero(count[inverse.ravel()] == 1)
    return faces[outer], outer // 4


def promote_to_tet10(nodes: FloatArray, tetrahedra: IntArray) -> tuple[FloatArray, IntArray]:
    """Add a node at the middle of every edge.

    Returns
    -------
    nodes
        ``(n + n_edges, 3)`` mm, the corners first.
    elements
        ``(m, 10)`` in the order of `mvest.elements`.
    """
    pairs = np.sort(tetrahedra[:, _MIDDLES].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    middle = len(nodes) + inverse.reshape(-1, 6)
    return (
        np.concatenate([nodes, nodes[edges].mean(axis=1)]),
        np.concatenate([tetrahedra, middle], axis=1),
    )


def tri6_faces(faces: IntArray, elements: IntArray, owner: IntArray) -> IntArray:
    """Six-node faces ``(f, 6)`` of ``tet10`` elements: corners, then the middles of 01, 12, 20."""
    result = np.empty((len(faces), 6), dtype=np.int64)
    result[:, :3] = faces
    cells = elements[owner]
    # Local corner number of each face corner in its element.
    local = np.argmax(cells[:, None, :4] == faces[:, :, None], axis=2)
    number = np.full((4, 4), -1)
    for k, (a, b) in enumerate(_MIDDLES):
        number[a, b] = number[b, a] = 4 + k
    for i in range(3):
        position = number[local[:, i], local[:, (i + 1) % 3]]
        result[:, 3 + i] = cells[np.arange(len(faces)), position]
    return result


def content_sha256(nodes: FloatArray, tetrahedra: IntArray) -> str:
    """SHA-256 of a mesh's content: nodes rounded to 1e-9 mm, and tetrahedra."""
    digest = hashlib.sha256()
    # Adding zero turns -0.0 into 0.0, which has other bytes.
    digest.update(np.ascontiguousarray(np.round(nodes, 9) + 0.0, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(tetrahedra, dtype="<i8").tobytes())
    return digest.hexdigest()
