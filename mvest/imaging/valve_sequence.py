"""Valves over time, simulated or detected, and their named points.

The TEE simulator images moving valves, and detectors learn from them. Their positions are mm in the
valve's own axes: the annulus about the plane z = 0, z towards the atrium, y to the anterior side, x
to the line between the leaflets at phi = 0. The image step returns one valve in every frame, with
its confidence.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.typing import FloatArray, IntArray


def _check(valve: Any, what: str, shapes: dict[str, tuple[int, ...]]) -> None:
    """Refuse arrays of inconsistent shapes, and times that do not increase."""
    for name, shape in shapes.items():
        given = np.shape(getattr(valve, name))
        if given != shape:
            raise InputError(f"{what}, {name}: shape {given}, expected {shape}")
    times = valve.times
    if not (len(times) and np.isfinite(times).all() and np.all(np.diff(times) > 0)):
        raise InputError(f"{what}: times {times} s, expected increasing ones")


@dataclass(frozen=True, slots=True, eq=False)
class MovingValve:
    """One simulated valve in every frame."""

    name: str  #: of the valve (not a frame)
    layout: ValveLayout
    times: FloatArray  #: (T,) s, increasing
    vertices: FloatArray  #: (T, n, 3) midsurface
    tips: FloatArray  #: (T, 2, 3) papillary tips, first the one at phi = 0
    thickness: FloatArray  #: (n,) mm
    chord_phi: FloatArray  #: (c,) degrees, insertions of the chordae
    chord_s: FloatArray  #: (c,) 0 to 1
    chord_tip: IntArray  #: (c,) their tips

    def __post_init__(self) -> None:
        t, n, c = len(self.times), self.layout.size, len(self.chord_phi)
        shapes = {"vertices": (t, n, 3), "tips": (t, 2, 3), "thickness": (n,)}
        _check(self, f"moving valve {self.name}", shapes | {"chord_s": (c,), "chord_tip": (c,)})


MIN_CONFIDENCE = 0.7
"""Smallest confidence of a frame that shows a valve.

A volume is accepted if its best frame reaches it; frames of a case are chosen among those that do.
It was set on separate simulated volumes: chamber walls alone reached 0.64, and one of 25 correctly
detected valves stayed below 0.8.
"""


@dataclass(frozen=True, slots=True, eq=False)
class ValveSequence:
    """A valve in every frame of a sequence; all positions LPS in mm."""

    layout: ValveLayout  #: vertex i is the same material point in all frames
    times: FloatArray  #: (T,) s, increasing
    vertices: FloatArray  #: (T, n, 3) midsurface
    tips: FloatArray  #: (T, 2, 3) papillary tips, first the one at phi = 0
    frame_confidence: FloatArray  #: (T,) 0 (no valve) to 1
    vertex_confidence: FloatArray  #: (T, n) 0 (not seen) to 1
    std_mm: FloatArray  #: (n,) of each coordinate of each vertex; NaN if it was never measured
    correlation_length_mm: float  #: of the errors along the leaflets

    def __post_init__(self) -> None:
        t, n = len(self.times), self.layout.size
        shapes = {"vertices": (t, n, 3), "tips": (t, 2, 3), "std_mm": (n,)}
        confidence = {"frame_confidence": (t,), "vertex_confidence": (t, n)}
        _check(self, "valve sequence", shapes | confidence)

    @property
    def confidence(self) -> float:
        """Confidence of the volume: the median of its frames."""
        return float(np.median(self.frame_confidence))

    @property
    def annulus(self) -> FloatArray:
        """``(T, columns, 3)`` mm."""
        return self.vertices[:, self.layout.annulus]

    @property
    def free_edge(self) -> FloatArray:
        """``(T, columns, 3)`` mm."""
        return self.vertices[:, self.layout.free_edge]


_ON_LEAFLETS: Final[dict[str, tuple[float, int]]] = {
    "commissure_0": (0.0, 0),
    "commissure_180": (180.0, 0),
    "annulus_anterior": (90.0, 0),
    "annulus_posterior": (270.0, 0),
    "free_edge_anterior": (90.0, -1),
    "free_edge_posterior": (270.0, -1),
    "annulus_45": (45.0, 0),
    "annulus_135": (135.0, 0),
    "annulus_225": (225.0, 0),
    "annulus_315": (315.0, 0),
}
TIPS: Final = ("tip_0", "tip_180")
"""Names of the papillary tips."""

ANNULUS_LABELS: Final = "AnnulusLabelsMarkup"
"""SlicerHeart's name for its list of labelled points."""
LANDMARKS: Final[tuple[str, ...]] = (*_ON_LEAFLETS, *TIPS)
"""All names: those on the leaflets, then the papillary tips."""


