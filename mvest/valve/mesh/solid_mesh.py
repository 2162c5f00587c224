"""The solid mesh of a valve: nodes, elements, regions, fibres and pressure faces.

Material points can be embedded in it. What must not depend on the mesh (observation vertices,
contact samples, chord patches, the hinge) is given as points of the reference frame. Each gets a
host element and shape-function weights, so that its position is ``weights @ nodal positions`` in
any state.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numba as nb
import numpy as np
from scipy.spatial import cKDTree

from mvest.elements import FACES, Element, element
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import checked_floats, checked_indices


def jacobian_determinants(
    nodes: FloatArray, elements: IntArray, reference: Element, points: FloatArray
) -> FloatArray:
    """Determinants ``(m, q)``, mm^3, of the map from the reference element at ``points (q, 3)``."""
    gradient = reference.gradient(points)
    jacobian = np.einsum("mai,qaj->mqij", nodes[elements], gradient)
    return np.linalg.det(jacobian)


@dataclass(frozen=True, slots=True, eq=False)
class SolidMesh:
    """A solid finite-element mesh of the leaflets.

    InputError or GeometryError for wrong shapes, values that are not finite, unused nodes, fibres
    without direction, or elements whose Jacobian determinant is not positive at a quadrature point.
    """

    nodes: FloatArray  #: (n, 3) mm
    elements: IntArray  #: ``(m, k)`` in the node order of :mod:`mvest.elements`
    element_type: str  #: name of the element
    region: IntArray  #: ``(m,)`` index into ``region_names``
    region_names: tuple[str, ...]
    #: ``(m, k, 3)`` unit collagen directions at the nodes of each element: directions may jump
    #: between leaflets. ``(n, 3)``, one direction per node, is accepted and expanded.
    fibre: FloatArray
    #: ``(f, kf)`` nodes of the ventricular faces, normals pointing out of the solid
    pressure_faces: IntArray

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        reference = element(self.element_type)
        set_(self, "nodes", checked_floats("mesh nodes", self.nodes, (None, 3)))
        n = len(self.nodes)
        set_(
            self,
            "elements",
            checked_indices("elements", self.elements, n, (None, reference.n_nodes)),
        )
        m = len(self.elements)
        if m == 0:
            raise InputError("the mesh has no elements")
        n_regions = len(self.region_names)
        set_(self, "region", checked_indices("element region", self.region, n_regions, (m,)))
        fibre = np.asarray(self.fibre, dtype=np.float64)
        if fibre.shape == (n, 3):
            fibre = fibre[self.elements]
        set_(self, "fibre", checked_floats("mesh fibre", fibre, (m, reference.n_nodes, 3)))
        blank = np.argwhere(np.linalg.norm(self.fibre, axis=2) < 1e-8)
        if blank.size:
            e, a = blank[0]
            raise GeometryError(f"fibre at node {a} of element {e} has no direction")
        face_nodes = FACES[reference.face].n_nodes
        faces = checked_indices("pressure_faces", self.pressure_faces, n, (None, face_nodes))
        set_(self, "pressure_faces", faces)
        used = np.zeros(n, dtype=bool)
        used[self.elements] = True
        if not used.all():
            raise GeometryError(f"node {int(np.argmin(used))} belongs to no element")
        j = jacobian_determinants(self.nodes, self.elements, reference, reference.points)
        if np.any(j <= 0):
            worst = int(np.argmin(j.min(axis=1)))
            raise GeometryError(
                f"{int(np.sum((j <= 0).any(axis=1)))} inverted elements; the worst is element "
                f"{worst} with Jacobian determinant {j[worst].min():.3g} mm^3, expected > 0"
            )

    @property
    def reference(self) -> Element:
        """The reference element."""
        return element(self.element_type)

    @property
    def sha256(self) -> str:
        """Content hash over nodes (rounded to 1e-9 mm), elements, labels, fibres and faces."""
        digest = hashlib.sha256(self.element_type.encode())
        digest.update("|".join(self.region_names).encode())
        for array in (np.round(self.nodes, 9) + 0.0, np.round(self.fibre, 9) + 0.0):
            digest.update(np.ascontiguousarray(array).tobytes())
        for index in (self.elements, self.region, self.pressure_faces):
            digest.update(np.ascontiguousarray(index).tobytes())
        return digest.hexdigest()


LAST_STEP = 1e-9
"""In reference coordinates; the Newton step after one this small is round-off."""


@dataclass(frozen=True, slots=True, eq=False)
class Embedding:
    """Points as weighted sums of nodes."""

    nodes: IntArray  #: ``(k, w)`` node indices; entries with weight zero are padding
    weights: FloatArray  #: ``(k, w)``, each row sums to one
    host: IntArray  #: ``(k,)`` host element, or -1 for averages over several elements

    def __len__(self) -> int:
        return len(self.nodes)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Positions ``(k, ...)`` of the points where the nodes are at ``x (n, ...)``."""
        values = np.ascontiguousarray(x, dtype=np.float64)
        flat = _weighted_sums(self.nodes, self.weights, values.reshape(len(values), -1))
        return flat.reshape(len(self.nodes), *values.shape[1:])

    def take(self, rows: IntArray) -> Embedding:
        """Some of the points, in this order."""
        return Embedding(self.nodes[rows], self.weights[rows], self.host[rows])

    def average(self, coefficients: FloatArray, groups: IntArray) -> Embedding:
        """Weighted averages of the points.

        Parameters
        ----------
        coefficients : ndarray
            ``(g, s)`` weights of the members, rows summing to one.
        groups : ndarray
            ``(g, s)`` members of each average; padding has coefficient zero.
        """
        rows = []
        for members, factor in zip(groups, coefficients, strict=True):
            keep = factor != 0
            index = self.nodes[members[keep]].ravel()
            value = (factor[keep, None] * self.weights[members[keep]]).ravel()
            unique, inverse = np.unique(index, return_inverse=True)
            total = np.bincount(inverse, value, minlength=len(unique))
            rows.append((unique[np.abs(total) > 1e-14], total[np.abs(total) > 1e-14]))
        width = max((len(r[0]) for r in rows), default=1)
        nodes = np.zeros((len(rows), width), dtype=np.int64)
        weights = np.zeros((len(rows), width))
        for k, (index, value) in enumerate(rows):
            nodes[k, : len(index)] = index
            nodes[k, len(index) :] = index[0]
            weights[k, : len(index)] = value
        return Embedding(nodes, weights, np.full(len(rows), -1, dtype=np.int64))


