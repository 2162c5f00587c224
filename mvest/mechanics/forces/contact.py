r"""Leaflet contact as a smooth non-local potential between midsurface points.

Leaflets touch when their midsurfaces are one thickness apart. Contact therefore acts between
material points of the midsurface, without projections, normals or facets. With area weights
:math:`a_i` the energy is

.. math:: \Pi = \sum_{i<j} a_i a_j \, \varphi_{ij}(|x_i - x_j|) ,

a quadrature of a double surface integral, as smooth in the positions as :math:`\varphi`. The kernel
follows from the contact pressure: two parallel sheets at the distance d press on each other with
:math:`p(d) = 2 \pi d \varphi(d)` (the derivative of the energy per area
:math:`2\pi\int_d^h \varphi(r) r dr`). Hence

.. math::
    \varphi(r) = \frac{p(r)}{2 \pi r}, \qquad
    p(r) = p_0 \Big(\frac{h - r}{h - r_0}\Big)^4 \Big(\frac{r_0 - r_b}{r - r_b}\Big)^2
    \quad (r_b < r < h), \qquad 0 \quad (r \ge h),

three times continuously differentiable at the activation distance h. The contact pressure is
:math:`p_0` at the midsurface distance :math:`r_0`. A barrier at :math:`r_b` keeps two points apart
even under concentrated loads, such as a free edge pressed into the other leaflet. Because the
sheets stay a thickness apart, the sum over points with the spacing s converges exponentially to the
integral, with an error of the order :math:`e^{-2\pi r_0/s}` (Poisson summation): the pattern of the
points has no effect.

Distances scale with the local thickness t (mean of both points): :math:`r_0 = c_0 t`, :math:`h =
c_h t`, :math:`r_b = 0.85 r_0`; with :math:`r_b \ge t` the thick leaflets cannot overlap. Neighbours
in one sheet must not repel each other: the reach of a pair is at most ``NEIGHBOUR * D``
(:mod:`mvest.mechanics.forces.pair_search`), where D is its distance at rest. No pair is active in
the stress-free state, and pleats, commissures and leaflets follow one rule.

Leaflets do not pass through each other: in one Newton step a listed pair loses at most three
quarters of its distance to the barrier, and the triangulated midsurface samples do not collide
(:mod:`mvest.mechanics.forces.pair_search`).
"""

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.mechanics.forces.pair_search import (
    ContactPairs,
    Passing,
    Sheet,
    approaching,
    search_pairs,
)
from mvest.mechanics.settings import ContactSettings
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import Embedding

