"""Pictures of a valve detected in images: its outlines on slices of the volume, and its measures.

The slices lie in the usual planes of a mitral valve. All positions are LPS mm; a plane has its own
coordinates, mm to the right and up from its origin.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.ndimage import map_coordinates

from mvest.cases.from_images.detected import DetectedValve, called, write_detected
from mvest.errors import GeometryError, InputError
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, ValveSequence, landmarks
from mvest.imaging.volume import VolumeSequence
from mvest.reporting.case.tables import unit_of_measure
from mvest.reporting.figures import (
    BAD,
    COLOURS,
    GREY,
    LEAFLET_COLOURS,
    MARKERS,
    SMALL,
    headline,
    panels,
    save_figure_with,
    scale_bar,
)
from mvest.typing import FloatArray
from mvest.valve.geometry.proximity import plane_section
from mvest.valve.measure.annulus import annulus_plane, unit_vector

COLUMNS = {
    "commissural": "through the tips' middle, atrium up",
    "anteroposterior": "atrium up, anterior right",
    "at the annulus": "from the atrium, anterior up",
    "at the free edge": "1 mm above the higher one, anterior up",
}
"""Planes of `valve_planes`, two along the valve's axis and two across, with their orientation."""

ALONG = ("commissural", "anteroposterior")
"""Planes that show the papillary tips."""
ABOVE_EDGE_MM = 1.0
STEP_MM = 0.4
"""Between pixels."""
MOST_ROWS = 6
REACH_MM = 3.0
"""Annulus points and papillary tips are drawn in a plane up to this distance from it."""
MARGIN_MM = 7.0
ROW_INCHES = 2.35
DOTS: Mapping[str, Mapping[str, Any]] = {
    "annulus, within 3 mm": {"marker": "o", "ms": 2.4, "mfc": "white", "mew": 0.4},
    "papillary tip, within 3 mm": {"marker": "^", "ms": 7, "mfc": "#F0E442", "mew": 0.8},
}

OVER_TIME = {
    "Annulus area": {"annulus_area_mm2": "projected", "annulus_area_3d_mm2": "in space"},
    "Annulus diameters": {
        "ap_diameter_mm": "anteroposterior",
        "commissural_diameter_mm": "commissural",
    },
    "Annulus height": {"annulus_height_mm": "height"},
    "Closed leaflets": {"tenting_height_mm": "tenting height", "billow_height_mm": "billow height"},
    "Orifice": {"orifice_mm2": "seen from the atrium"},
    "Coaptation": {"coaptation_length_mm": "length in the middle"},
    "Leaflet areas": {"anterior_area_mm2": "anterior", "posterior_area_mm2": "posterior"},
    "Papillary tips": {"tip_separation_mm": "between the tips", "tip_depth_mm": "mean depth"},
}
"""Title of a panel -> its measures and their labels."""

CAPTIONS = {
    "montage": "The valve as it was detected, drawn on the volume.",
    "measures_over_time": (
        "Measures of the valve over time. Hollow: frames of low confidence. Bands: 95 % intervals, "
        "from the detectors' errors on simulated valves."
    ),
}

Extent = tuple[float, float, float, float]
"""Left, right, bottom and top in a plane, mm."""


# -- files of the image step ----------------------------------------------------------------------
def write_image_step(
    detected: DetectedValve, folder: Path, draw: bool = True
) -> dict[str, tuple[Mapping[str, Any], ...]]:
    """Write a detected valve into an existing folder, pictures only if ``draw``.

    Returns `DetectedValve.details`.
    """
    files = write_detected(detected, folder)
    volume, valve, closed = detected.volume, detected.valve, detected.frames.closed
    name, low = detected.case.name, detected.settings.min_confidence
    drawn = {}
    if draw:
        drawn["montage"] = montage_figure(
            volume, valve, title=name, closed=closed, low_confidence=low
        )
        drawn["measures_over_time"] = measures_figure(detected.rows, title=name, low_confidence=low)
    for key, figure in drawn.items():
        save_figure_with(folder / key, figure, called(volume))
    pictures = [{"file": f"{key}.png", "caption": CAPTIONS[key]} for key in drawn]
    return detected.details(files, pictures)


