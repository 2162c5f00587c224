"""Valves drawn flat on a page: shaded triangles and lines seen from one side, the farthest first.

A drawing is one collection in ordinary axes in millimetres, so that lines disappear behind leaflets
and every panel can have the same scale.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from numpy.typing import ArrayLike

from mvest.reporting.case_fields import CaseFields
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy import vertex_normals

__all__ = [
    "ATRIUM",
    "LEAFLET_COLOURS",
    "SIDE",
    "UNSEEN",
    "VIEWS",
    "View",
    "draw_valve",
    "leaflet_colours",
    "name_leaflets",
    "same_scale",
]

LEAFLET_COLOURS = np.array([[0.87, 0.57, 0.49], [0.50, 0.66, 0.86], [0.58, 0.77, 0.57]])
"""Of the leaflets in the order of their regions, light enough to be shaded."""
UNSEEN = np.array([0.75, 0.75, 0.75])
LINE = (0.10, 0.10, 0.10)
CHORD = (0.45, 0.42, 0.40)
TIP = (0.35, 0.22, 0.20)
TIP_RADIUS_MM = 0.9
LIFT_MM = 0.4
"""By which lines are drawn nearer, so that the surface they lie on does not swallow them."""
SCALE_MM = 10.0


@dataclass(frozen=True, slots=True)
class View:
    """A direction to look from: elevation over the annulus plane and azimuth, degrees."""

    name: str
    elevation: float
    azimuth: float

    @property
    def axes(self) -> FloatArray:
        """``(3, 3)`` columns: to the right, up, and towards the eye."""
        e, a = np.deg2rad(self.elevation), np.deg2rad(self.azimuth)
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(eye, right), eye], axis=1)


ATRIUM = View("seen from the atrium", 90.0, -90.0)
SIDE = View("seen from the side", 12.0, -60.0)
VIEWS = (ATRIUM, SIDE)


def leaflet_colours(region: IntArray) -> FloatArray:
    """A colour ``(m, 3)`` for each triangle by its leaflet."""
    return LEAFLET_COLOURS[region % len(LEAFLET_COLOURS)]


def draw_valve(
    axes: Any,
    fields: CaseFields,
    points: FloatArray,
    colours: ArrayLike,
    view: View,
    frame: int,
    chords: bool = False,
    strength: float = 0.45,
) -> None:
    """Draw one shape of the valve with its annulus and free edge.

    Parameters
    ----------
    axes : matplotlib Axes
    fields : CaseFields
    points : ndarray
        ``(n, 3)`` mm; triangles with a vertex that is NaN are left out.
    colours : array_like
        ``(m, 3)`` of the triangles before shading.
    view : View
    frame : int
        Whose papillary tips are drawn; 0 is the reference frame.
    chords : bool
        Whether chordae and papillary tips are drawn.
    strength : float
        How much darker a triangle on edge is than one that faces the light.
    """
    seen = points @ view.axes
    known = np.isfinite(seen[fields.triangles]).all(axis=(1, 2))
    triangles = fields.triangles[known]
    shade = _shade(points, triangles, view, strength)
    faces = np.clip(np.asarray(colours)[known] * shade[:, None], 0, 1)
    polygons: list[FloatArray] = list(seen[triangles][:, :, :2])
    depth: list[float] = list(seen[triangles][:, :, 2].mean(axis=1))
    face: list[Any] = list(faces)
    edge: list[Any] = list(faces)
    width: list[float] = [0.3] * len(triangles)

    def add(line: FloatArray, colour: Any, thickness: float) -> None:
        for start, end in itertools.pairwise(line):
            if np.isfinite(start).all() and np.isfinite(end).all():
                polygons.append(np.stack([start[:2], end[:2], start[:2]]))
                depth.append(float(start[2] + end[2]) / 2 + LIFT_MM)
                face.append(colour)
                edge.append(colour)
                width.append(thickness)

    for loop, thickness in ((fields.annulus, 1.8), (fields.free_edge, 0.7)):
        if len(loop):
            add(seen[np.append(loop, loop[0])], LINE, thickness)
    if chords:
        share = np.linspace(0, 1, 9)[:, None]
        for start, end in fields.chords(points, frame) @ view.axes:
            add(start + share * (end - start), CHORD, 0.6)
        circle = np.linspace(0, 2 * np.pi, 24)
        for tip in fields.tips[frame] @ view.axes:
            polygons.append(
                tip[:2] + TIP_RADIUS_MM * np.stack([np.cos(circle), np.sin(circle)], axis=1)
            )
            depth.append(float(tip[2]))
            face.append(TIP)
            edge.append(TIP)
            width.append(0.3)

    order = np.argsort(depth, kind="stable")
    axes.add_collection(
        PolyCollection(
            [polygons[k] for k in order],
            facecolors=[face[k] for k in order],
            edgecolors=[edge[k] for k in order],
            linewidths=[width[k] for k in order],
            capstyle="round",
            joinstyle="round",
            rasterized=True,
        )
    )
    axes.set_aspect("equal")
    axes.set_axis_off()


def _shade(points: FloatArray, triangles: IntArray, view: View, strength: float) -> FloatArray:
    """Brightness ``(m,)`` of triangles, smooth over the surface; both sides are lit alike."""
    corner = points[triangles]
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    # A vertex of no triangle that is drawn has no normal, and none is asked for.
    with np.errstate(invalid="ignore"):
        normal = vertex_normals(points, triangles)[triangles].mean(axis=1)
    normal = np.where(np.isfinite(normal), normal, face)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = view.axes @ np.array([-0.40, 0.45, 0.80])
    return 1.0 - strength * (1.0 - np.abs(normal @ light))


def name_leaflets(axes: Any, fields: CaseFields, names: Sequence[str], view: View = ATRIUM) -> None:
    """Write the names of the leaflets outside the annulus, seen from the atrium."""
    ring = fields.rest[fields.annulus] @ view.axes
    middle = ring.mean(axis=0)[:2]
    region = fields.vertex_region[fields.annulus]
    for k, name in enumerate(names):
        part = ring[region == k, :2]
        if len(part):
            direction = part.mean(axis=0) - middle
            direction /= max(float(np.linalg.norm(direction)), 1e-12)
            reach = float(((part - middle) @ direction).max()) + 2.0
            x, y = middle + reach * direction
            angle = {"ha": "center", "va": "bottom" if direction[1] > 0 else "top"}
            if abs(direction[0]) > 0.7:
                angle = {"ha": "left" if direction[0] > 0 else "right", "va": "center"}
            axes.text(x, y, name, fontsize=9, color="0.25", **angle)


def same_scale(panels: Sequence[Any], shapes: Sequence[FloatArray], view: View) -> None:
    """Give panels of one view the same limits in mm, and the first of them a scale bar."""
    seen = np.concatenate([shape.reshape(-1, 3) @ view.axes for shape in shapes])[:, :2]
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    margin = 0.09 * float((high - low).max())
    for axes in panels:
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - 1.8 * margin, high[1] + margin)
    # Below everything else, where no leaflet's name is written.
    x, y = low[0] - 0.5 * margin, low[1] - 1.6 * margin
    panels[0].plot([x, x + SCALE_MM], [y, y], color="black", linewidth=2, solid_capstyle="butt")
    panels[0].text(
        x + SCALE_MM / 2, y + 0.15 * margin, f"{SCALE_MM:.0f} mm", fontsize=8, ha="center"
    )