BARRIER = 0.85
"""Distance of the barrier over the reference distance."""
NEAREST = 1e-3
"""Distance to the barrier, over the reference distance, below which the force grows linearly. By
default the contact pressure there is 800 MPa, far above that of a closed valve. A start may be
beyond the barrier, as a closed valve from another mesh; Newton's method then leads it out."""
APPROACH = 0.75
"""Largest share of its distance to the barrier that a pair may lose in one Newton step."""


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
        mm by which the search radius exceeds the reach.

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
        if len(triangles) == 0:
            raise InputError("contact needs triangles of the sampled midsurface; there are none")
        self.points = points
        self.settings = settings
        self.skin = skin
        self.sheet = Sheet(
            np.ascontiguousarray(rest),
            np.ascontiguousarray(areas),
            np.ascontiguousarray(thickness),
            points.host,
            np.argsort(points.host, kind="stable"),
            settings.activation_distance,
            settings.reference_distance,
            settings.reference_pressure,
        )
        self.passing = Passing(self.sheet, triangles, skin)

    def search(self, y: FloatArray) -> ContactPairs:
        """Pairs that may become active while no point ``y (k, 3)`` moves by half the skin."""
        return search_pairs(y, self.sheet, self.skin)

    def stale(self, pairs: ContactPairs, y: FloatArray) -> bool:
        """Whether points have moved so far that the search must be repeated."""
        moved = np.max(np.sum((y - pairs.positions) ** 2, axis=1), initial=0.0)
        return bool(moved > (0.5 * self.skin) ** 2)

    def forces(self, pairs: ContactPairs, y: FloatArray) -> FloatArray:
        """Energy derivative ``(k, 3)`` N by the positions of the points."""
        return _forces(y, pairs, self.sheet)

    def forces_change(
        self,
        pairs: ContactPairs,
        y: FloatArray,
        moved: FloatArray,
        areas: FloatArray | None,
        thickness: FloatArray | None,
    ) -> FloatArray:
        """Change ``(k, 3)`` N of the forces at fixed positions, due to changes at rest.

        The force of a pair is homogeneous of degree -2 in r and h, since r_0 is a fixed share of h;
        its derivative by h follows from that by r (Euler).

        Parameters
        ----------
        pairs, y
            As for `forces`.
        moved : ndarray
            ``(k, 3)`` mm, displacement at rest.
        areas, thickness : ndarray or None
            ``(k,)`` changes in mm² and mm.
        """
        areas, thickness = (np.zeros(len(y)) if v is None else v for v in (areas, thickness))
        return _forces_change(y, pairs, self.sheet, moved, areas, thickness)

    def touching(self, pairs: ContactPairs, y: FloatArray, margin: float = 0.0) -> BoolArray:
        """Groups ``(g,)`` with a pair closer than ``1 + margin`` times its reach."""
        return _touching(y, pairs, margin)

    def add_tangent(
        self,
        pairs: ContactPairs,
        y: FloatArray,
        data: FloatArray,
        slot: IntArray,
        between: NDArray[np.int32],
        own: NDArray[np.int32],
    ) -> None:
        """Add the exact Hessian of the contact energy to block data.

        Parameters
        ----------
        slot : ndarray
            ``(g,)`` entry of ``between`` for each group, -1 for groups that do not touch.
        between : ndarray
            ``(slots, w, w)`` positions of the blocks (host 1, host 2) from
            :meth:`mvest.mechanics.assembly.SparsityPattern.between`.
        own : ndarray
            ``(e, w, w)`` positions of the blocks of each host element with itself, negative in the
            lower triangle.
        """
        _add_tangent(y, pairs, self.sheet, self.points.weights, data, slot, between, own)

    def largest_step(
        self, pairs: ContactPairs, y: FloatArray, dy: FloatArray, *, detect: bool = False
    ) -> float:
        """Largest factor <= 1 on the move ``dy (k, 3)`` without a collision; 0 if sheets touch now.

        With ``detect`` the collision detection always runs.
        """
        factor = float(_largest_step(y, dy, pairs))
        return factor * self.passing.free_share(pairs, y, factor * dy, detect=detect)

    def active(self, pairs: ContactPairs, y: FloatArray) -> int:
        """Number of pairs within their reach."""
        return int(_active(y, pairs))

    def intersects(self, y: FloatArray) -> bool:
        """Whether triangles of the sampled midsurface intersect at ``y (k, 3)``."""
        return self.passing.intersects(y)


@nb.njit(cache=True, inline="always")
def _kernel(r: float, h: float, r0: float, p0: float) -> tuple[float, float]:
    """First and second derivative of phi at ``r < h``."""
    rb = BARRIER * r0
    beyond = min(r - rb - NEAREST * r0, 0.0)
    r -= beyond
    s = (h - r) / (h - r0)
    u = (r0 - rb) / (r - rb)
    p = p0 * s**4 * u * u
    # d(log p)/dr = -4/(h - r) - 2/(r - rb)
    slope = -4.0 / (h - r) - 2.0 / (r - rb)
    dp = p * slope
    ddp = p * (slope * slope - 4.0 / (h - r) ** 2 + 2.0 / (r - rb) ** 2)
    first = (dp - p / r) / (2.0 * np.pi * r)
    second = (ddp - 2.0 * dp / r + 2.0 * p / (r * r)) / (2.0 * np.pi * r)
    return first + beyond * second, second


