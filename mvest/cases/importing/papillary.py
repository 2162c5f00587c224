"""Papillary tips from surfaces of the whole muscles, where nothing marks them."""

from __future__ import annotations

import numpy as np

from mvest.errors import GeometryError
from mvest.typing import FloatArray

HEAD_MM = 5.0
"""mm, height of the head of a muscle, from all of which its chordae rise."""
MIN_SLENDER = 1.5
"""Length of a muscle over its width, below which it has no long axis and so no tip."""


def papillary_tip(muscle: FloatArray, leaflets: FloatArray) -> FloatArray:
    """The middle ``(3,)`` mm of a muscle's head: its last `HEAD_MM` along its own long axis.

    Parameters
    ----------
    muscle
        ``(n, 3)`` mm, vertices of the muscle's surface.
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
