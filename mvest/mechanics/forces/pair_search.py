"""Search for pairs of points that may come into contact, and collisions of sampled sheets.

Points are searched in cubes of space. That a step does not move triangles of the sampled midsurface
through each other is proved from distances of points or, failing that, checked by continuous
collision detection (Li et al. 2020, ACM Trans. Graph. 39(4):49; IPC toolkit).

The proof: if an edge of length a meets one of length b, or a point meets a triangle with edges up
to a, the weighted mean of the squared distances between their ends is at most
:math:`(a^2 + b^2)/4` or :math:`a^2/3`. So two points are at least that close. Edge lengths are
convex along a step, so their values at both ends bound them. Listed pairs are tested one by one;
pairs that the search left out are farther apart than its skin, less the moves since. Neighbours
within the sheet are always too close for the proof. No time step is accepted if triangles
intersect: it is repeated with detection throughout.
"""

from typing import NamedTuple

import ipctk
import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from mvest.typing import FloatArray, IntArray

NEIGHBOUR = 0.8
"""Largest reach of a pair over its rest distance: sheets touch themselves from 20 % compression."""
FINENESS = 2
"""Cubes along the search radius; smaller cubes fit the search sphere more closely."""
EXPECTED = 72
"""Pairs per point for which memory is allocated at first."""


class Sheet(NamedTuple):
    """The sampled midsurface as input of the kernels."""

    rest: FloatArray  #: (k, 3) mm, the points at rest
    #: (k,) mm² and mm
    areas: FloatArray
    thickness: FloatArray
    #: (k,), host element of each point, and the points sorted by their hosts
    host: IntArray
    by_host: IntArray
    #: activation and reference distance over the thickness
    activation: float
    distance: float
    pressure: float  #: MPa at the reference distance


class ContactPairs(NamedTuple):
    """Candidate pairs sorted by their host elements."""

    #: (p,), points with ``host[first] <= host[second]``
    first: NDArray[np.int32]
    second: NDArray[np.int32]
    #: (p,) mm, activation and reference distance
    reach: FloatArray
    reference: FloatArray
    #: (g + 1,) and (g, 2), start of each group of pairs with equal hosts, and these hosts
    start: IntArray
    hosts: IntArray
    positions: FloatArray  #: (k, 3) mm, positions of the points at the search


def search_pairs(y: FloatArray, sheet: Sheet, skin: float) -> ContactPairs:
    """Candidate pairs of points ``y (k, 3)`` mm that are closer than their reach plus ``skin``."""
    n = len(y)
    radius = sheet.activation * float(sheet.thickness.max()) + skin
    cells = _cells(y, sheet.by_host, radius / FINENESS)
    ends = np.zeros(n + 1, dtype=np.int64)
    # Large arrays are allocated here and not in the kernels: numpy puts them on huge pages, whose
    # first use is faster.
    second = np.empty(EXPECTED * n, dtype=np.int32)
    count = _candidates(y, sheet, cells, radius, skin, ends, second)
    if count > len(second):
        second = np.empty(count, dtype=np.int32)
        _candidates(y, sheet, cells, radius, skin, ends, second)
    points = np.empty((2, count), dtype=np.int32)
    lengths = np.empty((2, count))
    start, hosts = _grouped(sheet, ends, second, points, lengths)
    return ContactPairs(points[0], points[1], lengths[0], lengths[1], start, hosts, y.copy())


class _Cells(NamedTuple):
    """Cubes of space: their number per axis, the cube of each point, and their members.

    The members of a cube begin at ``start``, sorted by host; ``table (4, k)`` holds their three
    coordinates and their numbers.
    """

    counts: IntArray
    place: NDArray[np.int32]
    start: IntArray
    table: FloatArray


