"""Shapes and fields of one case as its run stored them, rotated so that the atrium is on top.

All drawings of a case read them here. Arrays that a run did not store are None.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reading.text import one_line
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, Valve, leverage

POINTS = "observed_points_"
NEEDED = ("triangles", "region", "rest", "annulus", "seen")
"""Arrays that every case has."""
NO_INDEX: IntArray = np.empty(0, dtype=np.int64)
TURNED = ("rest", "tips", "observed", "generic", "fitted", "chord_junction")
TYPES: Mapping[str, type] = {
    "seen": bool,
    **dict.fromkeys(("triangles", "region", "annulus", "free_edge"), np.int64),
    **dict.fromkeys(("chord_tip", "chord_insertion", "chord_parent"), np.int64),
    **dict.fromkeys((*TURNED, "chord_weights", "distance_generic", "distance_fitted"), np.float64),
}
"""Array -> type of its elements."""


@dataclass(frozen=True, slots=True, eq=False)
class CaseFields:
    """A valve at rest, with its observed and predicted shapes in ``f`` further frames."""

    triangles: IntArray  #: (m, 3)
    region: IntArray  #: (m,), leaflet of each triangle
    rest: FloatArray  #: (n, 3) mm, the open valve in the reference frame
    annulus: IntArray  #: (k,), vertices in loop order
    frames: tuple[str, ...]  #: ``f`` names, without the reference frame
    seen: BoolArray  #: (f,), whether the filter received a frame
    tips: FloatArray  #: (f + 1, t, 3) mm, papillary tips, in the reference frame first
    #: ``(q, 3)`` mm for a frame without correspondence to the reference frame.
    observed_points: Mapping[str, FloatArray]
    leaflets: tuple[str, ...] = ()  #: names of the regions, in the order of their numbers
    free_edge: IntArray = field(default_factory=lambda: NO_INDEX)  #: (k,), vertices in loop order
    chord_tip: IntArray = field(default_factory=lambda: NO_INDEX)  #: (k,), of the chords' segments
    #: ``(c,)`` vertices at the leaflet ends, or ``(k,)`` if the junctions are points too
    chord_insertion: IntArray = field(default_factory=lambda: NO_INDEX)
    #: ``(k,)`` junction at which each segment starts, or -1; none if no chord branches
    chord_parent: IntArray = field(default_factory=lambda: NO_INDEX)
    chord_junction: FloatArray | None = None  #: (j, 3) mm, in the reference frame
    #: ``(j, c)``, shares of the leaflet ends' displacement that each junction follows
    chord_weights: FloatArray | None = None
    observed: FloatArray | None = None  #: ``(f, n, 3)`` mm; NaN for unobserved vertices
    generic: FloatArray | None = None  #: ``(f, n, 3)`` mm; NaN for unobserved vertices
    fitted: FloatArray | None = None  #: ``(f, n, 3)`` mm; NaN for unobserved vertices
    #: ``(f, n)`` mm from the observation; NaN for unobserved vertices.
    distance_generic: FloatArray | None = None
    distance_fitted: FloatArray | None = None
    reach_mm: float | None = None  #: distance of midsurfaces below which leaflets touch

    @property
    def closed(self) -> int:
        """Index of the first frame that the filter received, else of the first frame."""
        return int(np.argmax(self.seen))

    @property
    def vertex_region(self) -> IntArray:
        """Leaflet ``(n,)`` of each vertex: the smallest index among its triangles."""
        result = np.full(len(self.rest), self.region.max(initial=0), dtype=np.int64)
        np.minimum.at(result, self.triangles.ravel(), np.repeat(self.region, 3))
        return result

    def chords(self, points: FloatArray, frame: int) -> FloatArray:
        """Ends ``(k, 2, 3)`` of the chordae's segments; frame 0 is the reference frame.

        Junctions without a known place follow tips and leaflet ends as in `Chordae.moved`.
        """
        end, tip = points[self.chord_insertion], self.tips[frame][self.chord_tip]
        if self.chord_junction is not None and self.chord_weights is not None:
            weights, trunks = self.chord_weights, slice(len(end), None)
            held = (1 - weights.sum(axis=1, keepdims=True)) * (
                tip[trunks] - self.tips[0][self.chord_tip[trunks]]
            )
            # The junction of an unseen end is drawn as if the end did not move.
            moved = np.nan_to_num(end - self.rest[self.chord_insertion])
            end = np.concatenate([end, self.chord_junction + held + weights @ moved])
        start = np.array(tip)
        if len(self.chord_parent):
            on = self.chord_parent >= 0
            first = len(end) - 1 - int(self.chord_parent.max())
            start[on] = end[first + self.chord_parent[on]]
        return np.stack([start, end], axis=1)


def as_stored(arrays: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Arrays as runs store them: int32 indices, single precision positions."""
    stored = {name: np.asarray(values) for name, values in arrays.items()}
    for name, values in stored.items():
        if values.dtype.kind == "i":
            stored[name] = values.astype(np.int32)
        elif values.dtype.kind == "f" and values.shape[-1:] == (3,):
            stored[name] = values.astype(np.float32)
    return stored


