"""Membrane strain of leaflets between two shapes of one surface, and quantiles by area."""

from collections.abc import Sequence

import numpy as np

from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.triangles import areas, unit_normals, unit_rows


def triangle_strains(rest: FloatArray, deformed: FloatArray, surface: LeafletSurface) -> FloatArray:
    """Nominal strain ``(m, 2)`` of each triangle, along and across its fibres.

    It is the change in length, per length, of a line that lies along or across the fibres at rest:
    from the in-plane deformation gradient F, ``|F a| - 1``.

    Parameters
    ----------
    rest, deformed : (n, 3) mm
        Vertices of the surface.
    surface : LeafletSurface
        Triangles, regions and fibres.
    """
    corners = surface.triangles
    normal = unit_normals(rest, corners)
    fibre = surface.fibre[corners].sum(axis=1)
    along = unit_rows(fibre - np.sum(fibre * normal, axis=1, keepdims=True) * normal)
    axes = np.stack([along, np.cross(normal, along)], axis=2)

    def edges(x: FloatArray) -> FloatArray:
        return np.stack(
            [x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]]], 2
        )

    in_plane = np.linalg.inv(np.swapaxes(axes, 1, 2) @ edges(rest))
    return np.asarray(np.linalg.norm(edges(deformed) @ in_plane, axis=1) - 1.0)


def mean_strains(rest: FloatArray, deformed: FloatArray, surface: LeafletSurface) -> FloatArray:
    """Mean of `triangle_strains` over each leaflet's area at rest, ``(regions, 2)``."""
    strain, weight = triangle_strains(rest, deformed, surface), areas(rest, surface.triangles)
    regions = range(len(surface.region_names))
    return np.stack(
        [np.average(strain[own], axis=0, weights=weight[own])
         for own in (surface.region == r for r in regions)]
    )  # fmt: skip


def weighted_quantiles(
    values: FloatArray, weights: FloatArray, shares: Sequence[float]
) -> list[float]:
    """Smallest values such that the ``shares`` of the total weight do not exceed them.

    ``values`` and ``weights`` have the same shape, and at least one entry.
    """
    order = np.argsort(values, axis=None)
    below = np.cumsum(weights.ravel()[order])
    # Round-off in the sum must not lift a share of one beyond the last value.
    at = np.searchsorted(below, np.asarray(shares) * below[-1])
    return [float(value) for value in values.ravel()[order[at]]]