@nb.njit(cache=True)
def _weighted_sums(nodes: IntArray, weights: FloatArray, values: FloatArray) -> FloatArray:
    """Rows ``(k, c)`` of ``weights (k, w)`` with the rows of ``values (n, c)`` at ``nodes``."""
    out = np.zeros((nodes.shape[0], values.shape[1]))
    for k in range(nodes.shape[0]):
        for w in range(nodes.shape[1]):
            for c in range(values.shape[1]):
                out[k, c] += weights[k, w] * values[nodes[k, w], c]
    return out


def embed(
    mesh: SolidMesh, points: FloatArray, *, tolerance: float = 1.0, candidates: int = 12
) -> Embedding:
    """Embed points ``(k, 3)`` mm of the reference frame in ``mesh``.

    The map of the nearest ``candidates`` elements is inverted by Newton's method; the host is the
    element whose bounds the point violates least. Points slightly outside the mesh (a coarse mesh
    cuts corners of a curved surface) are extrapolated from their nearest element.

    InputError if ``points`` is not ``(k, 3)`` finite. GeometryError if a point is farther from the
    mesh than ``tolerance`` mm.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"points to embed: shape {points.shape}, expected finite (k, 3)")
    reference = mesh.reference
    centre = np.einsum("a,mai->mi", reference.shape(reference.centre)[0], mesh.nodes[mesh.elements])
    n_try = min(candidates, len(mesh.elements))
    _, near = cKDTree(centre).query(points, k=n_try)
    near = near.reshape(len(points), n_try)
    best = np.full(len(points), np.inf)
    host = np.zeros(len(points), dtype=np.int64)
    local = np.zeros((len(points), 3))
    for c in range(n_try):
        todo = np.flatnonzero(best > 1e-9)
        if todo.size == 0:
            break
        e = near[todo, c]
        xi, error = _invert(mesh, e, points[todo])
        violation = np.where(error < 1e-8, reference.outside(xi), np.inf)
        better = violation < best[todo] - 1e-12
        at = todo[better]
        best[at], host[at], local[at] = violation[better], e[better], xi[better]
    size = np.linalg.norm(np.ptp(mesh.nodes[mesh.elements[host]], axis=1), axis=1)
    distance = np.maximum(best, 0.0) * size / 2
    far = np.flatnonzero(np.isfinite(distance) & (distance > tolerance))
    for c in range(n_try if far.size else 0):
        # Elements are thin: a violation across a face is a shorter distance than one along it.
        e = near[far, c]
        xi, error = _invert(mesh, e, points[far])
        at = np.einsum(
            "ka,kai->ki", reference.shape(reference.inside(xi)), mesh.nodes[mesh.elements[e]]
        )
        away = np.where(error < 1e-8, np.linalg.norm(points[far] - at, axis=1), np.inf)
        better = away < distance[far]
        nearer = far[better]
        distance[nearer], host[nearer], local[nearer] = away[better], e[better], xi[better]
    if not np.all(distance <= tolerance):
        i = int(np.argmax(distance))
        raise GeometryError(
            f"point {i} at {np.round(points[i], 3)} mm is outside the mesh "
            f"(about {distance[i]:.2g} mm from its nearest element, tolerance {tolerance} mm)"
        )
    return Embedding(mesh.elements[host], reference.shape(local), host)


def _invert(
    mesh: SolidMesh, e: IntArray, points: FloatArray, iterations: int = 15
) -> tuple[FloatArray, FloatArray]:
    """Reference coordinates ``(k, 3)`` of points in elements ``e`` and the residual distance."""
    reference = mesh.reference
    x_e = mesh.nodes[mesh.elements[e]]
    xi = np.repeat(reference.centre, len(e), axis=0)
    left = np.arange(len(e))
    for _ in range(iterations):
        at, nodes = xi[left], x_e[left]
        gap = points[left] - np.einsum("ka,kai->ki", reference.shape(at), nodes)
        jacobian = np.einsum("kai,kaj->kij", nodes, reference.gradient(at))
        regular = np.abs(np.linalg.det(jacobian)) > 1e-12
        jacobian[~regular] = np.eye(3)
        step = np.linalg.solve(jacobian, gap[:, :, None])[:, :, 0]
        xi[left] = np.clip(at + np.clip(step, -1.0, 1.0), -3.0, 3.0)
        left = left[np.abs(step).max(axis=1) > LAST_STEP]
        if not left.size:
            break
    gap = points - np.einsum("ka,kai->ki", reference.shape(xi), x_e)
    return xi, np.linalg.norm(gap, axis=1)
