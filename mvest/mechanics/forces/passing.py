"""Whether sampled sheets pass through each other: proved of distances, or detected.

That no step takes triangles of the sampled midsurface through each other mostly follows from how
far apart the points stay. Where an edge of length a meets one of length b, or a point a triangle
whose edges are at most a long, the average of the squared distances of the ends, weighted by where
the meeting lies, is at most :math:`(a^2 + b^2)/4` or :math:`a^2/3`: two points are at least so
near. The length of an edge is convex along a step, so that its ends bound it. Listed pairs are
looked at one by one; those that the search has left out are apart by its skin, less what points
have moved since. Where this proves nothing, continuous collision detection decides (Li et al. 2020,
ACM Trans. Graph. 39(4):49, by the IPC toolkit). Neighbours within the sheet always are too near for
the proof, and no time step is accepted whose triangles intersect: it is repeated with detection
throughout.
"""

from __future__ import annotations

import ipctk
import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from mvest.mechanics.forces.pair_search import NEIGHBOUR, ContactPairs
from mvest.mechanics.settings import ContactSettings
from mvest.typing import FloatArray, IntArray

HARMLESS = 0.02
"""mm; a step that moves no point farther cannot take sheets through each other."""

CLEARANCE = 1e-3
"""mm between midsurfaces that touch nowhere: equilibria keep a part of their thickness. Detection
of collisions from a distance of zero does not end."""

MAX_SUBDIVISIONS = 100_000
"""Of one pair's times while a collision is looked for, 10 MB; a pair in doubt then counts as
colliding (Wang et al. 2021, ACM Trans. Graph. 40:188, section 5)."""

_DETECTION = ipctk.TightInclusionCCD(max_iterations=MAX_SUBDIVISIONS)
# It warns on stdout of sheets that touch, which the step's outcome says.
ipctk.set_logger_level(ipctk.LoggerLevel.error)

RINGS = 3
"""Edges between points that count as neighbours within the sheet."""


class Passing:
    """Guards a triangulated sheet of points against passing through itself.

    Parameters
    ----------
    rest : ndarray
        ``(k, 3)`` mm, the points at rest.
    thickness : ndarray
        ``(k,)`` mm.
    triangles : ndarray
        ``(t, 3)`` of the points.
    settings : ContactSettings
    skin : float
        mm by which the search for pairs exceeds their reach.
    """

    def __init__(
        self,
        rest: FloatArray,
        thickness: FloatArray,
        triangles: IntArray,
        settings: ContactSettings,
        skin: float,
    ) -> None:
        self._triangles = triangles
        self._near = _near_at_rest(rest, thickness, triangles, settings)
        # A pair that is neither listed nor near at rest has the reference distance for its reach at
        # least.
        self._unlisted = settings.reference_distance * float(thickness.min()) + skin
        faces = np.asfortranarray(triangles, dtype=np.int32)
        self.mesh = ipctk.CollisionMesh(np.asfortranarray(rest), ipctk.edges(faces), faces)

    def free_share(
        self, pairs: ContactPairs, y: FloatArray, dy: FloatArray, *, detect: bool = False
    ) -> float:
        """Share of the move ``dy (k, 3)`` mm from ``y (k, 3)`` that takes no sheet through another.

        With ``detect`` collisions are looked for even where distances exclude them.
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
        """Whether points that are no neighbours are proved too far apart for triangles to meet."""
        longest = _longest_edges(y, dy, self._triangles)
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
    rest: FloatArray, thickness: FloatArray, triangles: IntArray, settings: ContactSettings
) -> tuple[NDArray[np.int32], IntArray, IntArray]:
    """Pairs ``(2, p)`` that a search may leave out at any distance, and the neighbours of points.

    The neighbours of point i are those from ``start[i]`` to ``start[i + 1]``.
    """
    n = len(rest)
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    step = sparse.coo_array((np.ones(len(edges)), edges.T), shape=(n, n)).tocsr()
    step = step + step.T + sparse.eye_array(n)
    reached = step
    for _ in range(RINGS - 1):
        reached = (reached @ step).tocsr()
    reached.sort_indices()
    # Their reach is NEIGHBOUR times the distance at rest; beyond this it is the reference distance.
    share = settings.reference_distance / NEIGHBOUR
    pairs = cKDTree(rest).query_pairs(share * float(thickness.max()), output_type="ndarray")
    apart = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1)
    pairs = pairs[apart < share * 0.5 * thickness[pairs].sum(axis=1)]
    start, neighbours = reached.indptr.astype(np.int64), reached.indices.astype(np.int64)
    return np.ascontiguousarray(pairs.T, dtype=np.int32), start, neighbours


@nb.njit(cache=True)
def _longest_edges(y: FloatArray, dy: FloatArray, triangles: IntArray) -> FloatArray:
    """Longest edge ``(k,)`` of the triangles around each point, anywhere along the move."""
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
    """Whether all pairs but neighbours stay farther apart than those of triangles that meet."""
    for k in range(len(first)):
        i, j = first[k], second[k]
        rr, rd, dd = 0.0, 0.0, 0.0
        for c in range(3):
            r = y[i, c] - y[j, c]
            s = dy[i, c] - dy[j, c]
            rr += r * r
            rd += r * s
            dd += s * s
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
