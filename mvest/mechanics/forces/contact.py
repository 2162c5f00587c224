r"""Leaflet contact as a smooth non-local potential between midsurface points.

The leaflets touch when their midsurfaces are one thickness apart. Contact therefore acts between
material points of the midsurface and needs no projections, normals or facets: with area weights
:math:`a_i` the energy is

.. math:: \Pi = \sum_{i<j} a_i a_j \, \varphi_{ij}(|x_i - x_j|) ,

a quadrature of a double surface integral, as smooth in the positions as :math:`\varphi` is. The
kernel is derived from the law that one wants: two parallel sheets at distance d with the potential
:math:`\varphi` press on each other with :math:`p(d) = 2 \pi d \varphi(d)` (differentiate
:math:`2\pi\int_d^h \varphi(r) r dr`, the energy per area). Hence

.. math::
    \varphi(r) = \frac{p(r)}{2 \pi r}, \qquad
    p(r) = p_0 \Big(\frac{h - r}{h - r_0}\Big)^4 \Big(\frac{r_0 - r_b}{r - r_b}\Big)^2
    \quad (r_b < r < h), \qquad 0 \quad (r \ge h),

three times continuously differentiable at the activation distance h. The contact pressure is
:math:`p_0` exactly at the midsurface distance :math:`r_0`, and a barrier at :math:`r_b` keeps any
two points apart however concentrated the load (a free edge pressed into the other leaflet). Because
the sheets stay a thickness apart, the sum over points spaced by s approaches the integral
exponentially, with an error of the order :math:`e^{-2\pi r_0/s}` (Poisson summation), so the
points' pattern is not felt.

Distances scale with the local thickness t (mean of the two points): :math:`r_0 = c_0 t`, :math:`h =
c_h t`, :math:`r_b = 0.85 r_0`; with :math:`r_b \ge t` the thick leaflets cannot overlap. Neighbours
on the same sheet must not repel each other: the reach of a pair is shortened to ``NEIGHBOUR * D``
(:mod:`mvest.mechanics.forces.pair_search`) where D is its distance at rest, so that no pair is
active in the stress-free state and the same rule serves pleats, commissures and leaflets alike.

No passing: no Newton step takes the triangulated midsurface samples through each other (continuous
collision detection along the step, Li et al. 2020, ACM Trans. Graph. 39(4):49, by the IPC toolkit),
nor does it take from a known pair more than three quarters of its distance to the barrier. So the
leaflets can never change sides. Every accepted time step is checked for intersecting triangles
besides.
"""

from __future__ import annotations

from dataclasses import dataclass

import ipctk
import numba as nb
import numpy as np

from mvest.errors import InputError
from mvest.mechanics.forces.pair_search import search_pairs
from mvest.mechanics.settings import ContactSettings
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.mesh.embedding import Embedding

__all__ = ["Contact", "ContactPairs"]

BARRIER = 0.85
"""Distance of the barrier over the reference distance."""
APPROACH = 0.75
"""A pair may lose at most this share of its distance to the barrier in one Newton step."""
HARMLESS = 0.02
"""mm; a step that moves no point farther cannot take sheets through each other."""


@dataclass(frozen=True, slots=True, eq=False)
class ContactPairs:
    """Candidate pairs sorted by the elements that host them.

    Attributes
    ----------
    first, second : ndarray
        ``(p,)`` points; the host of ``first`` is not behind the host of ``second``.
    reach : ndarray
        ``(p,)`` activation distance of each pair, mm.
    reference : ndarray
        ``(p,)`` reference distance of each pair, mm.
    start : ndarray
        ``(g + 1,)`` where each group of equal hosts starts.
    hosts : ndarray
        ``(g, 2)``.
    positions : ndarray
        ``(k, 3)`` point positions of the search.
    """

    first: IntArray
    second: IntArray
    reach: FloatArray
    reference: FloatArray
    start: IntArray
    hosts: IntArray
    positions: FloatArray


