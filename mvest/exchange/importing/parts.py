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


MARGINAL_MM = 4.0
"""From the free edge, within which a chord inserts as marginal ones do."""
MAX_AWAY = 3.0
"""mm from where a chord begins to its papillary tip."""


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
    chords, lengths, tips = [], [], []
    for k in range(len(segments)):
        if end[k] in begin:
            continue
        root, total, seen = k, float(length[k]), {k}
        while (before := trunk.get(int(begin[root]))) is not None and before not in seen:
            root, total = before, total + float(length[before])
            seen.add(before)
        chords.append([segments[root, 0], segments[k, 1]])
        lengths.append(total)
        tips.append(int(begin[root]))
    return (
        np.array(chords).reshape(-1, 2, 3),
        np.array(lengths),
        joints[sorted(set(tips))].reshape(-1, 3),
    )


def write_chords(
    folder: Path,
    chords: FloatArray,
    lengths: FloatArray,
    tips: FloatArray,
    free_edge: FloatArray,
    derived: list[str],
) -> dict[str, Any]:
    """Write the table of a case's chordae; returns its entry in ``case.yaml``.

    Parameters
    ----------
    folder
    chords, lengths
        ``(c, 2, 3)`` from tip to insertion and ``(c,)``, mm.
    tips, free_edge
        ``(t, 3)`` and ``(k, 3)`` mm.
    derived
        Gets a sentence about families and stiffness, of which such models say nothing.

    Raises
    ------
    InputError
        Chords begin elsewhere than at the tips.
    """
    away = np.linalg.norm(chords[:, 0, None] - tips, axis=2)
    if away.min(axis=1).max() > MAX_AWAY:
        raise InputError("chords begin elsewhere than at the papillary tips; leave out tips=...")
    layout, insertion = ChordLayout(), chords[:, 1]
    to_edge = np.atleast_1d(cKDTree(free_edge).query(insertion)[0])
    family = np.where(to_edge > MARGINAL_MM, 1, 0)
    # As stiff together as the template's, of which there may be fewer.
    marginal = len(layout.marginal_phi) * layout.marginal_stiffness
    basal = len(layout.basal) * layout.basal_stiffness
    count = np.bincount(family, minlength=2)
    each = 2 * np.array([marginal, basal]) / np.maximum(count, 1)
    write_columns(
        folder / "chordae.csv",
        CHORD_COLUMNS,
        zip(
            away.argmin(axis=1).tolist(),
            *insertion.T.tolist(),
            [FAMILIES[k] for k in family],
            lengths.tolist(),
            each[family].tolist(),
            strict=True,
        ),
    )
    derived.append(
        f"chordae: {len(chords)} of the export, as long as there; the {count[0]} within "
        f"{MARGINAL_MM:g} mm of the free edge are marginal; as stiff together as the template's"
    )
    return {"chordae": {"file": "chordae.csv", "families": list(FAMILIES)}}