@nb.njit(cache=True)
def _cells(y: FloatArray, by_host: IntArray, size: float) -> _Cells:
    n = len(y)
    low = np.array([y[:, c].min() for c in range(3)])
    counts = np.array([int((y[:, c].max() - low[c]) / size) + 1 for c in range(3)])
    place = np.empty((n, 3), dtype=np.int32)
    start = np.zeros(counts[0] * counts[1] * counts[2] + 1, dtype=np.int64)
    for i in range(n):
        for c in range(3):
            place[i, c] = min(int((y[i, c] - low[c]) / size), counts[c] - 1)
        start[(place[i, 0] * counts[1] + place[i, 1]) * counts[2] + place[i, 2] + 1] += 1
    start = np.cumsum(start)
    filled = start[:-1].copy()
    table = np.empty((4, n))
    for p in range(n):
        i = by_host[p]
        k = (place[i, 0] * counts[1] + place[i, 1]) * counts[2] + place[i, 2]
        for c in range(3):
            table[c, filled[k]] = y[i, c]
        table[3, filled[k]] = i
        filled[k] += 1
    return _Cells(counts, place, start, table)


@nb.njit(cache=True, error_model="numpy")
def _candidates(
    y: FloatArray,
    sheet: Sheet,
    cells: _Cells,
    radius: float,
    skin: float,
    ends: IntArray,
    second: NDArray[np.int32],
) -> int:
    """Number of pairs; writes their second points as far as there is room.

    ``ends[p + 1]`` is the end of the pairs whose first point is the p-th in the order of hosts.
    """
    n = len(y)
    host, place, start = sheet.host, cells.place, cells.start
    x0, x1, x2 = cells.table[0], cells.table[1], cells.table[2]
    member, owner = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
    for q in range(n):
        member[q] = int(cells.table[3, q])
        owner[q] = host[member[q]]
    near_ones, squares = np.empty(n, dtype=np.int32), np.empty(n)
    n0, n1, n2 = cells.counts
    limit, count = radius * radius, 0
    for p in range(n):
        i = sheet.by_host[p]
        y0, y1, y2, own = y[i, 0], y[i, 1], y[i, 2], host[i]
        low = max(place[i, 2] - FINENESS, 0)
        high = min(place[i, 2] + FINENESS + 1, n2)
        for a in range(max(place[i, 0] - FINENESS, 0), min(place[i, 0] + FINENESS + 1, n0)):
            for b in range(max(place[i, 1] - FINENESS, 0), min(place[i, 1] + FINENESS + 1, n1)):
                row = (a * n1 + b) * n2
                some = 0
                for q in range(start[row + low], start[row + high]):
                    rr = (y0 - x0[q]) ** 2 + (y1 - x1[q]) ** 2 + (y2 - x2[q]) ** 2
                    # Always written, and kept by advancing the counter: no branch to mispredict.
                    near_ones[some], squares[some] = q, rr
                    some += int((rr < limit) & (owner[q] >= own))
                for k in range(some):
                    j = member[near_ones[k]]
                    if host[j] == own and j <= i:
                        continue
                    mean = 0.5 * (sheet.thickness[i] + sheet.thickness[j])
                    reach = _reach(sheet.rest, i, j, sheet.activation * mean)
                    # Neighbours that would touch only at half their rest distance never do.
                    if reach <= 0.5 * sheet.distance * mean or squares[k] >= (reach + skin) ** 2:
                        continue
                    if count < len(second):
                        second[count] = j
                    count += 1
        ends[p + 1] = count
    return count


@nb.njit(cache=True, inline="always")
def _reach(rest: FloatArray, i: int, j: int, full: float) -> float:
    """Activation distance of a pair: ``full``, or less if the pair is close at rest."""
    apart = 0.0
    for c in range(3):
        apart += (rest[i, c] - rest[j, c]) ** 2
    return min(full, NEIGHBOUR * np.sqrt(apart))


