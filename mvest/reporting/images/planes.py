"""Slices of a volume in the planes in which a mitral valve is looked at, and what they cut.

All positions are LPS mm. A plane has its own coordinates: mm to the right and up from its origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from mvest.errors import GeometryError
from mvest.imaging.valve_sequence import ValveSequence, landmarks
from mvest.imaging.volume import VolumeSequence
from mvest.typing import BoolArray, FloatArray
from mvest.valve.geometry.proximity import plane_section

COLUMNS = ("commissural", "anteroposterior", "at the annulus", "at the free edge")
"""Planes of `valve_planes`, in their order: two along the valve's axis and two across."""

ABOVE_EDGE_MM = 1.0
STEP_MM = 0.4
"""Between pixels, if not stated otherwise."""


@dataclass(frozen=True, slots=True, eq=False)
class SlicePlane:
    """A plane with its own axes.

    Attributes
    ----------
    origin : (3,) mm
    right, up : (3,)
        Orthonormal.
    """

    origin: FloatArray
    right: FloatArray
    up: FloatArray

    @property
    def normal(self) -> FloatArray:
        """``(3,)`` unit, towards the eye."""
        return np.cross(self.right, self.up)

    def coordinates(self, points: FloatArray) -> FloatArray:
        """``(..., 3)`` mm to the right, up and towards the eye of positions ``(..., 3)``."""
        axes = np.stack([self.right, self.up, self.normal], axis=1)
        return np.asarray((points - self.origin) @ axes)

    def points(self, right: FloatArray, up: FloatArray) -> FloatArray:
        """Positions ``(..., 3)`` of places ``(...)`` in the plane."""
        return np.asarray(self.origin + right[..., None] * self.right + up[..., None] * self.up)


def valve_planes(valve: ValveSequence, frame: int) -> Mapping[str, SlicePlane]:
    """The planes of one frame by their names in `COLUMNS`.

    The commissural one holds both commissures and the middle between the papillary tips, the
    anteroposterior (three-chamber) one the middles of both sides of the annulus and the valve's
    axis; both have the atrium up. Those across are seen from the atrium with the anterior side up:
    through the centre of the annulus, and 1 mm above the middle of the free edge that is higher, so
    that both leaflets are cut.

    Raises
    ------
    GeometryError
        Positions that are not finite, or on one line.
    """
    named = landmarks(valve, frame)
    annulus = valve.annulus[frame]
    if not (np.isfinite(valve.vertices[frame]).all() and np.isfinite(valve.tips[frame]).all()):
        raise GeometryError(f"frame {frame}: positions that are not finite numbers have no planes")
    centre = annulus.mean(axis=0)
    _, size, directions = np.linalg.svd(annulus - centre, full_matrices=False)
    if size[1] <= 1e-9 * size[0]:
        raise GeometryError(f"frame {frame}: the annulus lies on one line; it has no plane")
    axis = directions[2]
    axis = axis if (centre - valve.tips[frame].mean(axis=0)) @ axis > 0 else -axis
    front, back = named["annulus_anterior"], named["annulus_posterior"]
    up = _across(front - back, axis, frame)
    right = np.cross(up, axis)
    first, second = named["commissure_0"], named["commissure_180"]
    commissures = 0.5 * (first + second)
    apart = _across(first - second, np.zeros(3), frame)
    height = _across(commissures - valve.tips[frame].mean(axis=0), apart, frame)
    edges = np.stack([named["free_edge_anterior"], named["free_edge_posterior"]])
    level = float(((edges - centre) @ axis).max()) + ABOVE_EDGE_MM
    return dict(
        zip(
            COLUMNS,
            (
                SlicePlane(commissures, apart, height),
                SlicePlane(0.5 * (front + back), up, axis),
                SlicePlane(centre, right, up),
                SlicePlane(centre + level * axis, right, up),
            ),
            strict=True,
        )
    )


def _across(direction: FloatArray, axis: FloatArray, frame: int) -> FloatArray:
    flat = direction - (direction @ axis) * axis
    length = float(np.linalg.norm(flat))
    if not length > 1e-9:
        raise GeometryError(f"frame {frame}: two sides of the annulus coincide; it has no axes")
    return np.asarray(flat / length)


def resample(
    volume: VolumeSequence,
    frame: int,
    plane: SlicePlane,
    extent: tuple[float, float, float, float],
    step: float = STEP_MM,
) -> FloatArray:
    """A slice of one frame, between voxels by trilinear interpolation.

    Parameters
    ----------
    volume, frame
    plane : SlicePlane
    extent : (left, right, bottom, top)
        mm in the plane, multiples of the step apart.
    step : float
        mm between pixels.

    Returns
    -------
    (rows, columns)
        From the bottom up; NaN outside the volume.
    """
    left, end, bottom, top = extent
    columns, rows = round((end - left) / step), round((top - bottom) / step)
    right, up = np.meshgrid(
        left + (np.arange(columns) + 0.5) * step, bottom + (np.arange(rows) + 0.5) * step
    )
    index = volume.index(plane.points(right, up))
    return np.asarray(
        map_coordinates(
            volume.frames[frame],
            np.moveaxis(index, -1, 0),
            output=np.float64,
            order=1,
            mode="constant",
            cval=np.nan,
        )
    )


def leaflet_contours(valve: ValveSequence, frame: int, plane: SlicePlane) -> list[FloatArray]:
    """Segments ``(k, 2, 2)`` mm in which a plane cuts each leaflet, in the order of the regions."""
    layout, contours = valve.layout, []
    for number in range(len(layout.region_names)):
        segments, _ = plane_section(
            valve.vertices[frame],
            layout.triangles[layout.region == number],
            plane.origin,
            plane.normal,
        )
        contours.append(plane.coordinates(segments)[..., :2])
    return contours


def near(plane: SlicePlane, points: FloatArray, reach: float) -> tuple[FloatArray, BoolArray]:
    """Places ``(n, 2)`` mm in the plane of points ``(n, 3)``, and which are within reach of it."""
    places = plane.coordinates(points)
    return places[:, :2], np.abs(places[:, 2]) <= reach
