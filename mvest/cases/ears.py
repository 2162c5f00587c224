"""Triangles of a band that lie on one of its edges with all three corners.

Decimation and remeshing leave such ears. The coordinate from annulus to free edge, from which
fibres and chordae are laid out, does not vary in them. Turning the edge that an ear shares with its
neighbour cures it without moving a vertex.
"""

from __future__ import annotations

import numpy as np

from mvest.errors import GeometryError
from mvest.typing import IntArray
from mvest.valve.geometry.surface_coordinates import boundary_loops


def without_ears(triangles: IntArray) -> tuple[IntArray, IntArray]:
    """The triangles with the inner edges of ears turned, where that can be done.

    What is turned depends on the numbers of the vertices alone, so that surfaces that correspond
    still do. A surface that is no band is left as it is: to refuse it is the checks' part.

    Parameters
    ----------
    triangles : ndarray
        ``(m, 3)``.

    Returns
    -------
    triangles : ndarray
        ``(m, 3)``.
    ears : ndarray
        ``(k,)`` those that were cured.
    """
    none = np.zeros(0, dtype=np.int64)
    try:
        loops = boundary_loops(triangles)
    except GeometryError:
        return triangles, none
    if len(loops) != 2:
        return triangles, none
    loop_of = np.full(int(triangles.max()) + 1, -1)
    for number, loop in enumerate(loops):
        loop_of[loop] = number
    corners = [tuple(triangle) for triangle in triangles.tolist()]
    owner = {edge: t for t, triangle in enumerate(corners) for edge in _edges(triangle)}
    cured = []
    while turned := [t for t in _ears(corners, loop_of) if _turn(corners, owner, t, loop_of)]:
        cured += turned
    return np.array(corners, dtype=np.int64), np.unique(np.array(cured, dtype=np.int64))


def _edges(triangle: tuple[int, ...]) -> list[tuple[int, int]]:
    a, b, c = triangle
    return [(a, b), (b, c), (c, a)]


def _ears(triangles: list[tuple[int, ...]], loop_of: IntArray) -> list[int]:
    on = loop_of[np.array(triangles)]
    same = (on[:, 0] >= 0) & (on[:, 0] == on[:, 1]) & (on[:, 0] == on[:, 2])
    ears: list[int] = np.flatnonzero(same).tolist()
    return ears


def _turn(
    triangles: list[tuple[int, ...]],
    owner: dict[tuple[int, int], int],
    ear: int,
    loop_of: IntArray,
) -> bool:
    """Turn an inner edge of an ear, if there is a neighbour with a corner elsewhere."""
    for b, c in _edges(triangles[ear]):
        neighbour = owner.get((c, b))
        if neighbour is None:
            continue
        (a,) = set(triangles[ear]) - {b, c}
        (d,) = set(triangles[neighbour]) - {b, c}
        # The turned edge must be new: two sheets would be joined otherwise.
        if loop_of[d] == loop_of[a] or (a, d) in owner or (d, a) in owner:
            continue
        del owner[b, c], owner[c, b]
        for t, triangle in ((ear, (a, b, d)), (neighbour, (a, d, c))):
            triangles[t] = triangle
            owner.update(dict.fromkeys(_edges(triangle), t))
        return True
    return False
