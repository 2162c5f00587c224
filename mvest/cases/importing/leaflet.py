"""One leaflet as a disc, of a surface that another program cut out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mvest.cases.surface_files import RegionSurface, merged
from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.triangles import areas, surface_edges

MAX_HOLE = 0.2
"""Of a leaflet's boundary: how long that of a hole may be, which is closed."""


@dataclass(frozen=True, slots=True, eq=False)
class Leaflet:
    """One leaflet as a disc.

    Attributes
    ----------
    vertices, triangles
        ``(n, 3)`` mm and ``(m, 3)``.
    loop
        ``(k,)`` its boundary, in the direction of its triangles.
    holes : int
        How many were closed.
    """

    vertices: FloatArray
    triangles: IntArray
    loop: IntArray
    holes: int

    @classmethod
    def of(cls, vertices: FloatArray, triangles: IntArray) -> Leaflet:
        """The largest piece of a surface, with coincident vertices made one and holes closed.

        Raises
        ------
        GeometryError
            It is closed, no manifold, or has a hole that is a second boundary.
        """
        whole = merged(
            RegionSurface(vertices, triangles, np.zeros(len(triangles), dtype=np.int64), {})
        )
        faces = whole.triangles
        apart = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        faces = faces[apart & (areas(whole.vertices, faces) > 0)]
        faces = _largest_piece(whole.vertices, faces)
        loops = boundary_loops(faces)
        if not loops:
            raise GeometryError(
                "a closed surface, expected one side of a leaflet: an open surface that ends at "
                "the annulus and at the free edge"
            )
        length = [loop_length(whole.vertices[loop]) for loop in loops]
        outer = int(np.argmax(length))
        points = [whole.vertices]
        n = len(whole.vertices)
        for number, loop in enumerate(loops):
            if number == outer:
                continue
            if length[number] > MAX_HOLE * length[outer]:
                raise GeometryError(
                    f"boundaries of {length[outer]:.0f} and {length[number]:.0f} mm, expected one: "
                    "a leaflet that ends at the annulus and at the free edge"
                )
            points.append(whole.vertices[loop].mean(axis=0, keepdims=True))
            fan = np.column_stack([np.roll(loop, -1), loop, np.full(len(loop), n)])
            faces = np.concatenate([faces, fan])
            n += 1
        used, inverse = np.unique(faces, return_inverse=True)
        faces = inverse.reshape(-1, 3)
        loop = np.searchsorted(used, loops[outer])
        return cls(np.concatenate(points)[used], faces, loop, len(loops) - 1)

    def turned(self) -> Leaflet:
        """The same with its triangles facing the other way."""
        return Leaflet(self.vertices, self.triangles[:, ::-1], self.loop[::-1], self.holes)

    def arcs(self, first: FloatArray, second: FloatArray) -> tuple[IntArray, IntArray]:
        """The loop from the vertex nearest to a point to that nearest to another, and the rest.

        Both arcs have both ends.
        """
        curve = self.vertices[self.loop]
        start, stop = (
            int(np.argmin(np.linalg.norm(curve - point, axis=1))) for point in (first, second)
        )
        if start == stop:
            raise GeometryError(
                "both commissures are at the same vertex of a leaflet; are they those of this "
                "valve, in the same axes?"
            )
        turned = np.roll(self.loop, -start)
        cut = (stop - start) % len(turned)
        return turned[: cut + 1], np.append(turned[cut:], turned[0])


def loop_length(curve: FloatArray) -> float:
    """Length (mm) of a closed curve ``(k, 3)``."""
    return float(np.linalg.norm(curve - np.roll(curve, -1, axis=0), axis=1).sum())


def _largest_piece(vertices: FloatArray, triangles: IntArray) -> IntArray:
    edges = surface_edges(triangles)
    n = len(vertices)
    graph = coo_matrix((np.ones(len(edges), dtype=np.int8), edges.T), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    of_triangle = label[triangles[:, 0]]
    area = np.bincount(of_triangle, weights=areas(vertices, triangles))
    return triangles[of_triangle == np.argmax(area)]
