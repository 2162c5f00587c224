"""The solid mesh of a valve: nodes, elements, what tissue each is, and where the pressure acts."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

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

    Attributes
    ----------
    nodes : ndarray
        ``(n, 3)`` mm.
    elements : ndarray
        ``(m, k)`` in the node order of :mod:`mvest.elements`.
    element_type : str
        Name of the element.
    region : ndarray
        ``(m,)`` index into ``region_names``.
    region_names : tuple of str
    fibre : ndarray
        ``(m, k, 3)`` unit collagen directions at the nodes of each element, so that the direction
        may jump between leaflets. ``(n, 3)``, one direction per node, is accepted and expanded.
    pressure_faces : ndarray
        ``(f, kf)`` nodes of the ventricular faces, normals pointing out of the solid.

    Raises
    ------
    InputError, GeometryError
        On wrong shapes, values that are not finite, unused nodes, fibres without direction, or an
        element whose Jacobian determinant is not positive at a quadrature point.
    """

    nodes: FloatArray
    elements: IntArray
    element_type: str
    region: IntArray
    region_names: tuple[str, ...]
    fibre: FloatArray
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
