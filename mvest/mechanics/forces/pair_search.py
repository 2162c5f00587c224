"""Which points of a sampled surface can come into contact: a search over cubes of space."""

from __future__ import annotations

import numba as nb
import numpy as np

from mvest.typing import FloatArray, IntArray

__all__ = ["NEIGHBOUR", "search_pairs"]

NEIGHBOUR = 0.8
"""Reach of a pair over its rest distance, at most: a sheet touches itself from 20 % compression."""


@nb.njit(cache=True)
def _cells(y: FloatArray, size: float) -> tuple[IntArray, IntArray, IntArray]:
    """Points sorted into cubes of the given size: cube of each point, first of each, members."""
    n = len(y)
    low = np.array([y[:, c].min() for c in range(3)])
    counts = np.array([int((y[:, c].max() - low[c]) / size) + 1 for c in range(3)])
    place = np.empty((n, 3), dtype=np.int64)
    start = np.zeros(counts[0] * counts[1] * counts[2] + 1, dtype=np.int64)
    for i in range(n):
        for c in range(3):
            place[i, c] = min(int((y[i, c] - low[c]) / size), counts[c] - 1)
        start[(place[i, 0] * counts[1] + place[i, 1]) * counts[2] + place[i, 2] + 1] += 1
    start = np.cumsum(start)
    filled = start.copy()
    members = np.empty(n, dtype=np.int64)
    for i in range(n):
        k = (place[i, 0] * counts[1] + place[i, 1]) * counts[2] + place[i, 2]
        members[filled[k]] = i
        filled[k] += 1
    return np.concatenate((counts, place.ravel())), start, members


@nb.njit(cache=True)
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
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Candidate pairs (first, second, reach, reference) in the order of their hosts."""
    n = len(y)
    grid, start, members = _cells(y, radius)
    n0, n1, n2 = grid[0], grid[1], grid[2]
    place = grid[3:].reshape(n, 3)
    size = 64 * n
    first, second = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64)
    reach, reference = np.empty(size), np.empty(size)
    count = 0
    for p in range(n):
        i = by_host[p]
        for a in range(max(place[i, 0] - 1, 0), min(place[i, 0] + 2, n0)):
            for b in range(max(place[i, 1] - 1, 0), min(place[i, 1] + 2, n1)):
                row = (a * n1 + b) * n2
                begin = start[row + max(place[i, 2] - 1, 0)]
                end = start[row + min(place[i, 2] + 2, n2)]
                for q in range(begin, end):
                    j = members[q]
                    if host[j] < host[i] or (host[j] == host[i] and j <= i):
                        continue
                    rr = 0.0
                    for c in range(3):
                        rr += (y[i, c] - y[j, c]) ** 2
                    if rr >= radius * radius:
                        continue
                    mean = 0.5 * (thickness[i] + thickness[j])
                    full = activation * mean
                    apart = 0.0
                    for c in range(3):
                        apart += (rest[i, c] - rest[j, c]) ** 2
                    near = min(full, NEIGHBOUR * np.sqrt(apart))
                    # Neighbours that would have to be compressed to half their rest distance
                    # never touch.
                    if rr >= (near + skin) ** 2 or near <= 0.5 * distance * mean:
                        continue
                    if count == size:
                        size *= 2
                        first, second = _grown(first, size), _grown(second, size)
                        reach, reference = _grown(reach, size), _grown(reference, size)
                    first[count], second[count] = i, j
                    reach[count] = near
                    reference[count] = distance * mean * near / full
                    count += 1
    order = _sort_by_second_host(first, second, count, host)
    return first[order], second[order], reach[order], reference[order]


@nb.njit(cache=True)
def _grown(values: np.ndarray, size: int) -> np.ndarray:
    out = np.empty(size, dtype=values.dtype)
    out[: len(values)] = values
    return out


@nb.njit(cache=True)
def _sort_by_second_host(first: IntArray, second: IntArray, count: int, host: IntArray) -> IntArray:
    """Stable order by the host of ``second`` within each run of equal hosts of ``first``."""
    order = np.empty(count, dtype=np.int64)
    bins = np.zeros(host.max() + 2, dtype=np.int64)
    begin = 0
    while begin < count:
        end = begin
        owner = host[first[begin]]
        while end < count and host[first[end]] == owner:
            end += 1
        bins[:] = 0
        for k in range(begin, end):
            bins[host[second[k]] + 1] += 1
        bins = np.cumsum(bins)
        for k in range(begin, end):
            h = host[second[k]]
            order[begin + bins[h]] = k
            bins[h] += 1
        begin = end
    return order
