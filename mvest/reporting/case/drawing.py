"""Valves drawn in two dimensions: shaded triangles and lines, the farthest first.

A drawing is one collection in ordinary axes in millimetres. Leaflets therefore hide lines behind
them, and all panels can have the same scale.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from scipy.ndimage import distance_transform_edt, gaussian_filter

from mvest.problem.fields import CaseFields
from mvest.reporting.figures import ATRIUM, LEAFLET_COLOURS, View, scale_bar
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import vertex_normals
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.coaptation import Gap, find_gap

BLOOD, TISSUE = (0.70, 0.05, 0.10), (0.80, 0.76, 0.72)
"""Colours of a gap, and of the slit between midsurfaces that touch, a thickness apart."""
UNSEEN = np.array([0.75, 0.75, 0.75])
LINE = np.array([0.10, 0.10, 0.10])
CHORD = np.array([0.45, 0.42, 0.40])
TIP = np.array([0.35, 0.22, 0.20])
UNDER_MM = 0.5
"""A gap is drawn this far beneath the leaflets: it is found along the normal of the annulus, and
not along the line of sight."""
SMOOTHED_MM = 0.6
"""Smoothing of the depth of a gap, which jumps between two leaflets."""
NEGLIGIBLE = 1e-6
TIP_RADIUS_MM = 0.9
LIFT_MM = 0.7
"""Lines are drawn nearer by this, so that their own surface does not hide them."""
LARGEST_EDGE_MM, MAX_SPLITS = 1.2, 2
"""Triangles are sorted by the depth of their centres; smaller ones keep touching leaflets apart."""
LINE_PIECES = 6
HIGH_QUANTILE = 0.99

Part: TypeAlias = tuple[FloatArray, FloatArray, float]
"""Corners of triangles ``(k, 3, 3)`` mm, their colours ``(k, 3)`` and their width of line."""


def leaflet_colours(region: IntArray) -> FloatArray:
    """Colours ``(m, 3, 3)`` of the corners of triangles by their leaflet."""
    return np.repeat(LEAFLET_COLOURS[region % len(LEAFLET_COLOURS)][:, None], 3, axis=1)


def distance_top(*distances: FloatArray) -> float:
    """Upper end of a scale for several fields: a round number above the 99 % quantile of each."""
    top = max(float(np.nanquantile(values, HIGH_QUANTILE)) for values in distances)
    if top <= 0:
        return 1e-3
    step = 10.0 ** np.floor(np.log10(top)) / 2
    return float(step * np.ceil(top / step - 1e-9))


def corner_colours(scale: ScalarMappable, values: FloatArray, triangles: IntArray) -> FloatArray:
    """Colours ``(m, 3, 3)`` of the corners of triangles from a field ``(n,)``; grey if unknown."""
    known = np.isfinite(values)
    colours: FloatArray = scale.to_rgba(np.where(known, values, 0.0))[:, :3]
    whole = np.asarray(known[triangles].all(axis=1))
    return np.where(whole[:, None, None], colours[triangles], UNSEEN)


def draw_valve(
    axes: Any,
    fields: CaseFields,
    points: FloatArray,
    colours: FloatArray,
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
        ``(n, 3)`` mm; triangles with a NaN are left out.
    colours : ndarray
        ``(m, 3, 3)`` of triangle, corner, channel before shading.
    view : View
    frame : int
        Frame of the papillary tips; 0 is the reference frame.
    chords : bool
        Whether chordae and papillary tips are drawn.
    strength : float
        Darkening of a triangle on edge, relative to one that faces the light.
    """
    known = np.isfinite(points[fields.triangles]).all(axis=(1, 2))
    parts = [_surface(points, fields.triangles[known], colours[known], view, strength)]
    for loop, width in ((fields.annulus, 1.8), (fields.free_edge, 0.7)):
        ends = np.stack([points[loop], points[np.roll(loop, -1)]], axis=1)
        parts.append(_lines(ends, view, LINE, width))
    if chords:
        parts.append(_lines(fields.chords(points, frame), view, CHORD, 0.6))
        parts.append(_dots(fields.tips[frame], view, TIP))
    seen = np.concatenate([corners @ view.axes for corners, _, _ in parts])
    order = np.argsort(seen[..., 2].mean(axis=1), kind="stable")
    colour = np.concatenate([colour for _, colour, _ in parts])[order]
    widths = np.repeat([width for *_, width in parts], [len(corners) for corners, *_ in parts])
    axes.add_collection(
        PolyCollection(
            list(seen[order, :, :2]),
            facecolors=colour,
            edgecolors=colour,
            linewidths=widths[order],
            capstyle="round",
            joinstyle="round",
            rasterized=True,
        )
    )
    axes.set_aspect("equal")
    axes.set_axis_off()


def _surface(
    points: FloatArray, triangles: IntArray, colours: FloatArray, view: View, strength: float
) -> Part:
    """Shaded triangles, split so that their depths differ where leaflets touch."""
    # Vertices without a triangle have no normal and are not drawn.
    with np.errstate(invalid="ignore"):
        normals = vertex_normals(points, triangles)
    corner, normal = points[triangles], normals[triangles]
    edge = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2)
    for _ in range(MAX_SPLITS):
        if not len(edge) or np.median(edge) <= LARGEST_EDGE_MM:
            break
        corner, normal, colours = (quartered(values) for values in (corner, normal, colours))
        edge = edge / 2
    direction = normal.mean(axis=1)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    light = view.axes @ np.array([-0.40, 0.45, 0.80])
    # Both sides are equally lit.
    shade = 1.0 - strength * (1.0 - np.abs(direction @ light))
    return corner, np.clip(colours.mean(axis=1) * shade[:, None], 0, 1), 0.3


