r"""Chordae as tension-only cables, and the elastic hinge that holds the annulus.

A cable runs from a prescribed papillary tip to a patch of the leaflet (a weighted average of
material points). With strain :math:`e = L/L_0 - 1` and toe strain :math:`e_t` its force is

.. math::
    N(e) = EA \begin{cases} 0 & e \le 0 \\
        e^3/e_t^2 - e^4/(2 e_t^3) & 0 < e < e_t \\
        e - e_t/2 & e \ge e_t \end{cases}

which is twice continuously differentiable: value, slope and curvature agree at both ends of the toe
(at :math:`e_t`: value :math:`e_t/2`, slope 1, curvature 0).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mvest.errors import InputError
from mvest.typing import BoolArray, FloatArray
from mvest.valve.mesh.solid_mesh import Embedding


def cable_force(strain: FloatArray, toe: float) -> tuple[FloatArray, FloatArray]:
    """Force over EA and its derivative by the strain, both ``(c,)``."""
    e = np.clip(strain, 0.0, toe)
    force = e**3 / toe**2 - e**4 / (2 * toe**3) + np.maximum(strain - toe, 0.0)
    slope = 3 * e**2 / toe**2 - 2 * e**3 / toe**3
    return force, np.where(strain >= toe, 1.0, slope)


class Cables:
    """All cables of a valve.

    Parameters
    ----------
    patches : Embedding
        ``(c,)`` leaflet ends.
    tip : ndarray
        ``(c,)`` index of the tip that each cable starts from.
    rest_length, axial_stiffness : ndarray
        ``(c,)`` mm and N.
    toe_strain : float
    families : dict, optional
        Name -> ``(c,)`` bool, which cables belong to it.
    """

    def __init__(
        self,
        patches: Embedding,
        tip: np.ndarray,
        rest_length: FloatArray,
        axial_stiffness: FloatArray,
        toe_strain: float,
        families: dict[str, BoolArray] | None = None,
    ) -> None:
        self.patches = patches
        self.tip = tip
        self.rest_length = rest_length
        self.axial_stiffness = axial_stiffness
        self.toe_strain = toe_strain
        tips = range(int(np.max(tip, initial=-1)) + 1)
        self.parts = {**(families or {}), **{f"tip{k}": np.asarray(tip) == k for k in tips}}

    def members(self, part: str) -> BoolArray:
        """Which cables ``(c,)`` a family or papillary tip (``tip0``, ...) has; empty: all.

        Raises
        ------
        InputError
            If there is no such part.
        """
        if not part:
            return np.ones(len(self.rest_length), dtype=np.bool_)
        if part not in self.parts:
            raise InputError(
                f"no chordae {part!r}; known families and tips: {', '.join(self.parts)}"
            )
        return self.parts[part]

    def factor(self, kind: str, values: Mapping[str, float]) -> FloatArray:
        """Factor ``(c,)`` of each cable: the product of what is called ``kind`` or ``kind.PART``.

        Parameters
        ----------
        kind : str
            ``chord_stiffness`` or ``chord_rest_length``.
        values : mapping
            Parameter -> value; others are passed over.
        """
        out = np.ones(len(self.rest_length))
        for name, value in values.items():
            own, _, part = name.partition(".")
            if own == kind:
                out[self.members(part)] *= value
        return out

    def strain(
        self, x: FloatArray, tips: FloatArray, length_factor: float | FloatArray = 1.0
    ) -> FloatArray:
        """Cable strains ``(c,)``; negative means slack."""
        span = np.linalg.norm(self.patches(x) - tips[self.tip], axis=1)
        return span / (length_factor * self.rest_length) - 1

    def forces(
        self,
        x: FloatArray,
        tips: FloatArray,
        stiffness_factor: float | FloatArray,
        length_factor: float | FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Force on the leaflet end, its stiffness, and its derivatives by its two factors.

        Returns
        -------
        internal_force : ndarray
            ``(c, 3)`` N, derivative of the cable energy by the end position.
        stiffness : ndarray
            ``(c, 3, 3)`` N/mm.
        by_stiffness_factor, by_length_factor : ndarray
            ``(c, 3)`` N.
        """
        arm = self.patches(x) - tips[self.tip]
        span = np.linalg.norm(arm, axis=1)
        n = arm / span[:, None]
        rest = length_factor * self.rest_length
        value, slope = cable_force(span / rest - 1, self.toe_strain)
        ea = stiffness_factor * self.axial_stiffness
        dyad = n[:, :, None] * n[:, None, :]
        along, across = ea * slope / rest, ea * value / span
        stiffness = along[:, None, None] * dyad + across[:, None, None] * (np.eye(3) - dyad)
        by_length = -ea * slope * span / (rest * length_factor)
        return (
            (ea * value)[:, None] * n,
            stiffness,
            (self.axial_stiffness * value)[:, None] * n,
            by_length[:, None] * n,
        )


class Hinge:
    """Elastic support of material points: ``k |x - target|^2 / 2`` per point.

    With thickness-averaged points it is a hinge (rotation about the annulus stays free); with
    points on both faces it is a clamp. The stiffness is chosen so high that the support moves by
    micrometres.

    Parameters
    ----------
    points : Embedding
        ``(h,)``.
    stiffness : ndarray
        ``(h,)`` N/mm.
    """

    def __init__(self, points: Embedding, stiffness: FloatArray) -> None:
        self.points = points
        self.stiffness = stiffness

    def forces(self, x: FloatArray, target: FloatArray) -> FloatArray:
        """Internal forces ``(h, 3)`` N at the points."""
        return self.stiffness[:, None] * (self.points(x) - target)

    @property
    def blocks(self) -> FloatArray:
        """Stiffness blocks ``(h, 3, 3)`` N/mm."""
        return self.stiffness[:, None, None] * np.eye(3)