def draw_candidate(
    volume: VolumeSequence, candidate: ValveSequence, low_confidence: float, folder: Path
) -> Path:
    """Draw a candidate that was not accepted, with a title that says so; returns the picture."""
    folder.mkdir(parents=True, exist_ok=True)
    title = f"NO VALVE FOUND; best candidate, not accepted: {called(volume)}"
    figure = montage_figure(volume, candidate, title=title, low_confidence=low_confidence)
    return save_figure_with(folder / "candidate", figure, called(volume))[0]


# -- the valve on slices of the volume ------------------------------------------------------------
@dataclass(frozen=True, slots=True, eq=False)
class SlicePlane:
    """A plane with its own axes."""

    origin: FloatArray  #: (3,) mm
    #: (3,), orthonormal
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

    The commissural plane contains both commissures and the middle between the papillary tips. The
    anteroposterior (three-chamber) plane contains the middles of both sides of the annulus and the
    valve's axis. Both have the atrium up. The planes across are seen from the atrium with the
    anterior side up: one through the centre of the annulus, and one 1 mm above the middle of the
    higher free edge, which cuts both leaflets.

    GeometryError if positions are not finite, or are on one line.
    """
    named, tips = landmarks(valve, frame), valve.tips[frame]
    if not (np.isfinite(valve.vertices[frame]).all() and np.isfinite(tips).all()):
        raise GeometryError(f"frame {frame}: positions are not finite, so there are no planes")
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
    """A trilinearly interpolated slice of one frame.

    Returns ``(rows, columns)`` pixels of `STEP_MM` from the bottom up; NaN outside the volume.
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
    """Segments ``(k, 2, 2)`` mm in which a plane cuts each leaflet, by region."""
    layout, contours = valve.layout, []
    for number in range(len(layout.region_names)):
        triangles = layout.triangles[layout.region == number]
        points, normal = valve.vertices[frame], plane.axes[:, 2]
        segments, _ = plane_section(points, triangles, plane.origin, normal)
        contours.append(plane.coordinates(segments)[..., :2])
    return contours


def chosen_frames(count: int, closed: int | None = None) -> list[int]:
    """At most `MOST_ROWS` of ``count`` frames, evenly spaced from the first to the last.

    A given closed frame replaces the nearest of them, except the first.
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
) -> Figure:
    """Frames in rows and the planes of `valve_planes` in columns, with outlines of the valve.

    Every row has the planes of its own frame, and all panels have one scale. Leaflets are drawn
    where the plane cuts them, annulus points and papillary tips if they are within 3 mm of it.

    InputError if numbers or times of the frames differ.

    Parameters
    ----------
    volume, valve
        With the same frames.
    title : str
    closed : int, optional
        A frame to be shown.
    low_confidence : float
        Frames below this are marked in words and by a dashed frame.
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
    # The darkest and brightest 0.5 % of the pixels are black and white.
    values = np.concatenate([[], *(image[np.isfinite(image)] for image in slices.values())])
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
            extent = extents[name]
            axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[], facecolor="#3a3f4a")
            axes.set(aspect="equal", anchor="N")
            if low[frame]:
                axes.spines[:].set(color=BAD, linewidth=2.2, linestyle="--")
            if frame in planes:
                axes.imshow(
                    slices[frame, name], "gray", origin="lower", extent=extent,
                    vmin=window[0], vmax=window[1], interpolation="nearest",
                )  # fmt: skip
                _draw_valve(axes, valve, frame, planes[frame][name])
            else:
                axes.text(0.5, 0.5, "no valve", transform=axes.transAxes, ha="center", color="w")
    for axes, (name, how) in zip(grid[0], COLUMNS.items(), strict=True):
        axes.set_title(f"{name}\n({how})", fontsize=9)
        scale_bar(axes, "white")
    note = f"All {count} frames have a confidence of {low_confidence:g} or more."
    if low.any():
        named = ", ".join(map(str, np.flatnonzero(low)))
        note = f"Confidence below {low_confidence:g} in {low.sum()} of {count} frames: {named}."
    headline(figure, title, note)
    if planes:
        keys = grid[frames.index(min(planes)), 0].get_legend_handles_labels()
        figure.legend(*keys, loc="outside lower center", ncols=4, fontsize=SMALL, frameon=False)
    return figure


