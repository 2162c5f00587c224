"""Material laws: the interface that the solid needs, and the laws of leaflet tissue.

Arrays of points have the axes (element, quadrature point, component). Strain (with engineering
shear) and second Piola-Kirchhoff stress (MPa) are six-vectors 11, 22, 33, 23, 13, 12 in the fibre
frame.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from mvest.mechanics.parameters import Parameter
from mvest.typing import FloatArray, IntArray


class Points(NamedTuple):
    """State at the quadrature points of some elements."""

    green: FloatArray  #: ``(e, q, 6)`` Green-Lagrange strain
    region: IntArray  #: ``(e,)`` regions, counted from 0
    previous: FloatArray  #: ``(e, q, 6)`` strain measure of the law at the start of the step
    rate: float  #: stiffness-proportional damping over the step, ``beta / dt``; 0 in an equilibrium


@runtime_checkable
class Law(Protocol):
    """Interface of a material law (see :class:`mvest.mechanics.law.biot.BiotLaw`)."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its parameters (:data:`mvest.mechanics.parameters.KINDS`)."""

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measure ``(e, q, 6)`` whose rate is damped."""

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measure for a change of the Green-Lagrange strain."""

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)``, its derivative by ``green``, MPa."""

    def partial_stress(
        self, parameter: Parameter, at: Points, *, which: int, stress: FloatArray
    ) -> FloatArray:
        """Derivative of the stress ``(e, q, 6)`` by a parameter of region ``which``.

        At fixed strain; ``stress`` is that of `response` at the same points. InputError if the
        parameter is none of `kinds`.
        """

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of the stress for a change of the previous strain measure."""