@nb.njit(cache=True, error_model="numpy")
def _grouped(
    sheet: Sheet,
    ends: IntArray,
    second: NDArray[np.int32],
    points: NDArray[np.int32],
    lengths: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Write pairs and lengths sorted by both hosts; return the starts of groups and their hosts."""
    host, by_host, thickness = sheet.host, sheet.by_host, sheet.thickness
    n, count = len(by_host), ends[-1]
    place = np.zeros(host.max() + 1, dtype=np.int64)
    start, hosts = np.empty(count + 1, dtype=np.int64), np.empty((count, 2), dtype=np.int64)
    groups, done = 0, 0
    while done < n:
        own, after = host[by_host[done]], done
        low, high = len(place), -1
        while after < n and host[by_host[after]] == own:
            after += 1
        for k in range(ends[done], ends[after]):
            h = host[second[k]]
            place[h] += 1
            low, high = min(low, h), max(high, h)
        at = ends[done]
        for h in range(low, high + 1):
            if place[h] > 0:
                start[groups], hosts[groups, 0], hosts[groups, 1] = at, own, h
                groups += 1
                at, place[h] = at + place[h], at
        for p in range(done, after):
            i = by_host[p]
            for k in range(ends[p], ends[p + 1]):
                j = second[k]
                mean = 0.5 * (thickness[i] + thickness[j])
                full = sheet.activation * mean
                reach = _reach(sheet.rest, i, j, full)
                at = place[host[j]]
                place[host[j]] += 1
                points[0, at], points[1, at] = i, j
                lengths[0, at], lengths[1, at] = reach, sheet.distance * mean * reach / full
        place[low : high + 1] = 0
        done = after
    start[groups] = count
    return start[: groups + 1].copy(), hosts[:groups].copy()


HARMLESS = 0.02
"""mm; a step in which all points move less cannot move sheets through each other."""

CLEARANCE = 1e-3
"""Least distance (mm) of midsurfaces; equilibria keep part of a thickness. Collision detection from
a distance of zero does not terminate."""

MAX_SUBDIVISIONS = 100_000
"""Subdivisions of time per pair in collision detection (10 MB); an undecided pair then counts as
colliding (Wang et al. 2021, ACM Trans. Graph. 40:188, section 5)."""

_DETECTION = ipctk.TightInclusionCCD(max_iterations=MAX_SUBDIVISIONS)
# It would print warnings about touching sheets, which the outcome of the step reports anyway.
ipctk.set_logger_level(ipctk.LoggerLevel.error)

RINGS = 3
"""Largest number of edges between neighbours within the sheet."""


class Passing:
    """Collisions of a sheet with itself, given its ``triangles (t, 3)`` and the skin (mm)."""

    def __init__(self, sheet: Sheet, triangles: IntArray, skin: float) -> None:
        self.triangles = triangles
        self._near = _near_at_rest(sheet, triangles)
        # The reach of a pair that is neither listed nor near at rest is at least the reference
        # distance.
        self._unlisted = sheet.distance * float(sheet.thickness.min()) + skin
        faces = np.asfortranarray(triangles, dtype=np.int32)
        self.mesh = ipctk.CollisionMesh(np.asfortranarray(sheet.rest), ipctk.edges(faces), faces)

    def free_share(
        self, pairs: ContactPairs, y: FloatArray, dy: FloatArray, *, detect: bool = False
    ) -> float:
        """Share of the move ``dy (k, 3)`` mm from ``y (k, 3)`` without a collision.

        With ``detect`` the collision detection always runs.
        """
        if float(np.max(np.abs(dy), initial=0.0)) < HARMLESS:
            return 1.0
        if not detect and self.stays_apart(pairs, y, dy):
            return 1.0
        free = ipctk.compute_collision_free_stepsize(
            self.mesh,
            np.asfortranarray(y),
            np.asfortranarray(y + dy),
            min_distance=CLEARANCE,
            narrow_phase_ccd=_DETECTION,
        )
        return 1.0 if free >= 1.0 else 0.8 * float(free)

    def stays_apart(self, pairs: ContactPairs, y: FloatArray, dy: FloatArray) -> bool:
        """Whether points other than neighbours are proved too far apart for triangles to meet."""
        longest = _longest_edges(y, dy, self.triangles)
        moved = np.sqrt(np.max(np.sum((y - pairs.positions) ** 2, axis=1)))
        moved += np.sqrt(np.max(np.sum(dy**2, axis=1)))
        if self._unlisted - 2 * moved <= np.sqrt(0.5) * float(longest.max()):
            return False
        near, start, neighbours = self._near
        return bool(
            _stay_apart(y, dy, pairs.first, pairs.second, longest, start, neighbours)
            and _stay_apart(y, dy, near[0], near[1], longest, start, neighbours)
        )

    def intersects(self, y: FloatArray) -> bool:
        """Whether triangles of the sampled midsurface intersect at ``y (k, 3)``."""
        return bool(ipctk.has_intersections(self.mesh, np.asfortranarray(y)))


def _near_at_rest(
    sheet: Sheet, triangles: IntArray
) -> tuple[NDArray[np.int32], IntArray, IntArray]:
    """Pairs ``(2, p)`` that the search may omit at any distance, and neighbours of each point.

    The neighbours are given by their starts ``(k + 1,)`` and their numbers.
    """
    rest, thickness = sheet.rest, sheet.thickness
    n = len(rest)
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    step = sparse.coo_array((np.ones(len(edges)), edges.T), shape=(n, n)).tocsr()
    step = step + step.T + sparse.eye_array(n)
    reached = step
    for _ in range(RINGS - 1):
        reached = (reached @ step).tocsr()
    reached.sort_indices()
    # Their reach is NEIGHBOUR times the distance at rest, less than the reference distance.
    share = sheet.distance / NEIGHBOUR
    pairs = cKDTree(rest).query_pairs(share * float(thickness.max()), output_type="ndarray")
    apart = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1)
    pairs = pairs[apart < share * 0.5 * thickness[pairs].sum(axis=1)]
    start, neighbours = reached.indptr.astype(np.int64), reached.indices.astype(np.int64)
    return np.ascontiguousarray(pairs.T, dtype=np.int32), start, neighbours


@nb.njit(cache=True)
def _longest_edges(y: FloatArray, dy: FloatArray, triangles: IntArray) -> FloatArray:
    """Longest edge ``(k,)`` of the triangles around each point during the move."""
    out = np.zeros(len(y))
    for t in range(len(triangles)):
        longest = 0.0
        for s in range(3):
            i, j = triangles[t, s], triangles[t, (s + 1) % 3]
            now, then = 0.0, 0.0
            for c in range(3):
                edge = y[i, c] - y[j, c]
                now += edge * edge
                then += (edge + dy[i, c] - dy[j, c]) ** 2
            longest = max(longest, now, then)
        for s in range(3):
            out[triangles[t, s]] = max(out[triangles[t, s]], longest)
    return np.sqrt(out)


@nb.njit(cache=True, inline="always")
def approaching(y: FloatArray, dy: FloatArray, i: int, j: int) -> tuple[float, float, float]:
    """Products of the vector r between two points and its change s: r.r, r.s and s.s."""
    rr, rd, dd = 0.0, 0.0, 0.0
    for c in range(3):
        r = y[i, c] - y[j, c]
        s = dy[i, c] - dy[j, c]
        rr += r * r
        rd += r * s
        dd += s * s
    return rr, rd, dd


@nb.njit(cache=True)
def _stay_apart(
    y: FloatArray,
    dy: FloatArray,
    first: NDArray[np.int32],
    second: NDArray[np.int32],
    longest: FloatArray,
    start: IntArray,
    neighbours: IntArray,
) -> bool:
    """Whether all pairs except neighbours stay too far apart for their triangles to meet."""
    for k in range(len(first)):
        i, j = first[k], second[k]
        rr, rd, dd = approaching(y, dy, i, j)
        if rd < 0.0:
            t = min(1.0, -rd / dd)
            rr += t * (2.0 * rd + t * dd)
        a, b = longest[i] ** 2, longest[j] ** 2
        if rr <= max((a + b) / 4.0, max(a, b) / 3.0):
            own = neighbours[start[i] : start[i + 1]]
            at = np.searchsorted(own, j)
            if at == len(own) or own[at] != j:
                return False
    return True
