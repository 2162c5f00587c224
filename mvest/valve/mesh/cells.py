"""Cells of meshes as plain arrays.

Of tetrahedra: orientation, outer faces, midside nodes and a hash of the content. Of any element
type: the quality, inverted elements included. It takes plain arrays, so that a mesh too bad to
become a `SolidMesh` can still be examined.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from mvest.elements import Element, element
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import jacobian_determinants

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


@dataclass(frozen=True, slots=True)
class QualityReport:
    """Quality of a mesh.

    Attributes
    ----------
    n_nodes, n_elements
        Sizes.
    volume
        mm³, by the elements' quadrature.
    min_scaled_jacobian, mean_scaled_jacobian
        Smallest value over the mesh and mean of the elements' smallest values; 1 is ideal, 0 flat,
        negative inverted.
    min_jacobian
        Smallest determinant, mm³, at quadrature points and nodes.
    non_positive_at_points, non_positive_at_nodes
        Elements with a determinant that is not positive there.
    max_aspect, mean_aspect
        Longest over shortest edge of an element, corner to corner.
    worst
        Numbers of the elements of smallest scaled Jacobian, the worst first (at most ten).
    """

    n_nodes: int
    n_elements: int
    volume: float
    min_scaled_jacobian: float
    mean_scaled_jacobian: float
    min_jacobian: float
    non_positive_at_points: int
    non_positive_at_nodes: int
    max_aspect: float
    mean_aspect: float
    worst: tuple[int, ...]

    def __str__(self) -> str:
        return (
            f"{self.n_elements} elements, {self.n_nodes} nodes, {self.volume:.1f} mm^3; scaled "
            f"Jacobian {self.min_scaled_jacobian:.3f} (mean {self.mean_scaled_jacobian:.3f}), "
            f"aspect {self.max_aspect:.1f} (mean {self.mean_aspect:.1f}), not positive: "
            f"{self.non_positive_at_points} at quadrature points, {self.non_positive_at_nodes} "
            f"at nodes"
        )


def _frames(reference: Element) -> tuple[FloatArray, float]:
    """Edge directions ``(k, 3, 3)`` (columns) at the reference corners, and the ideal's inverse.

    A brick's edges run along its axes. A simplex has another triple at each corner, and the product
    of its unit edges is below one even when it is regular.
    """
    axes = np.eye(3)
    origin = np.zeros(3)
    if reference.name.startswith("tet"):
        corners = np.vstack([origin, axes])
        others = ([1, 2, 3], [2, 0, 3], [0, 1, 3], [1, 0, 2])
        frames = [(corners[list(o)] - corners[i]).T for i, o in enumerate(others)]
        return np.array(frames), float(np.sqrt(2.0))
    if reference.name.startswith("wedge"):
        corners = np.vstack([origin, axes[:2]])
        frames = [
            np.column_stack(
                [corners[(i + 1) % 3] - corners[i], corners[(i + 2) % 3] - corners[i], axes[2]]
            )
            for i in range(3)
        ]
        return np.array(frames), float(2.0 / np.sqrt(3.0))
    return axes[None], 1.0


def scaled_jacobians(
    nodes: FloatArray, elements: IntArray, reference: Element, points: FloatArray
) -> FloatArray:
    """Smallest scaled Jacobian ``(m,)`` of every element over `points` ``(q, 3)``.

    At a point it is the triple product of the unit tangents along the element's edges, divided by
    that of the regular element (Knupp 2000, Int. J. Numer. Meth. Engng 48:1165); for simplices the
    smallest over the corners' edge triples.
    """
    gradient = reference.gradient(points)
    jacobian = np.einsum("mai,qaj->mqij", nodes[elements], gradient)
    frames, scale = _frames(reference)
    smallest = np.full(len(elements), np.inf)
    for frame in frames:
        tangents = jacobian @ frame
        product = np.prod(np.linalg.norm(tangents, axis=2), axis=2)
        value = np.linalg.det(tangents) / np.maximum(product, 1e-300)
        smallest = np.minimum(smallest, scale * value.min(axis=1))
    return smallest


def _corner_edges(reference: Element) -> IntArray:
    """Node numbers ``(e, 2)`` of the edges between corners."""
    x = reference.node_coordinates
    whole = np.all((np.abs(x) == 1.0) | (x == 0.0), axis=1)
    if reference.name.startswith("hex"):
        whole = np.all(np.abs(x) == 1.0, axis=1)
    elif reference.name.startswith("wedge"):
        whole &= np.abs(x[:, 2]) == 1.0
    corners = np.flatnonzero(whole)
    edges = []
    for i, a in enumerate(corners):
        for b in corners[i + 1 :]:
            differs = x[a] != x[b]
            in_plane = reference.name.startswith("wedge") and not differs[2]
            if reference.name.startswith("tet") or in_plane or differs.sum() == 1:
                edges.append((a, b))
    return np.array(edges, dtype=np.int64)


def aspect_ratios(nodes: FloatArray, elements: IntArray, reference: Element) -> FloatArray:
    """Longest over shortest corner-to-corner edge ``(m,)``; infinite for a collapsed edge."""
    edges = elements[:, _corner_edges(reference)]
    length = np.linalg.norm(nodes[edges[..., 1]] - nodes[edges[..., 0]], axis=2)
    shortest = length.min(axis=1)
    return np.where(shortest > 0, length.max(axis=1) / np.maximum(shortest, 1e-300), np.inf)


def mesh_quality(nodes: FloatArray, elements: IntArray, element_type: str) -> QualityReport:
    """Report the quality of a mesh, checked at the quadrature points and at the nodes.

    Parameters
    ----------
    nodes
        ``(n, 3)`` mm.
    elements
        ``(m, k)`` in the node order of `mvest.elements`.
    element_type
        Name of the element.

    Raises
    ------
    InputError
        Unknown element, wrong shapes, node numbers out of range, or nothing to examine.
    """
    reference = element(element_type)
    nodes = np.asarray(nodes, dtype=np.float64)
    elements = np.asarray(elements, dtype=np.int64)
    if elements.ndim != 2 or elements.shape[1] != reference.n_nodes or len(elements) == 0:
        raise InputError(
            f"elements: shape {elements.shape}, expected (m, {reference.n_nodes}) with m > 0 for "
            f"{element_type}"
        )
    if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
        raise InputError(f"nodes: shape {nodes.shape}, expected (n, 3) finite numbers")
    if elements.min() < 0 or elements.max() >= len(nodes):
        raise InputError(
            f"elements name nodes {elements.min()} to {elements.max()}, expected 0 to "
            f"{len(nodes) - 1}"
        )
    at_points = jacobian_determinants(nodes, elements, reference, reference.points)
    at_nodes = jacobian_determinants(nodes, elements, reference, reference.node_coordinates)
    scaled = np.minimum(
        scaled_jacobians(nodes, elements, reference, reference.points),
        scaled_jacobians(nodes, elements, reference, reference.node_coordinates),
    )
    aspect = aspect_ratios(nodes, elements, reference)
    return QualityReport(
        n_nodes=len(nodes),
        n_elements=len(elements),
        volume=float((at_points @ reference.weights).sum()),
        min_scaled_jacobian=float(scaled.min()),
        mean_scaled_jacobian=float(scaled.mean()),
        min_jacobian=float(min(at_points.min(), at_nodes.min())),
        non_positive_at_points=int((at_points <= 0).any(axis=1).sum()),
        non_positive_at_nodes=int((at_nodes <= 0).any(axis=1).sum()),
        max_aspect=float(aspect.max()),
        mean_aspect=float(aspect.mean()),
        worst=tuple(int(i) for i in np.argsort(scaled)[:10]),
    )
