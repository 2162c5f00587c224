"""Parts of a valve as other programs draw them: a leaflet as a disc, chordae as lines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mvest.cases.chord_layout import FAMILIES
from mvest.cases.tissue import CHORD_COLUMNS
from mvest.errors import GeometryError, InputError
from mvest.exchange.regions import RegionSurface, merged
from mvest.reading.text import write_columns
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.triangles import areas, surface_edges

MAX_HOLE = 0.2
"""Of a leaflet's boundary: how long that of a hole may be, which is closed."""
MARGINAL_MM = 4.0
"""From the free edge, within which a chord inserts as marginal ones do."""
MAX_AWAY = 3.0
"""mm from where a chord begins to its papillary tip."""


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
        nothing = np.zeros(len(triangles), dtype=np.int64)
        whole = merged(RegionSurface(vertices, triangles, nothing, {}))
        points, faces = whole.vertices, whole.triangles
        apart = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        faces = _largest_piece(points, faces[apart & (areas(points, faces) > 0)])
        loops = sorted(boundary_loops(faces), key=lambda loop: -loop_length(points[loop]))
        if not loops:
            raise GeometryError(
                "a closed surface, expected one side of a leaflet: an open surface that ends at "
                "the annulus and at the free edge"
            )
        outer, *holes = loops
        for hole in holes:
            around = [loop_length(points[loop]) for loop in (outer, hole)]
            if around[1] > MAX_HOLE * around[0]:
                raise GeometryError(
                    f"boundaries of {around[0]:.0f} and {around[1]:.0f} mm, expected one: a "
                    "leaflet that ends at the annulus and at the free edge"
                )
            middle = np.full(len(hole), len(points))
            faces = np.vstack([faces, np.column_stack([np.roll(hole, -1), hole, middle])])
            points = np.vstack([points, points[hole].mean(axis=0)])
        used, inverse = np.unique(faces, return_inverse=True)
        loop = np.searchsorted(used, outer)
        return cls(points[used], inverse.reshape(-1, 3), loop, len(holes))

    @property
    def curve(self) -> FloatArray:
        """``(k, 3)`` mm, the boundary."""
        return self.vertices[self.loop]

    def turned(self) -> Leaflet:
        """The same with its triangles facing the other way."""
        return Leaflet(self.vertices, self.triangles[:, ::-1], self.loop[::-1], self.holes)

    def arcs(self, first: FloatArray, second: FloatArray) -> tuple[IntArray, IntArray]:
        """The loop from the vertex nearest to a point to that nearest to another, and the rest.

        Both arcs have both ends.
        """
        curve = self.curve
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


def chord_lines(segments: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Chords from papillary tip to insertion of segments that may branch.

    Parameters
    ----------
    segments : (k, 2, 3) mm
        Each from where it begins to where it ends; a branch begins where its trunk ends.

    Returns
    -------
    chords : (c, 2, 3) mm
        From tip to insertion.
    lengths : (c,) mm
        Along trunk and branch.
    tips : (t, 3) mm
    """
    joints, number = np.unique(np.round(segments.reshape(-1, 3), 3), axis=0, return_inverse=True)
    begin, end = number.reshape(-1, 2).T
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    trunk = {int(e): k for k, e in enumerate(end)}
    last = np.flatnonzero(~np.isin(end, begin))
    first, total = [], []
    for k in last.tolist():
        way, root = {k: None}, k
        while (before := trunk.get(int(begin[root]))) is not None and before not in way:
            root = before
            way[root] = None
        first.append(root)
        total.append(length[list(way)].sum())
    chords = np.stack([segments[first, 0], segments[last, 1]], axis=1)
    return chords, np.array(total), joints[np.unique(begin[first])]


def write_chords(
    folder: Path, seen: tuple[FloatArray, FloatArray], tips: FloatArray, free_edge: FloatArray
) -> tuple[dict[str, Any], str]:
    """Write the table of a case's chordae: chords ``(c, 2, 3)`` and lengths ``(c,)``, mm.

    Returns its entry in ``case.yaml`` and a sentence about families and stiffness, of which such
    models say nothing.

    Raises
    ------
    InputError
        Chords begin elsewhere than at the tips ``(t, 3)``.
    """
    chords, lengths = seen
    away = np.linalg.norm(chords[:, 0, None] - tips, axis=2)
    if away.min(axis=1).max() > MAX_AWAY:
        raise InputError("chords begin elsewhere than at the papillary tips; leave out tips=...")
    layout, insertion = ChordLayout(), chords[:, 1]
    family = np.where(cKDTree(free_edge).query(insertion)[0] > MARGINAL_MM, 1, 0)
    # As stiff together as the template's, of which there may be fewer.
    marginal = len(layout.marginal_phi) * layout.marginal_stiffness
    basal = len(layout.basal) * layout.basal_stiffness
    count = np.bincount(family, minlength=2)
    each = 2 * np.array([marginal, basal]) / np.maximum(count, 1)
    names = [FAMILIES[k] for k in family]
    columns = (away.argmin(axis=1), *insertion.T, names, lengths, each[family])
    rows = zip(*(np.asarray(column).tolist() for column in columns), strict=True)
    write_columns(folder / "chordae.csv", CHORD_COLUMNS, rows)
    return {"chordae": {"file": "chordae.csv", "families": list(FAMILIES)}}, (
        f"chordae: {len(chords)} of the export, as long as there; the {count[0]} within "
        f"{MARGINAL_MM:g} mm of the free edge are marginal; as stiff together as the template's"
    )
