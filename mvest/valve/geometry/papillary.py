"""Papillary tips: where they are on a whole muscle, and whether they fit the leaflets."""

from __future__ import annotations

import numpy as np

from mvest.errors import GeometryError
from mvest.typing import FloatArray
from mvest.valve.geometry.midsurface import Midsurface

HEAD_MM = 5.0
"""Height of the head of a muscle, from all of which its chordae rise."""
MIN_SLENDER = 1.5
"""Length of a muscle over its width, below which it has no long axis and so no tip."""
MAX_AWAY = 60.0
"""mm from the leaflets to the papillary tips."""
TALLER = 1.1
"""Height of a leaflet over that of the other, from which on it is the anterior one."""


def papillary_tip(muscle: FloatArray, leaflets: FloatArray) -> FloatArray:
    """The middle ``(3,)`` mm of a muscle's head: its last `HEAD_MM` along its own long axis.

    Parameters
    ----------
    muscle
        ``(n, 3)`` mm, points of the muscle.
    leaflets
        ``(m, 3)`` mm; the head is at the end that is nearer to their middle.

    Raises
    ------
    GeometryError
        The muscle is not longer than wide.
    """
    middle = muscle.mean(axis=0)
    _, _, axes = np.linalg.svd(muscle - middle, full_matrices=False)
    length, width = (float(np.ptp((muscle - middle) @ axis)) for axis in axes[:2])
    if length < MIN_SLENDER * width:
        raise GeometryError(
            f"papillary muscle near {np.round(middle, 1).tolist()}: {length:.1f} mm long and "
            f"{width:.1f} mm wide, so which end is its tip is not known; give tips instead"
        )
    axis = axes[0] * np.sign((leaflets.mean(axis=0) - middle) @ axes[0])
    along = (muscle - middle) @ axis
    return np.asarray(muscle[along >= along.max() - HEAD_MM].mean(axis=0))


def check_tips_of(surface: Midsurface, tips: FloatArray, *, handedness: bool = True) -> None:
    """Raise where tips have other axes than the leaflets, or the valve is its own mirror image.

    Parameters
    ----------
    surface
    tips
        ``(2, 3)`` mm, LPS, the antero-lateral one first.
    handedness
        Whether a mirror image is refused.

    Raises
    ------
    GeometryError
        Seen from the atrium, the antero-lateral tip is not on the left of the anterior leaflet, or
        tips are farther from the leaflets than any.
    """
    centre = surface.vertices.mean(axis=0)
    away, turned = (
        float(np.linalg.norm(tips * axes - centre, axis=1).max()) for axes in (1, (-1, -1, 1))
    )
    if away > MAX_AWAY:
        hint = f" (with x and y turned {turned:.0f} mm: they are in RAS where LPS is expected)"
        raise GeometryError(
            f"tips: {away:.0f} mm from the leaflets, expected at most {MAX_AWAY:g} mm"
            + (hint if turned < MAX_AWAY else "")
        )
    halves = [
        surface.vertices[surface.triangles[surface.region == k]].mean(axis=(0, 1)) for k in (0, 1)
    ]
    sides = np.stack([tips[0] - tips[1], halves[0] - halves[1], tips.mean(axis=0) - centre])
    if handedness and np.linalg.det(sides) < 0:
        exchanged = surface.heights[1] > TALLER * surface.heights[0]
        raise GeometryError(
            "seen from the atrium the first tip, the antero-lateral one, is on the right of the "
            "anterior leaflet, as in a mirror: "
            + (
                "exchange the leaflets, the posterior one is the taller one"
                if exchanged
                else "give the antero-lateral tip first, if no axis is turned"
            )
            + " (mirrored=true takes it as it is)"
        )
