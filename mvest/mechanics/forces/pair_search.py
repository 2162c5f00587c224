"""Which points of a sampled surface can come into contact: a search over cubes of space."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.typing import FloatArray, IntArray

NEIGHBOUR = 0.8
"""Reach of a pair over its rest distance, at most: a sheet touches itself from 20 % compression."""
FINENESS = 2
"""Cubes along the search radius: smaller ones enclose the sphere of that radius more closely."""
EXPECTED = 72
"""Pairs of a point for which there is room at first."""


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

    first: NDArray[np.int32]
    second: NDArray[np.int32]
    reach: FloatArray
    reference: FloatArray
    start: IntArray
    hosts: IntArray
    positions: FloatArray


def search_pairs(
    y: FloatArray,
    rest: FloatArray,
    thickness: FloatArray,
    by_host: IntArray,
    host: IntArray,
    activation: float,
    distance: float,
    radius: float,
    skin: float,
) -> ContactPairs:
    """Candidate pairs in the order of their hosts, grouped by them.

    Parameters
    ----------
    y, rest : ndarray
        ``(k, 3)`` mm, points now and at rest.
    thickness : ndarray
        ``(k,)`` mm.
    by_host, host : ndarray
        ``(k,)`` points in the order of their hosts, and the host of each.
    activation, distance : float
        Activation and reference distance over the thickness.
    radius : float
        mm, largest reach of all plus ``skin``.
    skin : float
        mm by which the search exceeds the reach of a pair.
    """
    n = len(y)
    counts, place, first_of, table = _cells(y, by_host, radius / FINENESS)
    ends = np.zeros(n + 1, dtype=np.int64)

    def write(second: NDArray[np.int32]) -> int:
        return _candidates(
            y,
            rest,
            by_host,
            host,
            counts,
            place,
            first_of,
            table,
            thickness,
            activation,
            distance,
            radius,
            skin,
            ends,
            second,
        )

    # Large arrays are made here and not in the kernels: numpy has them on huge pages, and their
    # first use would otherwise take longer than the search.
    second = np.empty(EXPECTED * n, dtype=np.int32)
    count = write(second)
    if count > len(second):
        second = np.empty(count, dtype=np.int32)
        write(second)
    points = np.empty((2, count), dtype=np.int32)
    lengths = np.empty((2, count))
    start, hosts = _grouped(
        rest, thickness, by_host, host, activation, distance, ends, second, points, lengths
    )
    return ContactPairs(points[0], points[1], lengths[0], lengths[1], start, hosts, y.copy())


@nb.njit(cache=True)
def _cells(
    y: FloatArray, by_host: IntArray, size: float
) -> tuple[IntArray, NDArray[np.int32], IntArray, FloatArray]:
    """Cubes of the given size: their number per axis, cube of each point, first and members.

    The members of a cube come by host; where they are is given besides, one axis after the other.
    """
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
    return counts, place, start, table


@nb.njit(cache=True, error_model="numpy")
def _candidates(
    y: FloatArray,
    rest: FloatArray,
    by_host: IntArray,
    host: IntArray,
    counts: IntArray,
    place: NDArray[np.int32],
    start: IntArray,
    table: FloatArray,
    thickness: FloatArray,
    activation: float,
    distance: float,
    radius: float,
    skin: float,
    ends: IntArray,
    second: NDArray[np.int32],
) -> int:
    """How many pairs there are; their second points, as far as there is room for them.

    ``ends[p + 1]`` is where the pairs end whose first point is the p-th by host.
    """
    n = len(y)
    x0, x1, x2 = table[0], table[1], table[2]
    member, owner = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
    for q in range(n):
        member[q] = int(table[3, q])
        owner[q] = host[member[q]]
    near_ones, squares = np.empty(n, dtype=np.int32), np.empty(n)
    n0, n1, n2 = counts
    limit, count = radius * radius, 0
    for p in range(n):
        i = by_host[p]
        y0, y1, y2, own = y[i, 0], y[i, 1], y[i, 2], host[i]
        low = max(place[i, 2] - FINENESS, 0)
        high = min(place[i, 2] + FINENESS + 1, n2)
        for a in range(max(place[i, 0] - FINENESS, 0), min(place[i, 0] + FINENESS + 1, n0)):
            for b in range(max(place[i, 1] - FINENESS, 0), min(place[i, 1] + FINENESS + 1, n1)):
                row = (a * n1 + b) * n2
                some = 0
                for q in range(start[row + low], start[row + high]):
                    rr = (y0 - x0[q]) ** 2 + (y1 - x1[q]) ** 2 + (y2 - x2[q]) ** 2
                    # Written in any case and kept by counting on: nothing for the processor to
                    # predict wrongly.
                    near_ones[some], squares[some] = q, rr
                    some += int((rr < limit) & (owner[q] >= own))
                for k in range(some):
                    j = member[near_ones[k]]
                    if host[j] == own and j <= i:
                        continue
                    mean = 0.5 * (thickness[i] + thickness[j])
                    reach = _reach(rest, i, j, activation * mean)
                    # Neighbours that would have to be compressed to half their rest distance
                    # never touch.
                    if reach <= 0.5 * distance * mean or squares[k] >= (reach + skin) ** 2:
                        continue
                    if count < len(second):
                        second[count] = j
                    count += 1
        ends[p + 1] = count
    return count


@nb.njit(cache=True, inline="always")
def _reach(rest: FloatArray, i: int, j: int, full: float) -> float:
    """Activation distance of a pair: ``full``, or less if it is close at rest."""
    apart = 0.0
    for c in range(3):
        apart += (rest[i, c] - rest[j, c]) ** 2
    return min(full, NEIGHBOUR * np.sqrt(apart))


@nb.njit(cache=True, error_model="numpy")
def _grouped(
    rest: FloatArray,
    thickness: FloatArray,
    by_host: IntArray,
    host: IntArray,
    activation: float,
    distance: float,
    ends: IntArray,
    second: NDArray[np.int32],
    points: NDArray[np.int32],
    lengths: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Write the pairs in the order of both hosts, and their lengths; where groups start, hosts."""
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
                full = activation * mean
                reach = _reach(rest, i, j, full)
                at = place[host[j]]
                place[host[j]] += 1
                points[0, at], points[1, at] = i, j
                lengths[0, at], lengths[1, at] = reach, distance * mean * reach / full
        place[low : high + 1] = 0
        done = after
    start[groups] = count
    return start[: groups + 1].copy(), hosts[:groups].copy()
