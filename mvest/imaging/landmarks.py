"""Named points of a valve in one frame: commissures, annulus, middles of the free edges, tips."""

from __future__ import annotations

from typing import Final

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray

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
"""What SlicerHeart calls its list of labelled points."""
LANDMARKS: Final[tuple[str, ...]] = (*_ON_LEAFLETS, *TIPS)
"""Every name, in the order of `landmarks`: those on the leaflets, then the papillary tips."""


def landmark_vertices(layout: ValveLayout) -> dict[str, int]:
    """Vertex of every landmark that lies on the leaflets (all but the tips), in fixed order.

    ``commissure_0`` and ``commissure_180`` are where the lines between the leaflets meet the
    annulus.

    Raises
    ------
    InputError
        The layout has no column at a multiple of 45 degrees.
    """
    return {name: layout.vertex(phi, row) for name, (phi, row) in _ON_LEAFLETS.items()}


def landmarks(sequence: ValveSequence, frame: int) -> dict[str, FloatArray]:
    """Positions ``(3,)`` LPS mm of the landmarks named in `LANDMARKS`, in that order.

    Parameters
    ----------
    sequence : ValveSequence
    frame : int
        From 0 on.

    Raises
    ------
    InputError
        There is no such frame, or the layout has no column at a multiple of 45 degrees.
    """
    if not 0 <= frame < len(sequence.times):
        raise InputError(f"landmarks: frame {frame}, expected 0 to {len(sequence.times) - 1}")
    vertices = sequence.vertices[frame]
    positions = {name: vertices[v].copy() for name, v in landmark_vertices(sequence.layout).items()}
    for name, tip in zip(TIPS, sequence.tips[frame], strict=True):
        positions[name] = tip.copy()
    return positions


def slicerheart_labels(ring: FloatArray, end: int, down: FloatArray) -> dict[str, FloatArray]:
    """Points ``(3,)`` of the annulus by the labels that SlicerHeart gives them.

    ALC and PMC are the commissures, A and P the middles of the annulus between them, AL and PM
    where the plane through the middle across the line from P to A meets the annulus, MC is the
    middle (``ValveQuantificationLib/MeasurementPresetMitralValve.py`` there). From the atrium the
    antero-lateral commissure lies on the left of the anterior leaflet.

    Parameters
    ----------
    ring
        ``(k, 3)`` mm, the annulus, of which the points 0 to ``end`` bound the anterior leaflet.
    end
    down
        ``(3,)`` from the atrium to the ventricle.

    Raises
    ------
    GeometryError
        The annulus is no loop round its middle.
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