@nb.njit(cache=True, inline="always")
def _span(y: FloatArray, i: int, j: int) -> tuple[float, float, float, float]:
    """Vector from point j to point i, and its square."""
    d0, d1, d2 = y[i, 0] - y[j, 0], y[i, 1] - y[j, 1], y[i, 2] - y[j, 2]
    return d0, d1, d2, d0 * d0 + d1 * d1 + d2 * d2


@nb.njit(cache=True)
def _forces(y: FloatArray, pairs: ContactPairs, sheet: Sheet) -> FloatArray:
    out, reach = np.zeros_like(y), pairs.reach
    for k in range(len(reach)):
        i, j = pairs.first[k], pairs.second[k]
        d0, d1, d2, rr = _span(y, i, j)
        if rr >= reach[k] * reach[k]:
            continue
        r = np.sqrt(rr)
        f, _ = _kernel(r, reach[k], pairs.reference[k], sheet.pressure)
        f *= sheet.areas[i] * sheet.areas[j] / r
        out[i, 0] += f * d0
        out[i, 1] += f * d1
        out[i, 2] += f * d2
        out[j, 0] -= f * d0
        out[j, 1] -= f * d1
        out[j, 2] -= f * d2
    return out


@nb.njit(cache=True)
def _forces_change(
    y: FloatArray,
    pairs: ContactPairs,
    sheet: Sheet,
    moved: FloatArray,
    d_areas: FloatArray,
    d_thickness: FloatArray,
) -> FloatArray:
    out, areas, thickness = np.zeros_like(y), sheet.areas, sheet.thickness
    for k in range(len(pairs.first)):
        i, j, h = pairs.first[k], pairs.second[k], pairs.reach[k]
        rr = _span(y, i, j)[3]
        if rr >= h * h:
            continue
        r = np.sqrt(rr)
        value, slope = _kernel(r, h, pairs.reference[k], sheet.pressure)
        dh = 0.5 * sheet.activation * (d_thickness[i] + d_thickness[j])
        if h < 0.5 * sheet.activation * (thickness[i] + thickness[j]):
            d0, d1, d2, apart = _span(sheet.rest, i, j)
            m0, m1, m2, _ = _span(moved, i, j)
            dh = h * (d0 * m0 + d1 * m1 + d2 * m2) / apart
        f = value * (d_areas[i] * areas[j] + areas[i] * d_areas[j])
        f -= areas[i] * areas[j] * (2.0 * value + r * slope) * dh / h
        for c in range(3):
            out[i, c] += f * (y[i, c] - y[j, c]) / r
            out[j, c] -= f * (y[i, c] - y[j, c]) / r
    return out