class Contact:
    """Contact between the sampled midsurface and itself.

    Parameters
    ----------
    points : Embedding
        ``(k,)`` midsurface points.
    rest : ndarray
        ``(k, 3)`` mm, their positions at rest.
    areas, thickness : ndarray
        ``(k,)`` mm^2 and mm.
    triangles : ndarray
        ``(t, 3)`` of the points, for the intersection check.
    settings : ContactSettings
    skin : float
        mm by which the candidate search exceeds the reach.
    """

    def __init__(
        self,
        points: Embedding,
        rest: FloatArray,
        areas: FloatArray,
        thickness: FloatArray,
        triangles: IntArray,
        settings: ContactSettings,
        skin: float = 1.0,
    ) -> None:
        self.points = points
        self.rest = np.ascontiguousarray(rest)
        self.areas = np.ascontiguousarray(areas)
        self.thickness = np.ascontiguousarray(thickness)
        self.triangles = triangles
        self.settings = settings
        self.skin = skin
        if len(triangles) == 0:
            raise InputError("contact needs triangles of the sampled midsurface; there are none")
        self._by_host = np.argsort(points.host, kind="stable")
        faces = np.asfortranarray(triangles, dtype=np.int32)
        self._collision_mesh = ipctk.CollisionMesh(
            np.asfortranarray(rest), ipctk.edges(faces), faces
        )

    def search(self, y: FloatArray) -> ContactPairs:
        """Pairs that can become active while no point moves by more than half the skin.

        Parameters
        ----------
        y : ndarray
            ``(k, 3)`` current positions of the points.
        """
        longest = self.settings.activation_distance * float(self.thickness.max())
        first, second, reach, reference = search_pairs(
            y,
            self.rest,
            self.thickness,
            self._by_host,
            self.points.host,
            self.settings.activation_distance,
            self.settings.reference_distance,
            longest + self.skin,
            self.skin,
        )
        hosts = np.column_stack([self.points.host[first], self.points.host[second]])
        change = np.flatnonzero(np.any(np.diff(hosts, axis=0) != 0, axis=1)) + 1
        ends = np.concatenate([change, [len(first)]]) if len(first) else np.zeros(0)
        start = np.concatenate([[0], ends]).astype(np.int64)
        return ContactPairs(first, second, reach, reference, start, hosts[start[:-1]], y.copy())

    def stale(self, pairs: ContactPairs, y: FloatArray) -> bool:
        """Whether a point has moved so far that the search must be repeated."""
        moved = np.max(np.sum((y - pairs.positions) ** 2, axis=1), initial=0.0)
        return bool(moved > (0.5 * self.skin) ** 2)

    def forces(self, pairs: ContactPairs, y: FloatArray) -> FloatArray:
        """Energy derivative ``(k, 3)`` N by the positions of the points."""
        return _forces(
            y,
            pairs.first,
            pairs.second,
            pairs.reach,
            pairs.reference,
            self.areas,
            self.settings.reference_pressure,
        )

    def energy(self, pairs: ContactPairs, y: FloatArray) -> float:
        """Contact energy in N mm."""
        r = np.linalg.norm(y[pairs.first] - y[pairs.second], axis=1)
        gap = np.maximum(pairs.reach - r, 0.0) / (pairs.reach - pairs.reference)
        barrier = BARRIER * pairs.reference
        phi = self.settings.reference_pressure * gap**4 / (2 * np.pi * r)
        phi *= ((pairs.reference - barrier) / (r - barrier)) ** 2
        return float(np.sum(self.areas[pairs.first] * self.areas[pairs.second] * phi))

    def touching(self, pairs: ContactPairs, y: FloatArray, margin: float = 0.0) -> BoolArray:
        """Groups ``(g,)`` with a pair whose distance is below ``1 + margin`` times its reach."""
        return _touching(y, pairs.first, pairs.second, pairs.reach, pairs.start, margin)

    def add_tangent(
        self,
        pairs: ContactPairs,
        y: FloatArray,
        data: FloatArray,
        slot: IntArray,
        forward: IntArray,
        backward: IntArray,
        own: IntArray,
    ) -> None:
        """Add the exact Hessian of the contact energy to block data.

        Parameters
        ----------
        slot : ndarray
            ``(g,)`` entry of ``forward`` and ``backward`` for each group, -1 for groups that do not
            touch.
        forward, backward : ndarray
            ``(slots, w, w)`` positions of the blocks (host 1, host 2) and (host 2, host 1).
        own : ndarray
            ``(e, w, w)`` positions of the blocks of each host element with itself.
        """
        _add_tangent(
            y,
            pairs.first,
            pairs.second,
            pairs.reach,
            pairs.reference,
            pairs.start,
            self.areas,
            self.settings.reference_pressure,
            self.points.weights,
            self.points.host,
            data,
            slot,
            forward,
            backward,
            own,
        )

    def largest_step(self, pairs: ContactPairs, y: FloatArray, dy: FloatArray) -> float:
        """Largest factor <= 1 on the move ``dy (k, 3)`` that takes no sheet through another."""
        factor = float(
            _largest_step(y, dy, pairs.first, pairs.second, pairs.reach, pairs.reference)
        )
        if factor * float(np.max(np.abs(dy), initial=0.0)) < HARMLESS:
            return factor
        start, end = np.asfortranarray(y), np.asfortranarray(y + factor * dy)
        free = ipctk.compute_collision_free_stepsize(self._collision_mesh, start, end)
        return factor if free >= 1.0 else 0.8 * factor * float(free)

    def active(self, pairs: ContactPairs, y: FloatArray) -> int:
        """Number of pairs within their reach."""
        r = np.linalg.norm(y[pairs.first] - y[pairs.second], axis=1)
        return int(np.count_nonzero(r < pairs.reach))

    def intersects(self, y: FloatArray) -> bool:
        """Whether triangles of the sampled midsurface intersect at ``y (k, 3)``."""
        return bool(ipctk.has_intersections(self._collision_mesh, np.asfortranarray(y)))


