r"""The usual corotational tetrahedron, which the paper's simulation has: linear, in a turned frame.

The force of an element at positions x is that of linear elasticity in a frame that turns with it,

.. math:: f = R K (R^T x - X), \qquad K = V B^T C B,

with the element's own R: of the matrix of its edges from its first node, :math:`A = (x_1 - x_0, x_2
- x_0, x_3 - x_0)`, the polar factor at x times the inverse of that at X. (It is the "polar" form of
SOFA's tetrahedra; R is not the polar factor of the deformation gradient.) The tangent is taken at
fixed R: :math:`R K R^T`. Neither is exact for a law with an energy; :mod:`mvest.mechanics.law.biot`
is what replaces it here.
"""

from __future__ import annotations

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh


class EdgeRotations:
    """Frames of linear tetrahedra that turn with their edges.

    Parameters
    ----------
    mesh : SolidMesh
    frames : ndarray
        ``(e, 1, 3, 3)`` fibre frames, columns as in :mod:`mvest.mechanics.solid`.

    Raises
    ------
    InputError
        If the elements are not linear tetrahedra.
    """

    def __init__(self, mesh: SolidMesh, frames: FloatArray) -> None:
        if mesh.element_type != "tet4":
            raise InputError(
                f"the corotational law is that of linear tetrahedra (tet4), not {mesh.element_type}"
            )
        self._elements = mesh.elements
        self._start = _polar(self._edges(mesh.nodes))
        self._frames = frames

    def _edges(self, x: FloatArray) -> FloatArray:
        corners = x[self._elements]
        return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)

    def __call__(self, x: FloatArray, deformation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Linear strain ``(e, 1, 6)`` in the turned frames, and these ``(e, 1, 3, 3)``.

        Parameters
        ----------
        x : ndarray
            ``(n, 3)`` mm.
        deformation : ndarray
            ``(e, 1, 3, 3)`` F in the fibre frame.
        """
        rotation = _polar(self._edges(x)) @ np.swapaxes(self._start, 1, 2)
        frames = rotation[:, None] @ self._frames
        h = np.swapaxes(frames, 2, 3) @ deformation - np.eye(3)
        normal = [h[..., i, i] for i in range(3)]
        shear = [h[..., i, j] + h[..., j, i] for i, j in ((1, 2), (0, 2), (0, 1))]
        return np.stack(normal + shear, axis=-1), np.ascontiguousarray(frames)


def _polar(a: FloatArray) -> FloatArray:
    """The rotation ``(e, 3, 3)`` that is nearest to each matrix, also where one is inverted."""
    u, _, v = np.linalg.svd(a)
    u[..., 2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))[:, None]
    return u @ v