def quartered(values: FloatArray) -> FloatArray:
    """Values at the corners of triangles split into four: ``(m, 3, 3)`` to ``(4 m, 3, 3)``."""
    a, b, c = values[:, 0], values[:, 1], values[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(triangle, axis=1) for triangle in corners])


def _lines(ends: FloatArray, view: View, colour: FloatArray, width: float) -> Part:
    """Straight lines ``(k, 2, 3)`` as pieces that are triangles without area; NaN are left out."""
    start, end = ends[np.isfinite(ends).all(axis=(1, 2))].swapaxes(0, 1)
    share = np.linspace(0, 1, LINE_PIECES + 1)[:, None, None]
    beads = start + share * (end - start) + LIFT_MM * view.axes[:, 2]
    a, b = beads[:-1].reshape(-1, 3), beads[1:].reshape(-1, 3)
    return np.stack([a, b, a], axis=1), np.tile(colour, (len(a), 1)), width


def _dots(centres: FloatArray, view: View, colour: FloatArray) -> Part:
    """Discs that face the eye."""
    angle = np.linspace(0, 2 * np.pi, 25)
    rim = TIP_RADIUS_MM * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ view.axes[:, :2].T
    disc = np.stack([0 * rim[:-1], rim[:-1], rim[1:]], axis=1)
    corners = (centres[:, None, None] + disc).reshape(-1, 3, 3)
    return corners, np.tile(colour, (len(corners), 1)), 0.3


def leak_of(fields: CaseFields, points: FloatArray, frame: int) -> tuple[Gap, FloatArray] | None:
    """The gap of a valve at ``points (n, 3)`` mm, and the corners of its pixels.

    Corners ``(rows + 1, columns + 1, 3)`` mm are about as deep as the nearest leaflets. Papillary
    tips are those of ``frame``. None if the contact distance or some of the points are unknown.
    """
    if fields.reach_mm is None or not np.isfinite(points).all():
        return None
    annulus = points[fields.annulus]
    first = annulus[fields.vertex_region[fields.annulus] == 0]
    plane = annulus_plane(annulus, fields.tips[frame].mean(axis=0), first.mean(axis=0))
    gap = find_gap(points, fields.triangles, annulus, plane, fields.reach_mm)
    between = (gap.slit | gap.open).astype(np.float64)
    width = SMOOTHED_MM / gap.resolution
    near = gaussian_filter(between, width)
    smooth = gaussian_filter(np.where(between > 0, gap.level, 0.0), width)
    level = np.divide(smooth, near, out=gap.level.copy(), where=near > NEGLIGIBLE)
    level = np.pad(level, ((0, 1), (0, 1)), mode="edge")
    across = (
        first + gap.resolution * (np.arange(count) - 0.5)
        for first, count in zip((gap.anterior[0], gap.lateral[0]), level.shape, strict=True)
    )
    places = np.stack([*np.meshgrid(*across, indexing="ij"), level], axis=-1)
    corners = plane.origin + places @ np.stack([plane.anterior, plane.lateral, plane.normal])
    return gap, corners


def paint_leak(axes: Any, fields: CaseFields, points: FloatArray, frame: int) -> None:
    """Draw the gap of a valve from the atrium, and the slit between touching leaflets.

    Nothing is drawn if `leak_of`, which has the same parameters, is None.
    """
    leak = leak_of(fields, points, frame)
    if leak is None or not (between := leak[0].slit | leak[0].open).any():
        return
    gap, corners = leak
    away, nearest = distance_transform_edt(~between, return_indices=True)
    image = np.where(gap.open[tuple(nearest)][..., None], (*BLOOD, 1.0), (*TISSUE, 1.0))
    image[gap.resolution * away > UNDER_MM, 3] = 0.0
    axes.pcolormesh(corners[..., 0], corners[..., 1], image, zorder=0, rasterized=True)


def name_leaflets(axes: Any, fields: CaseFields, names: Sequence[str]) -> None:
    """Write the names of the leaflets outside the annulus, seen from the atrium."""
    ring = (fields.rest[fields.annulus] @ ATRIUM.axes)[:, :2]
    middle, region = ring.mean(axis=0), fields.vertex_region[fields.annulus]
    for k, name in enumerate(names):
        if not len(part := ring[region == k] - middle):
            continue
        direction = part.mean(axis=0) / max(float(np.linalg.norm(part.mean(axis=0))), 1e-12)
        x, y = middle + (float((part @ direction).max()) + 2.0) * direction
        angle = {"ha": "center", "va": "bottom" if direction[1] > 0 else "top"}
        if abs(direction[0]) > 0.7:
            angle = {"ha": "left" if direction[0] > 0 else "right", "va": "center"}
        axes.text(x, y, name, fontsize=9, color="0.25", **angle)


def same_scale(panels: Sequence[Any], shapes: Sequence[FloatArray], view: View) -> None:
    """Give panels of one view the same limits in mm, and the first one a scale bar."""
    seen = np.concatenate([shape.reshape(-1, 3) @ view.axes for shape in shapes])[:, :2]
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    margin = 0.09 * float((high - low).max())
    for axes in panels:
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - 1.8 * margin, high[1] + margin)
    scale_bar(panels[0], "black")
