"""How a triangulated midsurface is stretched in its plane between two shapes."""

from __future__ import annotations

import numpy as np

from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import areas


def principal_stretches(
    rest: FloatArray, deformed: FloatArray, triangles: IntArray
) -> tuple[FloatArray, FloatArray]:
    r"""Largest and smallest stretch ``(n,)`` at each vertex, means over its triangles by area.

    In a triangle with the edges :math:`D = [d_1, d_2]` at rest and :math:`d` now the stretches are
    the singular values of :math:`d R^{-1}`, where :math:`D = Q R` (Q orthonormal).

    Parameters
    ----------
    rest, deformed
        ``(n, 3)`` mm.
    triangles
        ``(m, 3)``.
    """

    def edges(points: FloatArray) -> FloatArray:
        corner = points[triangles]
        return np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)

    upper = np.linalg.qr(edges(rest))[1]
    values = np.linalg.svd(edges(deformed) @ np.linalg.inv(upper), compute_uv=False)
    weight = np.repeat(areas(rest, triangles), 3)
    total = np.bincount(triangles.ravel(), weight, minlength=len(rest))
    return (
        np.bincount(triangles.ravel(), weight * np.repeat(values[:, 0], 3), len(rest)) / total,
        np.bincount(triangles.ravel(), weight * np.repeat(values[:, 1], 3), len(rest)) / total,
    )