@nb.njit(cache=True, inline="always")
def _kernel(r: float, h: float, r0: float, p0: float) -> tuple[float, float]:
    """First and second derivative of phi at ``r < h``."""
    rb = BARRIER * r0
    r = max(r, rb + 1e-3 * r0)
    s = (h - r) / (h - r0)
    u = (r0 - rb) / (r - rb)
    p = p0 * s**4 * u * u
    # d(log p)/dr = -4/(h - r) - 2/(r - rb)
    slope = -4.0 / (h - r) - 2.0 / (r - rb)
    dp = p * slope
    ddp = p * (slope * slope - 4.0 / (h - r) ** 2 + 2.0 / (r - rb) ** 2)
    first = (dp - p / r) / (2.0 * np.pi * r)
    second = (ddp - 2.0 * dp / r + 2.0 * p / (r * r)) / (2.0 * np.pi * r)
    return first, second


@nb.njit(cache=True)
def _forces(
    y: FloatArray,
    first: IntArray,
    second: IntArray,
    reach: FloatArray,
    reference: FloatArray,
    areas: FloatArray,
    p0: float,
) -> FloatArray:
    out = np.zeros_like(y)
    for k in range(len(first)):
        i, j = first[k], second[k]
        d0, d1, d2 = y[i, 0] - y[j, 0], y[i, 1] - y[j, 1], y[i, 2] - y[j, 2]
        r = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        if r >= reach[k]:
            continue
        f, _ = _kernel(r, reach[k], reference[k], p0)
        f *= areas[i] * areas[j] / r
        out[i, 0] += f * d0
        out[i, 1] += f * d1
        out[i, 2] += f * d2
        out[j, 0] -= f * d0
        out[j, 1] -= f * d1
        out[j, 2] -= f * d2
    return out


