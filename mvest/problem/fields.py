"""Shapes and fields of one case as its run stored them, turned so that the atrium is above.

Everything that is drawn of a case is read here once. What a run did not store is None, so that a
report can say so instead of drawing something else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reading.text import one_line
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import Valve

POINTS = "observed_points_"
NEEDED = ("triangles", "region", "rest", "annulus", "frames", "seen")
"""Arrays that every case has."""
INDICES = ("triangles", "region", "annulus", "free_edge", "chord_tip", "chord_insertion")
SEEN = ("observed", "generic", "registered", "fitted", "truth")
"""Shapes in all frames."""
NO_INDEX: IntArray = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class CaseFields:
    """A valve at rest, and how it was seen and predicted in ``f`` further frames.

    Attributes
    ----------
    triangles : ndarray
        ``(m, 3)``.
    region : ndarray
        ``(m,)`` leaflet of each triangle.
    rest : ndarray
        ``(n, 3)`` mm, the valve in the reference frame.
    annulus, free_edge : ndarray
        Vertices in loop order.
    frames : tuple of str
        ``f`` names, the reference frame not among them.
    seen : ndarray
        ``(f,)`` whether the filter was shown the frame.
    tips : ndarray
        ``(f + 1, t, 3)`` mm, papillary tips in the reference frame and then in the others.
    chord_tip, chord_insertion : ndarray
        ``(c,)`` papillary tip and vertex at which each chord begins and ends.
    observed, generic, registered, fitted, truth : ndarray or None
        ``(f, n, 3)`` mm; NaN where a vertex was not seen.
    observed_points : mapping
        ``(q, 3)`` mm for a frame that does not correspond to the reference frame.
    distance_generic, distance_fitted : ndarray or None
        ``(f, n)`` mm from what was observed; NaN where nothing was.
    reach_mm : float or None
        Distance of midsurfaces within which leaflets touch.
    """

    triangles: IntArray
    region: IntArray
    rest: FloatArray
    annulus: IntArray
    frames: tuple[str, ...]
    seen: BoolArray
    tips: FloatArray
    observed_points: Mapping[str, FloatArray]
    free_edge: IntArray = field(default_factory=lambda: NO_INDEX)
    chord_tip: IntArray = field(default_factory=lambda: NO_INDEX)
    chord_insertion: IntArray = field(default_factory=lambda: NO_INDEX)
    observed: FloatArray | None = None
    generic: FloatArray | None = None
    registered: FloatArray | None = None
    fitted: FloatArray | None = None
    truth: FloatArray | None = None
    distance_generic: FloatArray | None = None
    distance_fitted: FloatArray | None = None
    reach_mm: float | None = None

    def __post_init__(self) -> None:
        f, n = len(self.frames), len(self.rest)
        if not f or self.seen.shape != (f,):
            raise InputError(f"{f} frames and seen {self.seen.shape}, expected ({f},) and f > 0")
        if self.region.shape != (len(self.triangles),):
            raise InputError(f"region {self.region.shape}, expected ({len(self.triangles)},)")
        for name in SEEN:
            _check(name, getattr(self, name), (f, n, 3))
        for name in ("distance_generic", "distance_fitted"):
            _check(name, getattr(self, name), (f, n))
        _check("tips", self.tips, (f + 1, None, 3))
        for name in ("triangles", "annulus", "free_edge", "chord_insertion"):
            index = getattr(self, name)
            if index.size and not 0 <= index.min() <= index.max() < n:
                raise InputError(f"{name} names vertices outside 0 to {n - 1}")
        if self.chord_tip.shape != self.chord_insertion.shape or np.any(
            self.chord_tip >= self.tips.shape[1]
        ):
            raise InputError("chord_tip and chord_insertion do not fit each other or the tips")

    @property
    def closed(self) -> int:
        """The first frame that the filter was shown, or the first of all."""
        return int(np.argmax(self.seen))

    @property
    def vertex_region(self) -> IntArray:
        """Leaflet ``(n,)`` of each vertex: the smallest index among its triangles."""
        result = np.full(len(self.rest), self.region.max(initial=0), dtype=np.int64)
        np.minimum.at(result, self.triangles.ravel(), np.repeat(self.region, 3))
        return result

    def chords(self, points: FloatArray, frame: int) -> FloatArray:
        """Ends ``(c, 2, 3)`` of the chordae; ``frame`` counts the reference frame as 0."""
        return np.stack([self.tips[frame][self.chord_tip], points[self.chord_insertion]], axis=1)


def valve_fields(valve: Valve, frames: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of a valve for `case_fields`, to which shapes in frames that were seen are added."""
    surface = valve.surface
    return {
        "triangles": surface.triangles.astype(np.int32),
        "region": surface.region.astype(np.int8),
        "rest": surface.vertices.astype(np.float32),
        "annulus": valve.annulus.astype(np.int32),
        "free_edge": valve.free_edge.astype(np.int32),
        "frames": np.array(frames),
        "seen": np.ones(len(frames), dtype=bool),
        "tips": np.stack([valve.papillary_tips] * (1 + len(frames))).astype(np.float32),
    }


