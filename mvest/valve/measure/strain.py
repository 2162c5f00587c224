"""Membrane strain of leaflets between two shapes of one surface."""

from __future__ import annotations

import numpy as np

from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.triangles import areas, unit_normals, unit_rows


def mean_strains(rest: FloatArray, deformed: FloatArray, surface: LeafletSurface) -> FloatArray:
    """Mean nominal strain ``(regions, 2)`` of each leaflet, along and across its fibres.

    Of a triangle it is the change in length, per length, of a line that lies along or across the
    fibres at rest: from its in-plane deformation gradient F, ``|F a| - 1``. Means are over the area
    at rest.

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
    stretch = np.linalg.norm(edges(deformed) @ in_plane, axis=1)
    weight = areas(rest, corners)
    regions = range(len(surface.region_names))
    return np.stack(
        [np.average(stretch[own], axis=0, weights=weight[own]) - 1.0
         for own in (surface.region == r for r in regions)]
    )  # fmt: skip
