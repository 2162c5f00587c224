"""The gap of a closed valve through which it leaks, apart from the slit that is only tissue.

Leaflets are midsurfaces: those that touch lie a thickness or more apart, and the slit between them
is no leak. A line of sight from the atrium counts as open only where it keeps clear of every
leaflet by half the distance at which two of them touch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from mvest.errors import InputError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.measure.annulus import AnnulusPlane
from mvest.valve.measure.coaptation import project_leaflets


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """What is open of a closed valve, as an image seen from the atrium along the annulus normal.

    Attributes
    ----------
    anterior, lateral : ndarray
        ``(rows,)`` and ``(columns,)`` mm, pixel centres along those directions of the annulus.
    open : ndarray
        ``(rows, columns)`` pixels of the gap.
    slit : ndarray
        ``(rows, columns)`` other pixels within the annulus that no midsurface covers.
    level : ndarray
        ``(rows, columns)`` mm below the annulus plane of the nearest midsurface.
    resolution : float
        mm.
    """

    anterior: FloatArray
    lateral: FloatArray
    open: BoolArray
    slit: BoolArray
    level: FloatArray
    resolution: float

    @property
    def area(self) -> float:
        """Regurgitant gap, mm²."""
        return float(self.open.sum() * self.resolution**2)


def find_gap(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    reach: float,
    resolution: float = 0.1,
) -> Gap:
    """Find the gap of a closed valve.

    A straight line along the annulus normal is open if it keeps farther than half of ``reach`` from
    every midsurface; its distance from a leaflet is the distance of two points in the projection.
    A gap that an overlapping leaflet hides is not counted.

    Parameters
    ----------
    vertices, triangles : ndarray
        Midsurfaces in their current shape, ``(n, 3)`` mm and ``(m, 3)``.
    annulus : ndarray
        ``(k, 3)`` mm in loop order.
    plane : AnnulusPlane
        Of that annulus.
    reach : float
        mm, largest distance of two midsurfaces that touch.
    resolution : float
        mm, size of a pixel.

    Raises
    ------
    InputError, GeometryError
        If the reach is negative or the resolution gives too large an image.
    """
    if not (np.isfinite(reach) and reach >= 0):
        raise InputError(f"reach of the contact = {reach} mm, expected >= 0")
    image = project_leaflets(vertices, triangles, annulus, plane, resolution)
    uncovered = np.isinf(image.depth)
    pixels, nearest = distance_transform_edt(uncovered, return_indices=True)
    inside = image.inside & uncovered
    open_ = inside & (resolution * pixels > 0.5 * reach)
    level = image.depth[tuple(nearest)]
    return Gap(image.anterior, image.lateral, open_, inside & ~open_, level, resolution)
