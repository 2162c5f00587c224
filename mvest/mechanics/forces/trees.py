r"""Branching chordae: the positions of their junctions, given papillary tips and leaflet ends.

The junctions y have no mass, so they minimise the energy of their tree at every instant,

.. math:: V(y) = \sum_s U_s(|b_s - a_s|) + \tfrac{k}{2} \sum_j |y_j - t_j - d_j|^2 ,

where segment s runs from :math:`a_s` to :math:`b_s`, which are junctions, tips or leaflet ends.
Distance is convex, and the energy of a tension-only cable is convex and does not decrease with it.
So V is convex, and strictly so by the spring of stiffness k (:data:`SUPPORT`): slack trees have one
answer too. The spring pulls a junction to the place :math:`t + d` that moves with the tip t alone,
so it exerts no force on the leaflets directly. The forces at the leaflet ends of a tree, the tip
and the springs are in balance; the springs' share is k times the distance of each junction from its
place, 1.5e-4 N at 15 mm, where taut chordae carry about 0.5 N.

Newton's method with a line search starts from a place that depends on tips and ends only, so the
same positions give the same forces to the last bit. A tree's Hessian is eliminated from the
leaflets to the tip, one 3 x 3 block per junction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import leverage, paths

SUPPORT = 1e-5
"""Stiffness (N/mm) of the spring at each junction. Along a chord the stiffness is about 1 N/mm."""
NEAR_MM = 1e-5
"""Newton steps shorter than this are taken in full."""
LAST_MM = 1e-8
"""A Newton step shorter than this is the last one: the error falls as its square."""
MAX_ITERATIONS = 300


@dataclass(frozen=True, slots=True, eq=False)
class Trees:
    """How c leaflet ends and j junctions hang together; see `mvest.valve.anatomy.valve.Chordae`."""

    parent: IntArray  #: ``(k,)`` junction at which each segment starts, -1 at a tip
    order: IntArray  #: segments of the branching trees, one tree after another, from the tip on
    first: IntArray  #: ``(trees + 1,)`` where each tree begins in ``order``
    weights: FloatArray  #: ``(j, c)``, weights of the leaflet ends in the start of each junction
    #: ``(p, 2)`` leaflet ends with a block of the stiffness: each with itself, then each with the
    #: others of its tree
    pairs: IntArray

    @classmethod
    def of(cls, parent: IntArray, rest_length: FloatArray, c: int) -> Trees:
        """Trees with c leaflet ends from ``parent`` and ``rest_length (k,)`` mm."""
        on = paths(parent, c)
        root = np.array([int(np.flatnonzero(row & (parent < 0))[0]) for row in on], dtype=np.int64)
        order = np.lexsort((on.sum(axis=1), root))
        order = order[root[order] >= c]
        _, first = np.unique(root[order], return_index=True)
        alike = (root[:c, None] == root[None, :c]) & ~np.eye(c, dtype=np.bool_)
        own = np.repeat(np.arange(c), 2).reshape(-1, 2)
        return cls(
            parent,
            order,
            np.append(first, len(order)),
            leverage(parent, rest_length, c),
            np.concatenate([own, np.argwhere(alike)]),
        )

    def start(self, points: FloatArray, tips: FloatArray) -> FloatArray:
        """Values ``(k, ...)`` at the starts of the segments, from those at their ends and tips."""
        branches = self.parent >= 0
        out = np.array(np.broadcast_to(tips, points.shape))
        out[branches] = points[len(points) - len(self.weights) + self.parent[branches]]
        return out

    def net(self, pull: FloatArray) -> FloatArray:
        """Sums ``(j, ...)`` at the junctions: ``pull (k, ...)`` at ends minus that at starts."""
        out = np.array(pull[len(pull) - len(self.weights) :])
        branches = self.parent >= 0
        np.subtract.at(out, self.parent[branches], pull[branches])
        return out

    def junctions(
        self,
        ends: FloatArray,
        tips: FloatArray,
        place: FloatArray,
        rest: FloatArray,
        stiffness: FloatArray,
        toe: float,
    ) -> FloatArray:
        """Positions ``(j, 3)`` mm of the junctions; NaN in a tree whose search does not converge.

        Parameters
        ----------
        ends, tips : (c, 3) and (k, 3) mm
            Leaflet ends, and the papillary tip of each segment.
        place : (j, 3) mm
            Where the springs pull the junctions to.
        rest, stiffness : (k,) mm and N
        toe : float
            Toe strain.
        """
        c = len(ends)
        start = (1 - self.weights.sum(axis=1, keepdims=True)) * tips[c:] + self.weights @ ends
        tree = self.order, self.first, self.parent
        return _hang(start, *tree, ends, tips, place, rest, stiffness, toe)

    def compliance(self, stiffness: FloatArray) -> FloatArray:
        """Inverse ``(j, j, 3, 3)`` mm/N of the Hessian by the junctions.

        ``stiffness (k, 3, 3)`` N/mm are the derivatives of the segments' forces by their ends.
        """
        j, c = len(self.weights), len(stiffness) - len(self.weights)
        hessian = np.zeros((j, j, 3, 3))
        own = np.arange(j)
        hessian[own, own] = stiffness[c:] + SUPPORT * np.eye(3)
        branches = np.flatnonzero(self.parent >= 0)
        at = self.parent[branches]
        np.add.at(hessian, (at, at), stiffness[branches])
        inner = branches >= c
        hessian[at[inner], branches[inner] - c] -= stiffness[branches[inner]]
        hessian[branches[inner] - c, at[inner]] -= stiffness[branches[inner]]
        inverse = np.linalg.inv(hessian.transpose(0, 2, 1, 3).reshape(3 * j, 3 * j))
        return np.asarray(inverse.reshape(j, 3, j, 3).transpose(0, 2, 1, 3))


@nb.njit(cache=True)
def _pulled(
    segments: IntArray,
    parent: IntArray,
    y: FloatArray,
    ends: FloatArray,
    tips: FloatArray,
    place: FloatArray,
    rest: FloatArray,
    stiffness: FloatArray,
    toe: float,
    gradient: FloatArray,
    diagonal: FloatArray,
    link: FloatArray,
) -> float:
    """Energy of a tree, with its gradient and the blocks of its Hessian.

    ``diagonal (j, 3, 3)`` has the blocks of the junctions; ``link (j, 3, 3)`` has the stiffness of
    the segments that end there, whose negative couples a junction with its parent.
    """
    c = len(ends)
    energy = 0.0
    for s in segments:
        if s >= c:
            i = s - c
            for a in range(3):
                off = y[i, a] - place[i, a]
                energy += 0.5 * SUPPORT * off * off
                gradient[i, a] = SUPPORT * off
                for b in range(3):
                    diagonal[i, a, b] = SUPPORT if a == b else 0.0
                    link[i, a, b] = 0.0
    for s in segments:
        p = parent[s]
        end = ends[s] if s < c else y[s - c]
        arm = end - (tips[s] if p < 0 else y[p])
        span = np.sqrt(arm[0] * arm[0] + arm[1] * arm[1] + arm[2] * arm[2])
        e = span / rest[s] - 1.0
        if e <= 0.0:
            continue
        # The law of `mvest.mechanics.forces.cables`, and its integral by the length.
        if e < toe:
            value = e**3 / toe**2 - e**4 / (2 * toe**3)
            slope = 3 * e**2 / toe**2 - 2 * e**3 / toe**3
            energy += stiffness[s] * rest[s] * (e**4 / (4 * toe**2) - e**5 / (10 * toe**3))
        else:
            value, slope = e - toe / 2, 1.0
            area = 0.15 * toe**2 + 0.5 * (e**2 - toe**2) - 0.5 * toe * (e - toe)
            energy += stiffness[s] * rest[s] * area
        along, across = stiffness[s] * slope / rest[s], stiffness[s] * value / span
        for a in range(3):
            pull = across * arm[a]
            if s >= c:
                gradient[s - c, a] += pull
            if p >= 0:
                gradient[p, a] -= pull
            for b in range(3):
                dyad = arm[a] * arm[b] / span**2
                block = (along - across) * dyad + (across if a == b else 0.0)
                if s >= c:
                    link[s - c, a, b] = block
                    diagonal[s - c, a, b] += block
                if p >= 0:
                    diagonal[p, a, b] += block
    return energy


@nb.njit(cache=True)
def _hang(
    y: FloatArray,
    order: IntArray,
    first: IntArray,
    parent: IntArray,
    ends: FloatArray,
    tips: FloatArray,
    place: FloatArray,
    rest: FloatArray,
    stiffness: FloatArray,
    toe: float,
) -> FloatArray:
    """Minimise the energy of each tree from the start ``y (j, 3)``; see `Trees.junctions`."""
    j, c = len(y), len(ends)
    gradient, move = np.zeros((j, 3)), np.zeros((j, 3))
    diagonal, link, inverse = np.zeros((j, 3, 3)), np.zeros((j, 3, 3)), np.zeros((j, 3, 3))
    for t in range(len(first) - 1):
        own = order[first[t] : first[t + 1]]
        inner = own[own >= c] - c
        given = (ends, tips, place, rest, stiffness, toe, gradient, diagonal, link)
        energy = _pulled(own, parent, y, *given)
        done = False
        for _ in range(MAX_ITERATIONS):
            right = -gradient
            for i in inner[::-1]:
                inverse[i] = np.linalg.inv(diagonal[i])
                p = parent[c + i]
                if p >= 0:
                    through = link[i] @ inverse[i]
                    diagonal[p] -= through @ link[i]
                    right[p] += through @ right[i]
            for i in inner:
                p = parent[c + i]
                if p >= 0:
                    right[i] += link[i] @ move[p]
                move[i] = inverse[i] @ right[i]
            length = slope = 0.0
            for i in inner:
                length = max(length, np.max(np.abs(move[i])))
                slope += np.dot(gradient[i], move[i])
            share, before = 1.0, y.copy()
            while True:
                for i in inner:
                    y[i] = before[i] + share * move[i]
                new = _pulled(own, parent, y, *given)
                if length < NEAR_MM or new <= energy + 1e-4 * share * slope or share < 1e-12:
                    break
                share /= 2
            energy = new
            if length < LAST_MM:
                done = True
                break
        if not done:
            for i in inner:
                y[i] = np.nan
    return y
