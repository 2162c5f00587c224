"""Quality control of a valve from images: its outlines drawn on slices of the volume.

The slices lie in the planes in which a mitral valve is looked at. All positions are LPS mm. A plane
has its own coordinates: mm to the right and up from its origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from scipy.ndimage import map_coordinates

from mvest.errors import GeometryError, InputError
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, ValveSequence, landmarks
from mvest.imaging.volume import VolumeSequence
from mvest.reporting.figures import LEAFLET_COLOURS
from mvest.reporting.style import headline
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


LEAFLETS = LEAFLET_COLOURS[:2]
"""Of the anterior and the posterior leaflet."""
TIP, ANNULUS = "#F0E442", "white"
REACH_MM = 3.0
"""Up to which distance from a plane annulus points and papillary tips are drawn in it."""
SCALE_MM = 10.0
MARGIN_MM = 7.0
ROW_INCHES = 2.35
OUTSIDE = "#3a3f4a"

HOW = dict(
    zip(
        COLUMNS,
        (
            "through the tips' middle, atrium up",
            "atrium up, anterior right",
            "from the atrium, anterior up",
            "1 mm above the higher one, anterior up",
        ),
        strict=True,
    )
)

Extent = tuple[float, float, float, float]


def chosen_frames(count: int, closed: int | None = None, most: int = 6) -> list[int]:
    """At most ``most`` of ``count`` frames, evenly spaced from the first to the last.

    The closed one, if given, takes the place of the nearest that is not the first.

    Raises
    ------
    InputError
        No frames, or a closed frame that is none of them.
    """
    if count < 1 or most < 2 or not (closed is None or 0 <= closed < count):
        raise InputError(
            f"montage of {count} frames, at most {most}, closed frame {closed}: expected at least "
            f"one frame, two at most or more, and a closed one from 0 to {count - 1}"
        )
    frames = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
    if closed is not None and closed not in frames:
        later = frames[1:]
        later[np.argmin(np.abs(later - closed))] = closed
    return sorted(int(frame) for frame in frames)


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
    if len(volume.times) != len(valve.times) or not np.allclose(
        volume.times - volume.times[0], valve.times - valve.times[0], atol=1e-6
    ):
        raise InputError(
            f"montage {title}: volume of {len(volume.times)} frames and valve of "
            f"{len(valve.times)}, expected the same frames at the same times"
        )
    frames = chosen_frames(len(valve.times), closed)
    usable = [frame for frame in frames if _finite(valve, frame)]
    planes = {frame: valve_planes(valve, frame) for frame in usable}
    extents = _extents(valve, planes)
    slices = {
        (frame, name): resample(volume, frame, planes[frame][name], extents[name])
        for frame in usable
        for name in COLUMNS
    }
    low, high = _window(list(slices.values()))
    sizes = [extents[name] for name in COLUMNS]
    widths = [right - left for left, right, _, _ in sizes]
    tallest = max(top - bottom for _, _, bottom, top in sizes)
    inches = ROW_INCHES / tallest
    figure = Figure(
        figsize=(inches * sum(widths) + 1.3, (ROW_INCHES + 0.18) * len(frames) + 1.15),
        layout="constrained",
    )
    grid = figure.subplots(
        len(frames), len(COLUMNS), squeeze=False, gridspec_kw={"width_ratios": widths}
    )
    for row, frame in enumerate(frames):
        grid[row, 0].set_ylabel(_words(valve, frame, low_confidence, frame == closed), fontsize=8.5)
        for column, name in enumerate(COLUMNS):
            axes = grid[row, column]
            _bare(axes, extents[name])
            if row == 0:
                axes.set_title(_heading(name), fontsize=9)
            if frame in planes:
                _draw(axes, slices[frame, name], (low, high), extents[name])
                _draw_valve(axes, valve, frame, planes[frame][name])
            else:
                axes.text(0.5, 0.5, "no valve", transform=axes.transAxes, ha="center", color="w")
            if row == 0:
                _scale_bar(axes, extents[name])
            _mark(axes, valve, frame, low_confidence)
    if not accepted:
        title = f"NO VALVE FOUND; best candidate, not accepted: {title}"
    headline(figure, title, _note(valve, low_confidence))
    figure.legend(
        handles=_keys(valve), loc="outside lower center", ncols=4, fontsize=8.5, frameon=False
    )
    return figure


def _note(valve: ValveSequence, low_confidence: float) -> str:
    """Which of all frames are not trusted, shown or not."""
    low = np.flatnonzero(~(valve.frame_confidence >= low_confidence))
    count = len(valve.times)
    if not len(low):
        return f"All {count} frames have a confidence of {low_confidence:g} or more."
    named = ", ".join(str(frame) for frame in low[:12]) + (", ..." if len(low) > 12 else "")
    return f"Confidence below {low_confidence:g} in {len(low)} of {count} frames: {named}."


def _finite(valve: ValveSequence, frame: int) -> bool:
    return bool(np.isfinite(valve.vertices[frame]).all() and np.isfinite(valve.tips[frame]).all())


def _extents(
    valve: ValveSequence, planes: Mapping[int, Mapping[str, SlicePlane]]
) -> dict[str, Extent]:
    """For each column the smallest box around the valve in all rows, and a margin; mm."""
    extents: dict[str, Extent] = {}
    for name in COLUMNS:
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for frame, named in planes.items():
            points = [valve.vertices[frame]]
            if name in COLUMNS[:2]:
                points.append(valve.tips[frame])
            places = named[name].coordinates(np.concatenate(points))[:, :2]
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
        if not planes:
            low, high = np.full(2, -20.0), np.full(2, 20.0)
        low = np.floor((low - MARGIN_MM) / STEP_MM) * STEP_MM
        high = np.ceil((high + MARGIN_MM) / STEP_MM) * STEP_MM
        extents[name] = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    return extents


def _window(slices: list[FloatArray]) -> tuple[float, float]:
    """Grey values drawn black and white: all but the darkest and brightest 0.5 %."""
    values = np.concatenate([one[np.isfinite(one)] for one in slices]) if slices else np.zeros(0)
    if not len(values):
        return 0.0, 1.0
    low, high = np.quantile(values, [0.005, 0.995])
    return float(low), float(max(high, low + 1e-6))


def _words(valve: ValveSequence, frame: int, low_confidence: float, closed: bool) -> str:
    confidence = float(valve.frame_confidence[frame])
    state = ", closed" if closed else ""
    words = f"frame {frame}, {1e3 * valve.times[frame]:.0f} ms{state}"
    words += f"\nconfidence {confidence:.2f}"
    return words + ("\nLOW CONFIDENCE" if not confidence >= low_confidence else "")


def _heading(name: str) -> str:
    return f"{name}\n({HOW[name]})"


def _bare(axes: Any, extent: Extent) -> None:
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor(OUTSIDE)
    axes.set_anchor("N")


def _draw(axes: Any, image: FloatArray, window: tuple[float, float], extent: Extent) -> None:
    grey = colormaps["gray"].with_extremes(bad=OUTSIDE)
    axes.imshow(
        np.ma.masked_invalid(image), origin="lower", extent=extent, cmap=grey, vmin=window[0],
        vmax=window[1], interpolation="nearest", rasterized=True,
    )  # fmt: skip


def _draw_valve(axes: Any, valve: ValveSequence, frame: int, plane: SlicePlane) -> None:
    for name, colour, segments in zip(
        valve.layout.region_names, LEAFLETS, leaflet_contours(valve, frame, plane), strict=True
    ):
        axes.add_collection(
            LineCollection(list(segments), colors=colour, linewidths=1.3, label=name)
        )
    for points, kind in ((valve.annulus[frame], "annulus"), (valve.tips[frame], "tips")):
        places, close = near(plane, points, REACH_MM)
        axes.plot(*places[close].T, label=kind, **_STYLE[kind])


_STYLE: dict[str, dict[str, Any]] = {
    "annulus": {
        "ls": "none", "marker": "o", "ms": 2.4, "mfc": ANNULUS, "mec": "black", "mew": 0.4,
    },
    "tips": {"ls": "none", "marker": "^", "ms": 7, "mfc": TIP, "mec": "black", "mew": 0.8},
}  # fmt: skip


def _keys(valve: ValveSequence) -> list[Line2D]:
    leaflets = [
        Line2D([], [], color=colour, lw=2, label=f"{name} leaflet")
        for name, colour in zip(valve.layout.region_names, LEAFLETS, strict=True)
    ]
    words = {"annulus": "annulus, within 3 mm", "tips": "papillary tip, within 3 mm"}
    return [*leaflets, *(Line2D([], [], label=words[k], **s) for k, s in _STYLE.items())]


def _scale_bar(axes: Any, extent: Extent) -> None:
    left, bottom = extent[0] + 2.0, extent[2] + 2.5
    edge = [withStroke(linewidth=4, foreground="black")]
    axes.plot(
        [left, left + SCALE_MM], [bottom, bottom], color="white", lw=2.2, label="scale",
        path_effects=edge, solid_capstyle="butt",
    )  # fmt: skip
    axes.text(
        left + 0.5 * SCALE_MM, bottom + 1.0, f"{SCALE_MM:.0f} mm", color="white", fontsize=7.5,
        ha="center", va="bottom", path_effects=[withStroke(linewidth=2, foreground="black")],
    )  # fmt: skip


def _mark(axes: Any, valve: ValveSequence, frame: int, low_confidence: float) -> None:
    """A dashed frame about the panels of a frame that is not trusted."""
    if not valve.frame_confidence[frame] >= low_confidence:
        for spine in axes.spines.values():
            spine.set(color="#D55E00", linewidth=2.2, linestyle="--")
