r"""The law that is linear in the strain it is given, and the corotational tetrahedron.

The usual corotational tetrahedron, which the paper's simulation has, is linear in a turned frame.
The force of an element at positions x is that of linear elasticity in a frame that turns with it,

.. math:: f = R K (R^T x - X), \qquad K = V B^T C B,

with the element's own R: of the matrix of its edges from its first node, :math:`A = (x_1 - x_0, x_2
- x_0, x_3 - x_0)`, the polar factor at x times the inverse of that at X. (It is the "polar" form of
SOFA's tetrahedra; R is not the polar factor of the deformation gradient.) The tangent is taken at
fixed R: :math:`R K R^T`. Neither is exact for a law with an energy; :mod:`mvest.mechanics.law.biot`
is what replaces it here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law import Points
from mvest.mechanics.law.moduli import LeafletModuli, TransverselyIsotropic
from mvest.mechanics.parameters import Parameter
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh


@dataclass(frozen=True, slots=True, eq=False)
class LinearLaw:
    """Stress ``C : (e + rate (e - e_n))`` of the strain e that it is given.

    Of the Green-Lagrange strain it is St. Venant's law, FEBio's ``orthotropic elastic``. Of the
    linear strain in the turned frame of the element (`mvest.mechanics.law.linear`) the second
    Piola-Kirchhoff stress is the stress in that frame.

    Attributes
    ----------
    stiffness : ndarray
        ``(n_regions, 6, 6)`` MPa.
    moduli : tuple of LeafletModuli
        What the stiffness was made of, one per region; empty where it is only known itself, and
        there is nothing to differentiate by.
    corotational : bool
        Whether the strain is the linear one in the turned frame.
    """

    stiffness: FloatArray
    moduli: tuple[LeafletModuli, ...] = ()
    corotational: bool = False

    @classmethod
    def of(cls, materials: Sequence[TransverselyIsotropic]) -> LinearLaw:
        """The law with one material per region."""
        return cls(np.array([m.stiffness for m in materials]))

    @classmethod
    def of_moduli(cls, moduli: Sequence[LeafletModuli], *, corotational: bool) -> LinearLaw:
        """The law with the moduli of each region; MaterialError if some are inadmissible."""
        law = cls.of([m.material for m in moduli])
        return cls(law.stiffness, tuple(moduli), corotational)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The parameters that the law knows."""
        return ("E_f", "ratio", "G") if self.moduli else ()

    def strain(self, green: FloatArray) -> FloatArray:
        """The strain itself."""
        return green

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        stiffness = self.stiffness[at.region]
        tangent = np.repeat((1 + at.rate) * stiffness[:, None], at.green.shape[1], axis=1)
        return _stress(stiffness, at), tangent

    def partial_stress(
        self, parameter: Parameter, at: Points, *, which: int, stress: FloatArray
    ) -> FloatArray:
        """Derivative of the stress by a parameter of region ``which``; InputError if of no use."""
        parameter.require(self.kinds)
        by = np.zeros_like(self.stiffness)
        by[which] = self.moduli[which].stiffness_by(parameter.kind)
        return _stress(by[at.region], at)

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of the stress for a change of the previous strain: ``-rate C d``."""
        return -at.rate * np.einsum("eij,eqj->eqi", self.stiffness[at.region], d_previous)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """The change of the strain itself."""
        return d_green


def _stress(stiffness: FloatArray, at: Points) -> FloatArray:
    """Stress ``(e, q, 6)`` of stiffnesses ``(e, 6, 6)``, damping included."""
    strain = (1 + at.rate) * at.green - at.rate * at.previous
    return np.einsum("eij,eqj->eqi", stiffness, strain)


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