def _extent(
    valve: ValveSequence, planes: Mapping[int, Mapping[str, SlicePlane]], name: str
) -> Extent:
    """The smallest box around the valve in all rows of a column, with a margin."""
    places = [np.array([[-20.0, -20.0], [20.0, 20.0]])] if not planes else []
    for frame, named in planes.items():
        points = [valve.vertices[frame], *([valve.tips[frame]] if name in ALONG else [])]
        places.append(named[name].coordinates(np.concatenate(points))[:, :2])
    every = np.concatenate(places)
    left, bottom = np.floor((every.min(axis=0) - MARGIN_MM) / STEP_MM) * STEP_MM
    right, top = np.ceil((every.max(axis=0) + MARGIN_MM) / STEP_MM) * STEP_MM
    return float(left), float(right), float(bottom), float(top)


def _draw_valve(axes: Any, valve: ValveSequence, frame: int, plane: SlicePlane) -> None:
    contours = leaflet_contours(valve, frame, plane)
    for name, colour, segments in zip(
        valve.layout.region_names, LEAFLET_COLOURS, contours, strict=False
    ):
        lines = LineCollection(list(segments), colors=colour, linewidths=1.3)
        lines.set_label(f"{name} leaflet")
        axes.add_collection(lines)
    for points, (label, style) in zip(
        (valve.annulus[frame], valve.tips[frame]), DOTS.items(), strict=True
    ):
        places = plane.coordinates(points)
        close = places[np.abs(places[:, 2]) <= REACH_MM, :2]
        axes.plot(*close.T, label=label, ls="none", mec="black", **style)


# -- measures over time ---------------------------------------------------------------------------
def measures_figure(
    rows: Sequence[Mapping[str, Any]], *, title: str, low_confidence: float
) -> Figure:
    """Measures of a valve over time.

    Parameters
    ----------
    rows : sequence of mapping
        From `mvest.cases.from_images.measures.measure_sequence`: ``time_s``, ``confidence`` and the
        measures of each frame; None leaves a gap. Measures with bounds
        (`mvest.cases.from_images.detector_errors.with_bands`) have a band.
    title : str
    low_confidence : float
        Frames below this are hollow.
    """
    table = pd.DataFrame(list(rows))
    time, sure = 1e3 * table["time_s"], table["confidence"] >= low_confidence
    figure, grid = panels(4, 2, 9.6, sharex=True)
    for axes, (heading, curves) in zip(grid.flat, OVER_TIME.items(), strict=True):
        axes.set_title(heading, fontsize=SMALL + 0.5, loc="left")
        axes.set_ylabel(unit_of_measure(next(iter(curves))))
        bounds = [f"{name}_{end}" for name in curves for end in ("low", "high")]
        shown = table.reindex(columns=[*curves, *bounds]).astype(float)
        for (name, words), colour, marker in zip(curves.items(), COLOURS, MARKERS, strict=False):
            axes.plot(time, shown[name], color=colour, lw=1.2, label=words)
            if f"{name}_low" in table:
                band = shown[f"{name}_low"], shown[f"{name}_high"]
                axes.fill_between(time, *band, color=colour, alpha=0.16, lw=0)
            style = {"marker": marker, "ms": 4.2, "mec": colour, "ls": "none"}
            axes.plot(time[sure], shown[name][sure], mfc=colour, **style)
            axes.plot(time[~sure], shown[name][~sure], mfc="white", **style)
        if len(curves) > 1:
            axes.legend(fontsize=SMALL - 0.5, frameon=False, handlelength=1.4)
        if shown.isna().all(axis=None):
            style = {"ha": "center", "fontsize": SMALL, "color": GREY}
            axes.text(0.5, 0.5, "not measured in any frame", transform=axes.transAxes, **style)
            continue
        # These limits do not magnify noise, and leave space for the legend above the curves.
        low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
        span, middle = max(high - low, 0.1 * max(abs(high), abs(low)), 0.5), 0.5 * (high + low)
        axes.set_ylim(middle - 0.6 * span, middle + 0.95 * span)
    for axes in grid[-1]:
        axes.set_xlabel("time [ms]")
    bands = " Bands: 95 %." if table.columns.str.endswith("_low").any() else ""
    note = f"Hollow: confidence below {low_confidence:g} ({(~sure).sum()} of {len(sure)} frames). "
    headline(figure, title, f"{note}Gaps: not measurable.{bands}")
    return figure
