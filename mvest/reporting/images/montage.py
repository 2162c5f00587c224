"""Quality control of a valve from images: its outlines drawn on slices of the volume.

The slices lie in the planes in which a mitral valve is looked at. All positions are LPS mm. A plane
has its own coordinates: mm to the right and up from its origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from scipy.ndimage import map_coordinates

from mvest.errors import GeometryError, InputError
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, ValveSequence, landmarks
from mvest.imaging.volume import VolumeSequence
from mvest.reporting.figures import BAD, LEAFLET_COLOURS, SMALL, headline
from mvest.typing import BoolArray, FloatArray
from mvest.valve.geometry.proximity import plane_section
from mvest.valve.measure.annulus import annulus_plane, unit_vector

COLUMNS = {
    "commissural": "through the tips' middle, atrium up",
    "anteroposterior": "atrium up, anterior right",
    "at the annulus": "from the atrium, anterior up",
    "at the free edge": "1 mm above the higher one, anterior up",
}
"""Planes of `valve_planes` in their order, two along the valve's axis and two across, and how they
are seen."""

ALONG = ("commissural", "anteroposterior")
"""Planes in which the papillary tips are in sight."""
ABOVE_EDGE_MM = 1.0
STEP_MM = 0.4
"""Between pixels."""
MOST_ROWS = 6
REACH_MM = 3.0
"""Up to which distance from a plane annulus points and papillary tips are drawn in it."""
SCALE_MM = 10.0
MARGIN_MM = 7.0
ROW_INCHES = 2.35
OUTSIDE = "#3a3f4a"
DOTS: Mapping[str, Mapping[str, Any]] = {
    "annulus, within 3 mm": {"marker": "o", "ms": 2.4, "mfc": "white", "mew": 0.4},
    "papillary tip, within 3 mm": {"marker": "^", "ms": 7, "mfc": "#F0E442", "mew": 0.8},
}

Extent = tuple[float, float, float, float]
"""Left, right, bottom and top in a plane, mm."""


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
    def axes(self) -> FloatArray:
        """``(3, 3)`` columns: to the right, up and towards the eye."""
        return np.stack([self.right, self.up, np.cross(self.right, self.up)], axis=1)

    def coordinates(self, points: FloatArray) -> FloatArray:
        """``(..., 3)`` mm to the right, up and towards the eye of positions ``(..., 3)``."""
        return np.asarray((points - self.origin) @ self.axes)


def valve_planes(valve: ValveSequence, frame: int) -> dict[str, SlicePlane]:
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
    named, tips = landmarks(valve, frame), valve.tips[frame]
    if not (np.isfinite(valve.vertices[frame]).all() and np.isfinite(tips).all()):
        raise GeometryError(f"frame {frame}: positions that are not finite numbers have no planes")
    front, back = named["annulus_anterior"], named["annulus_posterior"]
    first, second = named["commissure_0"], named["commissure_180"]
    plane = annulus_plane(valve.annulus[frame], tips.mean(axis=0), front)
    centre, axis = plane.origin, -plane.normal
    up = _across(front - back, axis)
    right = np.cross(up, axis)
    commissures = 0.5 * (first + second)
    apart = unit_vector(first - second, "commissures")
    height = _across(commissures - tips.mean(axis=0), apart)
    edges = np.stack([named["free_edge_anterior"], named["free_edge_posterior"]])
    level = float(((edges - centre) @ axis).max()) + ABOVE_EDGE_MM
    planes = (
        SlicePlane(commissures, apart, height),
        SlicePlane(0.5 * (front + back), up, axis),
        SlicePlane(centre, right, up),
        SlicePlane(centre + level * axis, right, up),
    )
    return dict(zip(COLUMNS, planes, strict=True))


def _across(direction: FloatArray, axis: FloatArray) -> FloatArray:
    return unit_vector(direction - (direction @ axis) * axis, "sides of the annulus")


def resample(volume: VolumeSequence, frame: int, plane: SlicePlane, extent: Extent) -> FloatArray:
    """A slice of one frame, between voxels by trilinear interpolation.

    Returns
    -------
    (rows, columns)
        `STEP_MM` apart from the bottom up; NaN outside the volume.
    """
    across, up = (
        low + (np.arange(round((high - low) / STEP_MM)) + 0.5) * STEP_MM
        for low, high in (extent[:2], extent[2:])
    )
    places = np.stack(np.meshgrid(across, up), axis=-1)
    index = np.moveaxis(volume.index(plane.origin + places @ plane.axes[:, :2].T), -1, 0)
    image = volume.frames[frame]
    return np.asarray(map_coordinates(image, index, output=np.float64, order=1, cval=np.nan))


def leaflet_contours(valve: ValveSequence, frame: int, plane: SlicePlane) -> list[FloatArray]:
    """Segments ``(k, 2, 2)`` mm in which a plane cuts each leaflet, in the order of the regions."""
    layout, contours = valve.layout, []
    for number in range(len(layout.region_names)):
        triangles = layout.triangles[layout.region == number]
        points, normal = valve.vertices[frame], plane.axes[:, 2]
        segments, _ = plane_section(points, triangles, plane.origin, normal)
        contours.append(plane.coordinates(segments)[..., :2])
    return contours


def chosen_frames(count: int, closed: int | None = None) -> list[int]:
    """At most `MOST_ROWS` of ``count`` frames, evenly spaced from the first to the last.

    The closed one, if given, takes the place of the nearest that is not the first.
    """
    frames = np.unique(np.linspace(0, count - 1, min(MOST_ROWS, count)).round().astype(int))
    if closed is not None and closed not in frames:
        later = frames[1:]
        later[np.argmin(np.abs(later - closed))] = closed
    return sorted(frames.tolist())


def montage_figure(
    volume: VolumeSequence,
    valve: ValveSequence,
    *,
    title: str,
    closed: int | None = None,
    low_confidence: float = MIN_CONFIDENCE,
    accepted: bool = True,
) -> Figure:
    """Frames in rows, the planes of `valve_planes` in columns, with what the valve cuts drawn on.

    Every row has the planes of its own frame; all panels have one scale. Leaflets are drawn where
    the plane cuts them, annulus points and papillary tips where they lie within 3 mm of it.

    Parameters
    ----------
    volume, valve
        Frame k of one is frame k of the other.
    title : str
        What is shown, such as the name of the sequence.
    closed : int, optional
        A frame that must be among those shown.
    low_confidence : float
        Frames below this are marked in words.
    accepted : bool
        False for the best candidate of a volume in which no valve was found: the head says so.

    Raises
    ------
    InputError
        The two have other numbers of frames or other times.
    """
    count, low = len(valve.times), ~(valve.frame_confidence >= low_confidence)
    if len(volume.times) != count or not np.allclose(
        volume.times - volume.times[0], valve.times - valve.times[0], atol=1e-6
    ):
        raise InputError(
            f"montage {title}: volume of {len(volume.times)} frames and valve of "
            f"{count}, expected the same frames at the same times"
        )
    frames, planes = chosen_frames(count, closed), {}
    for frame in frames:
        with suppress(GeometryError):
            planes[frame] = valve_planes(valve, frame)
    extents = {name: _extent(valve, planes, name) for name in COLUMNS}
    slices = {
        (frame, name): resample(volume, frame, plane, extents[name])
        for frame, named in planes.items()
        for name, plane in named.items()
    }
    # Grey values drawn black and white: all but the darkest and brightest 0.5 %.
    seen = [image[np.isfinite(image)] for image in slices.values()]
    values = np.concatenate([np.zeros(0), *seen])
    window = np.quantile(values, [0.005, 0.995]) if len(values) else (0.0, 1.0)
    widths = [right - left for left, right, _, _ in extents.values()]
    tallest = max(top - bottom for _, _, bottom, top in extents.values())
    size = ROW_INCHES / tallest * sum(widths) + 1.3, (ROW_INCHES + 0.18) * len(frames) + 1.15
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(frames), len(COLUMNS), squeeze=False, width_ratios=widths)
    for row, frame in zip(grid, frames, strict=True):
        words = f"frame {frame}, {1e3 * valve.times[frame]:.0f} ms"
        words += ", closed" if frame == closed else ""
        words += f"\nconfidence {valve.frame_confidence[frame]:.2f}"
        words += "\nLOW CONFIDENCE" if low[frame] else ""
        row[0].set_ylabel(words, fontsize=SMALL)
        for axes, name in zip(row, COLUMNS, strict=True):
            _bare(axes, extents[name], marked=bool(low[frame]))
            if frame in planes:
                axes.imshow(
                    slices[frame, name], "gray", origin="lower", extent=extents[name],
                    vmin=window[0], vmax=window[1], interpolation="nearest",
                )  # fmt: skip
                _draw_valve(axes, valve, frame, planes[frame][name])
            else:
                axes.text(0.5, 0.5, "no valve", transform=axes.transAxes, ha="center", color="w")
    for axes, (name, how) in zip(grid[0], COLUMNS.items(), strict=True):
        axes.set_title(f"{name}\n({how})", fontsize=9)
        _scale_bar(axes, extents[name])
    if not accepted:
        title = f"NO VALVE FOUND; best candidate, not accepted: {title}"
    headline(figure, title, _note(low, low_confidence))
    if planes:
        keys = grid[frames.index(min(planes)), 0].get_legend_handles_labels()
        figure.legend(*keys, loc="outside lower center", ncols=4, fontsize=SMALL, frameon=False)
    return figure


def _note(low: BoolArray, low_confidence: float) -> str:
    """Which of all frames are not trusted, shown or not."""
    if not low.any():
        return f"All {len(low)} frames have a confidence of {low_confidence:g} or more."
    named = ", ".join(map(str, np.flatnonzero(low)[:12])) + (", ..." if low.sum() > 12 else "")
    return f"Confidence below {low_confidence:g} in {low.sum()} of {len(low)} frames: {named}."


def _extent(
    valve: ValveSequence, planes: Mapping[int, Mapping[str, SlicePlane]], name: str
) -> Extent:
    """For one column the smallest box around the valve in all rows, and a margin."""
    places = [np.array([[-20.0, -20.0], [20.0, 20.0]])] if not planes else []
    for frame, named in planes.items():
        points = [valve.vertices[frame], *([valve.tips[frame]] if name in ALONG else [])]
        places.append(named[name].coordinates(np.concatenate(points))[:, :2])
    every = np.concatenate(places)
    left, bottom = np.floor((every.min(axis=0) - MARGIN_MM) / STEP_MM) * STEP_MM
    right, top = np.ceil((every.max(axis=0) + MARGIN_MM) / STEP_MM) * STEP_MM
    return float(left), float(right), float(bottom), float(top)


def _bare(axes: Any, extent: Extent, *, marked: bool) -> None:
    """A panel without ticks; with a dashed frame where its frame is not trusted."""
    axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[], facecolor=OUTSIDE)
    axes.set(aspect="equal", anchor="N")
    if marked:
        for spine in axes.spines.values():
            spine.set(color=BAD, linewidth=2.2, linestyle="--")


def _draw_valve(axes: Any, valve: ValveSequence, frame: int, plane: SlicePlane) -> None:
    contours = leaflet_contours(valve, frame, plane)
    names = valve.layout.region_names
    for name, colour, segments in zip(names, LEAFLET_COLOURS[: len(names)], contours, strict=True):
        lines = LineCollection(list(segments), colors=colour, linewidths=1.3)
        lines.set_label(f"{name} leaflet")
        axes.add_collection(lines)
    for points, (label, style) in zip(
        (valve.annulus[frame], valve.tips[frame]), DOTS.items(), strict=True
    ):
        places = plane.coordinates(points)
        close = places[np.abs(places[:, 2]) <= REACH_MM, :2]
        axes.plot(*close.T, label=label, ls="none", mec="black", **style)


def _scale_bar(axes: Any, extent: Extent) -> None:
    left, bottom = extent[0] + 2.0, extent[2] + 2.5
    edge = [withStroke(linewidth=4, foreground="black")]
    axes.plot(
        [left, left + SCALE_MM], [bottom, bottom], color="white", lw=2.2, label="_scale",
        path_effects=edge, solid_capstyle="butt",
    )  # fmt: skip
    axes.text(
        left + 0.5 * SCALE_MM, bottom + 1.0, f"{SCALE_MM:.0f} mm", color="white", fontsize=7.5,
        ha="center", va="bottom", path_effects=[withStroke(linewidth=2, foreground="black")],
    )  # fmt: skip