@nb.njit(cache=True)
def _add_tangent(
    y: FloatArray,
    pairs: ContactPairs,
    sheet: Sheet,
    weights: FloatArray,
    data: FloatArray,
    slot: IntArray,
    between: NDArray[np.int32],
    own: NDArray[np.int32],
) -> None:
    n, n_w = weights.shape
    first, start, reach, areas = pairs.first, pairs.start, pairs.reach, sheet.areas
    host, by_host = sheet.host, sheet.by_host
    # The 3x3 block of a pair is symmetric: 00, 11, 22, 12, 02, 01. Components come first: innermost
    # loops run along the nodes.
    at_point = np.zeros((n, 6))
    stiffness = np.empty(6)
    row = np.empty((6, n_w))
    block = np.empty((6, n_w, n_w))
    for g in range(len(start) - 1):
        if slot[g] < 0:
            continue
        block[:] = 0.0
        k = start[g]
        while k < start[g + 1]:
            # For all pairs of one first point: sum up K_ij w_j over j, then expand by w_i once.
            i = first[k]
            any_active = False
            while k < start[g + 1] and first[k] == i:
                j = pairs.second[k]
                d0, d1, d2, rr = _span(y, i, j)
                if rr < reach[k] * reach[k]:
                    r = np.sqrt(rr)
                    f1, f2 = _kernel(r, reach[k], pairs.reference[k], sheet.pressure)
                    a = areas[i] * areas[j]
                    across = a * f1 / r
                    along = (a * f2 - across) / rr
                    stiffness[0] = along * d0 * d0 + across
                    stiffness[1] = along * d1 * d1 + across
                    stiffness[2] = along * d2 * d2 + across
                    stiffness[3] = along * d1 * d2
                    stiffness[4] = along * d0 * d2
                    stiffness[5] = along * d0 * d1
                    if not any_active:
                        row[:] = 0.0
                        any_active = True
                    for c in range(6):
                        at_point[i, c] += stiffness[c]
                        at_point[j, c] += stiffness[c]
                        for b in range(n_w):
                            row[c, b] -= stiffness[c] * weights[j, b]
                k += 1
            if any_active:
                for c in range(6):
                    for a_ in range(n_w):
                        w = weights[i, a_]
                        for b in range(n_w):
                            block[c, a_, b] += w * row[c, b]
        for a_ in range(n_w):
            for b in range(n_w):
                at = between[slot[g], a_, b]
                if at < 0:  # a node that both hosts have
                    at = -1 - at
                    _add_symmetric(data[at], block[:, a_, b])
                _add_symmetric(data[at], block[:, a_, b])
    p = 0
    while p < n:
        h, any_active = host[by_host[p]], False
        block[:] = 0.0
        while p < n and host[by_host[p]] == h:
            i = by_host[p]
            p += 1
            if not np.any(at_point[i] != 0.0):
                continue
            any_active = True
            for c in range(6):
                for a_ in range(n_w):
                    w = at_point[i, c] * weights[i, a_]
                    for b in range(n_w):
                        block[c, a_, b] += w * weights[i, b]
        if any_active:
            for a_ in range(n_w):
                for b in range(n_w):
                    if own[h, a_, b] >= 0:
                        _add_symmetric(data[own[h, a_, b]], block[:, a_, b])


@nb.njit(cache=True, inline="always")
def _add_symmetric(target: FloatArray, six: FloatArray) -> None:
    """Add the symmetric matrix with the components 00, 11, 22, 12, 02, 01."""
    target[0, 0] += six[0]
    target[1, 1] += six[1]
    target[2, 2] += six[2]
    target[1, 2] += six[3]
    target[2, 1] += six[3]
    target[0, 2] += six[4]
    target[2, 0] += six[4]
    target[0, 1] += six[5]
    target[1, 0] += six[5]


@nb.njit(cache=True)
def _active(y: FloatArray, pairs: ContactPairs) -> int:
    count = 0
    for k in range(len(pairs.first)):
        rr = _span(y, pairs.first[k], pairs.second[k])[3]
        count += int(rr < pairs.reach[k] * pairs.reach[k])
    return count


@nb.njit(cache=True)
def _touching(y: FloatArray, pairs: ContactPairs, margin: float) -> BoolArray:
    start = pairs.start
    out = np.zeros(len(start) - 1, dtype=np.bool_)
    for g in range(len(start) - 1):
        for k in range(start[g], start[g + 1]):
            rr = _span(y, pairs.first[k], pairs.second[k])[3]
            if rr < (pairs.reach[k] * (1.0 + margin)) ** 2:
                out[g] = True
                break
    return out


@nb.njit(cache=True)
def _largest_step(y: FloatArray, dy: FloatArray, pairs: ContactPairs) -> float:
    best = 1.0
    for k in range(len(pairs.first)):
        rr, rd, dd = approaching(y, dy, pairs.first[k], pairs.second[k])
        if rd >= 0.0:
            continue
        # Distant pairs may close up to the reference distance; near ones lose APPROACH.
        reference = pairs.reference[k]
        barrier = BARRIER * reference
        floor = min(barrier + (1.0 - APPROACH) * (np.sqrt(rr) - barrier), reference) ** 2
        # Smallest root of rr + 2 t rd + t^2 dd = floor in (0, best).
        disc = rd * rd - dd * (rr - floor)
        if disc <= 0.0:
            continue
        t = (-rd - np.sqrt(disc)) / dd
        if 0.0 <= t < best:
            best = t
    return best
