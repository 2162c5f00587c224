"""Named points of a valve in one frame: commissures, annulus, middles of the free edges, tips."""

from __future__ import annotations

from typing import Final

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray

__all__ = ["LANDMARKS", "landmark_vertices", "landmarks"]

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
_TIPS: Final = ("tip_0", "tip_180")

LANDMARKS: Final[tuple[str, ...]] = (*_ON_LEAFLETS, *_TIPS)
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
    for name, tip in zip(_TIPS, sequence.tips[frame], strict=True):
        positions[name] = tip.copy()
    return positions