def case_fields(arrays: Mapping[str, Any] | Path, *, turned: bool = True) -> CaseFields:
    """The fields of a case, turned: z to the atrium, the first leaflet towards positive y.

    Parameters
    ----------
    arrays : mapping or Path
        At least ``triangles``, ``region``, ``rest``, ``annulus``, ``frames`` and ``seen``; the
        others as in `CaseFields`, and ``observed_points_<frame>``; or the ``.npz`` file of them.
    turned : bool
        Otherwise it is left in the axes of the case.

    Raises
    ------
    InputError
        If they cannot be read, one of those is missing, or arrays do not fit each other.
    """
    where = "arrays"
    try:
        if isinstance(arrays, Path):
            where = str(arrays)
            arrays = read_npz(arrays, where=arrays.name)
        values = {
            one.name: _value(one.name, arrays[one.name])
            for one in dataclass_fields(CaseFields)
            if one.name in arrays or one.name in NEEDED
        }
        values["observed_points"] = {
            name.removeprefix(POINTS): np.asarray(points, dtype=np.float64)
            for name, points in arrays.items()
            if name.startswith(POINTS)
        }
        values.setdefault("tips", np.empty((len(values["frames"]) + 1, 0, 3)))
        fields = CaseFields(**values)
        return _turned(fields) if turned else fields
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{where}: no fields of a case ({one_line(error, 200)})") from error


def _value(name: str, array: Any) -> Any:
    """An array in the type of its field."""
    if name == "frames":
        return tuple(map(str, array))
    if name == "reach_mm":
        return float(array)
    kind = bool if name == "seen" else np.int64 if name in INDICES else np.float64
    return np.asarray(array, dtype=kind)


def _check(name: str, array: FloatArray | None, shape: tuple[int | None, ...]) -> None:
    if array is None:
        return
    fits = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        raise InputError(f"{name} has the shape {array.shape}, expected {shape}")


def turn_of(
    rest: FloatArray, annulus: IntArray, triangles: IntArray, region: IntArray, tips: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Middle ``(3,)`` and axes ``(3, 3)`` of a valve: annulus horizontal, tips below.

    The first leaflet lies towards positive y; ``(points - middle) @ axes`` turns.
    """
    ring = rest[annulus]
    middle = ring.mean(axis=0)
    up = np.linalg.svd(ring - middle, full_matrices=False)[2][2]
    below = tips if len(tips) else rest
    if (below.mean(axis=0) - middle) @ up > 0:
        up = -up
    first = np.unique(triangles[region == region.min()])
    front = rest[first].mean(axis=0) - middle
    front -= (front @ up) * up
    front /= np.linalg.norm(front)
    return middle, np.stack([np.cross(front, up), front, up], axis=1)


def _turned(fields: CaseFields) -> CaseFields:
    """The same valve about the middle of its annulus."""
    middle, axes = turn_of(
        fields.rest, fields.annulus, fields.triangles, fields.region, fields.tips[0]
    )
    shapes: dict[str, Any] = {
        name: (array - middle) @ axes
        for name in ("rest", "tips", *SEEN)
        if (array := getattr(fields, name)) is not None
    }
    points = {name: (array - middle) @ axes for name, array in fields.observed_points.items()}
    return replace(fields, observed_points=points, **shapes)