def chord_fields(chordae: Chordae, vertices: FloatArray) -> dict[str, Any]:
    """The arrays of chordae that insert at the nearest of the ``vertices (n, 3)`` mm."""
    fields = {
        "chord_tip": chordae.tip,
        "chord_insertion": cKDTree(vertices).query(chordae.insertion)[1],
    }
    if not len(chordae.junction):
        return fields
    weights = leverage(chordae.parent, chordae.rest_length, len(chordae.insertion))
    return fields | {
        "chord_parent": chordae.parent,
        "chord_junction": chordae.junction,
        "chord_weights": weights,
    }


def valve_fields(valve: Valve, frames: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of a valve for `case_fields`; callers add the shapes of the frames."""
    surface = valve.surface
    return as_stored(
        {
            "triangles": surface.triangles,
            "region": surface.region,
            "leaflets": list(surface.region_names),
            "rest": surface.vertices,
            "annulus": valve.annulus,
            "free_edge": valve.free_edge,
            "frames": list(frames),
            "seen": [True] * len(frames),
            "tips": [valve.papillary_tips] * (1 + len(frames)),
        }
    )


def case_fields(arrays: Mapping[str, Any] | Path, *, turned: bool = True) -> CaseFields:
    """The fields of a case, rotated: z to the atrium, the first leaflet towards positive y.

    InputError if arrays are missing or cannot be read.

    Parameters
    ----------
    arrays : mapping or Path
        `NEEDED` and ``frames``; the others as in `CaseFields`, and ``observed_points_<frame>``. Or
        their ``.npz`` file.
    turned : bool
        False: keep the axes of the case.
    """
    where = "arrays"
    try:
        if isinstance(arrays, Path):
            where = str(arrays)
            arrays = read_npz(arrays, where=arrays.name)
        values: dict[str, Any] = {
            name: np.asarray(arrays[name], dtype=kind)
            for name, kind in TYPES.items()
            if name in arrays or name in NEEDED
        }
        frames = tuple(map(str, arrays["frames"]))
        leaflets = tuple(map(str, arrays.get("leaflets", ())))
        values.setdefault("tips", np.empty((len(frames) + 1, 0, 3)))
        points = {
            name.removeprefix(POINTS): np.asarray(array, dtype=np.float64)
            for name, array in arrays.items()
            if name.startswith(POINTS)
        }
        reach = float(arrays["reach_mm"]) if "reach_mm" in arrays else None
        fields = CaseFields(
            frames=frames, leaflets=leaflets, observed_points=points, reach_mm=reach, **values
        )
        if not turned:
            return fields
        middle, axes = turn_of(
            fields.rest, fields.annulus, fields.triangles, fields.region, fields.tips[0]
        )
        shapes = {name: (values[name] - middle) @ axes for name in TURNED if name in values}
        points = {name: (array - middle) @ axes for name, array in points.items()}
        return replace(fields, observed_points=points, **shapes)
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{where}: no fields of a case ({one_line(error, 200)})") from error


def turn_of(
    rest: FloatArray, annulus: IntArray, triangles: IntArray, region: IntArray, tips: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Centre ``(3,)`` and axes ``(3, 3)`` of a valve: annulus horizontal, tips below it.

    ``(points - centre) @ axes`` rotates; the first leaflet then lies towards positive y.
    """
    ring = rest[annulus]
    middle = ring.mean(axis=0)
    up = np.linalg.svd(ring - middle, full_matrices=False)[2][2]
    below = tips if len(tips) else rest
    if (below.mean(axis=0) - middle) @ up > 0:
        up = -up
    front = rest[np.unique(triangles[region == region.min()])].mean(axis=0) - middle
    front -= (front @ up) * up
    front /= np.linalg.norm(front)
    return middle, np.stack([np.cross(front, up), front, up], axis=1)
