r"""Chordae as tension-only cables, the elastic hinge of the annulus, and ties.

A cable runs from a prescribed papillary tip to a patch of the leaflet (a weighted average of
material points). With strain :math:`e = L/L_0 - 1` and toe strain :math:`e_t` its force is

.. math::
    N(e) = EA \begin{cases} 0 & e \le 0 \\
        e^3/e_t^2 - e^4/(2 e_t^3) & 0 < e < e_t \\
        e - e_t/2 & e \ge e_t \end{cases}

which is twice continuously differentiable (at :math:`e_t`: value :math:`e_t/2`, slope 1, curvature
0). Cables may branch; their junctions are in equilibrium (`mvest.mechanics.forces.trees`).

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
from typing import NamedTuple

import numpy as np

from mvest.errors import InputError, require_numbers
from mvest.mechanics.forces.trees import SUPPORT, Trees
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh, embed


def cable_force(strain: FloatArray, toe: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Force over EA and its derivative by the strain, both ``(c,)``."""
    e = np.clip(strain, 0.0, toe)
    force = e**3 / toe**2 - e**4 / (2 * toe**3) + np.maximum(strain - toe, 0.0)
    slope = 3 * e**2 / toe**2 - 2 * e**3 / toe**3
    return force, np.where(strain >= toe, 1.0, slope)


class CableState(NamedTuple):
    """Segments of all cables under load."""

    end: FloatArray  #: ``(k, 3)`` mm, leaflet ends and junctions
    strain: FloatArray  #: ``(k,)``, negative if slack
    tension: FloatArray  #: (k,) N
    direction: FloatArray  #: ``(k, 3)``, unit vectors from start to end
    stiffness: FloatArray  #: ``(k, 3, 3)`` N/mm, derivative of the force by the end
    by_stiffness: FloatArray  #: ``(k,)`` N, derivative of the tension by the stiffness factor
    by_length: FloatArray  #: ``(k,)`` N, derivative of the tension by the factor on rest lengths