def landmark_vertices(layout: ValveLayout) -> dict[str, int]:
    """Vertex of every landmark on the leaflets (all but the tips), in the order of `LANDMARKS`.

    ``commissure_0`` and ``commissure_180`` are where the lines between the leaflets meet the
    annulus. InputError if the layout has no column at a multiple of 45 degrees.
    """
    return {name: layout.vertex(phi, row) for name, (phi, row) in _ON_LEAFLETS.items()}


def landmarks(sequence: ValveSequence, frame: int) -> dict[str, FloatArray]:
    """Positions ``(3,)`` LPS mm of `LANDMARKS`; InputError if there is no such frame."""
    if not 0 <= frame < len(sequence.times):
        raise InputError(f"landmarks: frame {frame}, expected 0 to {len(sequence.times) - 1}")
    at = list(landmark_vertices(sequence.layout).values())
    positions = np.concatenate([sequence.vertices[frame, at], sequence.tips[frame]])
    return dict(zip(LANDMARKS, positions, strict=True))


def slicerheart_labels(ring: FloatArray, end: int, down: FloatArray) -> dict[str, FloatArray]:
    """Points ``(3,)`` of the annulus by SlicerHeart's labels.

    ALC and PMC are the commissures, A and P the middles of the annulus between them. The plane
    through the centre across the line from P to A meets the annulus at AL and PM, and MC is the
    centre (``ValveQuantificationLib/MeasurementPresetMitralValve.py`` there). Seen from the atrium,
    the antero-lateral commissure is on the left of the anterior leaflet.

    The annulus is ``ring (k, 3)`` mm, whose points 0 to ``end`` bound the anterior leaflet;
    ``down (3,)`` points from the atrium to the ventricle. GeometryError if the ring is not a loop
    around its centre.
    """
    middle = ring.mean(axis=0)
    anterior = _half_way(ring[: end + 1])
    posterior = _half_way(np.vstack([ring[end:], ring[:1]]))
    forward = anterior - posterior
    left, right = ring[0], ring[end]
    if np.linalg.det(np.stack([left - right, forward, down])) < 0:
        left, right = right, left
    height = (ring - middle) @ forward
    following = np.roll(height, -1)
    cut = np.flatnonzero((height >= 0) != (following >= 0))
    if len(cut) != 2:
        raise GeometryError(f"the annulus meets a plane through its middle {len(cut)} times, not 2")
    share = (height[cut] / (height[cut] - following[cut]))[:, None]
    sides = (1 - share) * ring[cut] + share * np.roll(ring, -1, axis=0)[cut]
    at_left = int(np.argmin(np.linalg.norm(sides - left, axis=1)))
    return {
        "A": anterior,
        "P": posterior,
        "AL": sides[at_left],
        "PM": sides[1 - at_left],
        "ALC": left,
        "PMC": right,
        "MC": middle,
    }


def _half_way(curve: FloatArray) -> FloatArray:
    """Point ``(3,)`` at half the length of a curve ``(k, 3)``."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    return np.array([np.interp(length[-1] / 2, length, axis) for axis in curve.T])