@nb.njit(cache=True)
def _add_tangent(
    y: FloatArray,
    first: IntArray,
    second: IntArray,
    reach: FloatArray,
    reference: FloatArray,
    start: IntArray,
    areas: FloatArray,
    p0: float,
    weights: FloatArray,
    host: IntArray,
    data: FloatArray,
    slot: IntArray,
    forward: IntArray,
    backward: IntArray,
    own: IntArray,
) -> None:
    n_w = weights.shape[1]
    own_block = np.zeros((y.shape[0], 3, 3))
    touched = np.zeros(y.shape[0], dtype=np.bool_)
    row = np.zeros((n_w, 3, 3))
    block = np.zeros((n_w, n_w, 3, 3))
    k3 = np.empty((3, 3))
    d = np.empty(3)
    for g in range(len(start) - 1):
        if slot[g] < 0:
            continue
        used = False
        k = start[g]
        while k < start[g + 1]:
            # All pairs of one first point: collect sum_j K_ij w_j, then expand by w_i once.
            i = first[k]
            any_active = False
            while k < start[g + 1] and first[k] == i:
                j = second[k]
                for c in range(3):
                    d[c] = y[i, c] - y[j, c]
                r = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
                if r < reach[k]:
                    f1, f2 = _kernel(r, reach[k], reference[k], p0)
                    a = areas[i] * areas[j]
                    across = a * f1 / r
                    along = (a * f2 - across) / (r * r)
                    for m in range(3):
                        for n in range(3):
                            k3[m, n] = along * d[m] * d[n]
                        k3[m, m] += across
                    if not any_active:
                        row[:, :, :] = 0.0
                        any_active = True
                    for m in range(3):
                        for n in range(3):
                            own_block[i, m, n] += k3[m, n]
                            own_block[j, m, n] += k3[m, n]
                    touched[i] = True
                    touched[j] = True
                    for b in range(n_w):
                        w = weights[j, b]
                        for m in range(3):
                            for n in range(3):
                                row[b, m, n] -= w * k3[m, n]
                k += 1
            if any_active:
                if not used:
                    block[:, :, :, :] = 0.0
                    used = True
                for a_ in range(n_w):
                    w = weights[i, a_]
                    if w == 0.0:
                        continue
                    for b in range(n_w):
                        for m in range(3):
                            for n in range(3):
                                block[a_, b, m, n] += w * row[b, m, n]
        if used:
            for a_ in range(n_w):
                for b in range(n_w):
                    to, fro = data[forward[slot[g], a_, b]], data[backward[slot[g], b, a_]]
                    for m in range(3):
                        for n in range(3):
                            to[m, n] += block[a_, b, m, n]
                            fro[n, m] += block[a_, b, m, n]
    for i in range(y.shape[0]):
        if not touched[i]:
            continue
        for a_ in range(n_w):
            for b in range(n_w):
                w = weights[i, a_] * weights[i, b]
                target = data[own[host[i], a_, b]]
                for m in range(3):
                    for n in range(3):
                        target[m, n] += w * own_block[i, m, n]


@nb.njit(cache=True)
def _touching(
    y: FloatArray,
    first: IntArray,
    second: IntArray,
    reach: FloatArray,
    start: IntArray,
    margin: float,
) -> BoolArray:
    out = np.zeros(len(start) - 1, dtype=np.bool_)
    for g in range(len(start) - 1):
        for k in range(start[g], start[g + 1]):
            i, j = first[k], second[k]
            rr = (y[i, 0] - y[j, 0]) ** 2 + (y[i, 1] - y[j, 1]) ** 2 + (y[i, 2] - y[j, 2]) ** 2
            if rr < (reach[k] * (1.0 + margin)) ** 2:
                out[g] = True
                break
    return out


@nb.njit(cache=True)
def _largest_step(
    y: FloatArray,
    dy: FloatArray,
    first: IntArray,
    second: IntArray,
    reach: FloatArray,
    reference: FloatArray,
) -> float:
    best = 1.0
    for k in range(len(first)):
        i, j = first[k], second[k]
        rr = 0.0
        rd = 0.0
        dd = 0.0
        for c in range(3):
            r = y[i, c] - y[j, c]
            s = dy[i, c] - dy[j, c]
            rr += r * r
            rd += r * s
            dd += s * s
        if rd >= 0.0:
            continue
        # Pairs still apart may come to the reference distance; close ones lose APPROACH.
        barrier = BARRIER * reference[k]
        floor = min(barrier + (1.0 - APPROACH) * (np.sqrt(rr) - barrier), reference[k]) ** 2
        # Smallest root of rr + 2 t rd + t^2 dd = floor in (0, best).
        disc = rd * rd - dd * (rr - floor)
        if disc <= 0.0:
            continue
        t = (-rd - np.sqrt(disc)) / dd
        if 0.0 <= t < best:
            best = t
    return best