@dataclass(frozen=True, slots=True, eq=False)
class Cables:
    """All cables of a valve: the segments of `mvest.valve.anatomy.valve.Chordae`."""

    patches: Embedding  #: ``(c,)`` leaflet ends
    tip: IntArray  #: ``(k,)`` index of the tip at each segment's root
    #: ``(k,)`` mm and N
    rest_length: FloatArray
    axial_stiffness: FloatArray
    toe_strain: float
    #: name -> ``(k,)`` bool, the segments that belong to it
    families: Mapping[str, BoolArray] = field(default_factory=dict)
    #: ``(k,)`` junction at which each segment starts, or -1; by default all start at tips
    parent: IntArray | None = None
    #: ``(j, 3)`` mm, from the tip to where a junction hangs while its tree is slack
    place: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    trees: Trees = field(init=False)

    def __post_init__(self) -> None:
        parent = np.full(len(self.tip), -1) if self.parent is None else self.parent
        trees = Trees.of(parent, self.rest_length, len(self.patches))
        object.__setattr__(self, "trees", trees)

    def members(self, part: str) -> BoolArray:
        """Segments ``(k,)`` of a family or papillary tip (``tip0``, ...); all if ``part`` is empty.

        InputError if there is no such part.
        """
        if not part:
            return np.ones(len(self.rest_length), dtype=np.bool_)
        tips = range(int(np.max(self.tip, initial=-1)) + 1)
        parts = {**self.families, **{f"tip{k}": np.asarray(self.tip) == k for k in tips}}
        if part not in parts:
            raise InputError(f"no chordae {part!r}; known families and tips: {', '.join(parts)}")
        return parts[part]

    def factor(self, kind: str, values: Mapping[str, float]) -> FloatArray:
        """Factor ``(k,)`` of each segment: product of the values of ``kind`` and ``kind.PART``.

        ``kind`` is ``chord_stiffness`` or ``chord_rest_length``; other parameters are ignored.
        """
        out = np.ones(len(self.rest_length))
        for name, value in values.items():
            own, _, part = name.partition(".")
            if own == kind:
                out[self.members(part)] *= value
        return out

    def state(
        self,
        x: FloatArray,
        tips: FloatArray,
        stiffness_factor: float | FloatArray = 1.0,
        length_factor: float | FloatArray = 1.0,
    ) -> CableState:
        """Strain, tension and ends of every segment at nodal positions ``x (n, 3)`` mm.

        Parameters
        ----------
        tips : (t, 3) mm
        stiffness_factor, length_factor : float or (k,)
        """
        at = tips[self.tip]
        rest = length_factor * self.rest_length
        ea = stiffness_factor * self.axial_stiffness
        end = self.patches(x)
        if len(self.place):
            place = at[len(end) :] + self.place
            inner = self.trees.junctions(end, at, place, rest, ea, self.toe_strain)
            end = np.concatenate([end, inner])
        arm = end - self.trees.start(end, at)
        span = np.linalg.norm(arm, axis=1)
        n = arm / span[:, None]
        strain = span / rest - 1
        value, slope = cable_force(strain, self.toe_strain)
        dyad = n[:, :, None] * n[:, None, :]
        along, across = ea * slope / rest, ea * value / span
        stiffness = along[:, None, None] * dyad + across[:, None, None] * (np.eye(3) - dyad)
        by_length = -ea * slope * span / (rest * length_factor)
        own = self.axial_stiffness * value
        return CableState(end, strain, ea * value, n, stiffness, own, by_length)

    def forces(
        self, x: FloatArray, tips: FloatArray, *factors: float | FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Forces on the leaflet ends, and their stiffness; the arguments are those of `state`.

        Returns
        -------
        internal_force : ndarray
            ``(c, 3)`` N, derivative of the cable energy by the end positions.
        stiffness : ndarray
            ``(p, 3, 3)`` N/mm, derivatives for the pairs of ends ``trees.pairs``, the junctions
            being in equilibrium.
        """
        state = self.state(x, tips, *factors)
        c, own = len(self.patches), state.stiffness
        force = state.tension[:c, None] * state.direction[:c]
        if not len(self.place):
            return force, own
        # The Hessian by the ends less what the junctions give way: K - K H^-1 K.
        pairs = self.trees.pairs
        at = self.trees.parent[pairs]
        freed = self.trees.compliance(own)[at[:, 0], at[:, 1]]
        freed[np.any(at < 0, axis=1)] = 0.0
        blocks = -(own[pairs[:, 0]] @ freed @ own[pairs[:, 1]])
        blocks[:c] += own[:c]
        return force, blocks

    def change(
        self,
        state: CableState,
        *,
        ends: FloatArray | float = 0.0,
        tips: FloatArray | None = None,
        stiffness: FloatArray | float = 0.0,
        length: FloatArray | float = 0.0,
    ) -> FloatArray:
        """First-order change ``(c, 3)`` N of the forces on the leaflet ends.

        Parameters
        ----------
        ends, tips : (c, 3) and (t, 3) mm
            Displacements of leaflet ends and papillary tips.
        stiffness, length : (k,)
            Changes of the factors on stiffness and rest length.
        """
        c, trees, own = len(self.patches), self.trees, state.stiffness
        at = np.zeros_like(state.end) if tips is None else tips[self.tip]
        end = np.zeros_like(state.end)
        end[:c] += ends
        tension = stiffness * state.by_stiffness + length * state.by_length
        force = tension[:, None] * state.direction
        force += np.einsum("kij,kj->ki", own, end - trees.start(end, at))
        if len(self.place):
            off = trees.net(force) - SUPPORT * at[c:]
            end[:c] = 0.0
            end[c:] = -np.einsum("abij,bj->ai", trees.compliance(own), off)
            force += np.einsum("kij,kj->ki", own, end - trees.start(end, np.zeros_like(end)))
        return force[:c]


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
    """Pairs of tied material points, independent of the mesh."""

    #: ``(k, 3)`` mm, in the reference frame
    first: FloatArray
    second: FloatArray
    length: float  #: mm, distance of each pair in the closed valve
    stiffness: float  #: N/mm of each pair

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
