"""Points found by votes: every candidate says where the point lies from it, and most are right."""

from __future__ import annotations

import numpy as np

from mvest.typing import FloatArray

ROUNDS = 4


def consensus(votes: FloatArray, width_mm: float = 1.5) -> tuple[FloatArray, FloatArray]:
    """Where votes agree.

    Parameters
    ----------
    votes : (P, V, d) mm
        V votes for each of P points.
    width_mm : float
        Votes farther than this from the consensus count little (Cauchy weights).

    Returns
    -------
    points : (P, d) mm
    spread : (P,) mm
        Weighted root mean square distance of the votes: how much they disagree.
    """
    centre = np.median(votes, axis=1)
    for _ in range(ROUNDS):
        gap = ((votes - centre[:, None]) ** 2).sum(axis=2)
        weight = 1 / (1 + gap / width_mm**2)
        weight /= weight.sum(axis=1, keepdims=True)
        centre = (weight[..., None] * votes).sum(axis=1)
    gap = ((votes - centre[:, None]) ** 2).sum(axis=2)
    return centre, np.sqrt((weight * gap).sum(axis=1))
