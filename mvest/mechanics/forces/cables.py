r"""Chordae as tension-only cables, the elastic hinge of the annulus, and ties.

A cable runs from a prescribed papillary tip to a patch of the leaflet (a weighted average of
material points). With strain :math:`e = L/L_0 - 1` and toe strain :math:`e_t` its force is

.. math::
    N(e) = EA \begin{cases} 0 & e \le 0 \\
        e^3/e_t^2 - e^4/(2 e_t^3) & 0 < e < e_t \\
        e - e_t/2 & e \ge e_t \end{cases}

which is twice continuously differentiable (at :math:`e_t`: value :math:`e_t/2`, slope 1, curvature
0).

Ties are stiff springs between pairs of material points, as in an edge-to-edge clip. A pair at
:math:`x_1, x_2` is held at the distance :math:`L` by the energy
:math:`\tfrac{k}{2} (|d| - L)^2` of :math:`d = x_1 - x_2`. With :math:`n = d/|d|`

.. math::
    f = k (|d| - L) n, \qquad
    \partial f / \partial d = k \, [n n^T + (1 - L/|d|) (I - n n^T)] .

The points can rotate about each other freely. With :math:`L = 0` the spring is linear.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mvest.errors import InputError, require_numbers
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh, embed


def cable_force(strain: FloatArray, toe: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Force over EA and its derivative by the strain, both ``(c,)``."""
    e = np.clip(strain, 0.0, toe)
    force = e**3 / toe**2 - e**4 / (2 * toe**3) + np.maximum(strain - toe, 0.0)
    slope = 3 * e**2 / toe**2 - 2 * e**3 / toe**3
    return force, np.where(strain >= toe, 1.0, slope)


@dataclass(frozen=True, slots=True, eq=False)
class Cables:
    """All cables of a valve.

    Attributes
    ----------
    patches : Embedding
        ``(c,)`` leaflet ends.
    tip : ndarray
        ``(c,)`` index of the tip that each cable starts from.
    rest_length, axial_stiffness : ndarray
        ``(c,)`` mm and N.
    toe_strain : float
    families : mapping
        Name -> ``(c,)`` bool, the cables that belong to it.
    """

    patches: Embedding
    tip: IntArray
    rest_length: FloatArray
    axial_stiffness: FloatArray
    toe_strain: float
    families: Mapping[str, BoolArray] = field(default_factory=dict)

    def members(self, part: str) -> BoolArray:
        """Cables ``(c,)`` of a family or papillary tip (``tip0``, ...); all if ``part`` is empty.

        Raises
        ------
        InputError
            If there is no such part.
        """
        if not part:
            return np.ones(len(self.rest_length), dtype=np.bool_)
        tips = range(int(np.max(self.tip, initial=-1)) + 1)
        parts = {**self.families, **{f"tip{k}": np.asarray(self.tip) == k for k in tips}}
        if part not in parts:
            raise InputError(f"no chordae {part!r}; known families and tips: {', '.join(parts)}")
        return parts[part]

    def factor(self, kind: str, values: Mapping[str, float]) -> FloatArray:
        """Factor ``(c,)`` of each cable: the product of the values of ``kind`` and ``kind.PART``.

        ``kind`` is ``chord_stiffness`` or ``chord_rest_length``; other parameters are ignored.
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
        """Force on the leaflet end, its stiffness, and its derivatives by both factors.

        Returns
        -------
        internal_force : ndarray
            ``(c, 3)`` N, derivative of the cable energy by the end position.
        stiffness : (c, 3, 3) N/mm
        by_stiffness_factor, by_length_factor : (c, 3) N
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


@dataclass(frozen=True, slots=True, eq=False)
class Hinge:
    """Elastic support of material points: ``k |x - target|^2 / 2`` per point.

    Thickness-averaged points make a hinge (rotation about the annulus is free), points on both
    faces a clamp. The stiffness is so high that the support moves by micrometres only.
    """

    points: Embedding  #: ``(h,)``
    stiffness: FloatArray  #: (h,) N/mm

    def forces(self, x: FloatArray, target: FloatArray) -> FloatArray:
        """Internal forces ``(h, 3)`` N at the points."""
        return self.stiffness[:, None] * (self.points(x) - target)

    @property
    def blocks(self) -> FloatArray:
        """Stiffness blocks ``(h, 3, 3)`` N/mm."""
        return self.stiffness[:, None, None] * np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class TiedPoints:
    """Pairs of tied material points, independent of the mesh.

    Attributes
    ----------
    first, second : ndarray
        ``(k, 3)`` mm, in the reference frame.
    length : float
        mm, distance of each pair in the closed valve.
    stiffness : float
        N/mm of each pair.
    """

    first: FloatArray
    second: FloatArray
    length: float
    stiffness: float

    def __post_init__(self) -> None:
        if self.first.shape != self.second.shape or self.first.shape[1:] != (3,):
            raise InputError(
                f"tied points of shapes {self.first.shape} and {self.second.shape}, expected "
                "(k, 3) twice"
            )
        require_numbers(self, "ties", "length", "stiffness")

    def within(self, mesh: SolidMesh) -> Ties:
        """The same as springs between points of a mesh."""
        first, second = embed(mesh, self.first), embed(mesh, self.second)
        spans = Embedding(
            np.concatenate([first.nodes, second.nodes], axis=1),
            np.concatenate([first.weights, -second.weights], axis=1),
            np.full(len(first), -1, dtype=np.int64),
        )
        return Ties(spans, self.stiffness, self.length)


@dataclass(frozen=True, slots=True, eq=False)
class Ties:
    """Springs between pairs of material points."""

    #: ``(k,)`` vectors from the second point of each pair to the first; the weights of a row sum to
    #: zero
    spans: Embedding
    stiffness: float  #: N/mm of each pair
    #: mm, force-free length in the closed valve; the loads hold the current one
    closed_length: float = 0.0

    def lengths(self, x: FloatArray) -> FloatArray:
        """Distances ``(k,)`` mm of the tied points at nodal positions ``x (n, 3)``."""
        return np.asarray(np.linalg.norm(self.spans(x), axis=1))

    def forces(self, x: FloatArray, length: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Internal force on the first point of each pair, and its derivative by the span.

        Parameters
        ----------
        x : (n, 3) mm
        length : ndarray
            ``(k,)`` mm, force-free lengths.

        Returns
        -------
        force : ndarray
            ``(k, 3)`` N; the second point gets the opposite.
        stiffness : (k, 3, 3) N/mm
        """
        d = self.spans(x)
        span = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
        n = d / span[:, None]
        dyad = n[:, :, None] * n[:, None, :]
        across = (1 - length / span)[:, None, None]
        return (
            (self.stiffness * (span - length))[:, None] * n,
            self.stiffness * (dyad + across * (np.eye(3) - dyad)),
        )
