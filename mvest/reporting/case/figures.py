"""Pictures of one case on the valve itself: shapes, distances, information and innovation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure

from mvest.errors import InputError
from mvest.reporting.case.drawing import (
    ATRIUM,
    SIDE,
    UNSEEN,
    VIEWS,
    draw_valve,
    leaflet_colours,
    name_leaflets,
    paint_leak,
    same_scale,
)
from mvest.reporting.case.fields import CaseFields, read_case_fields
from mvest.reporting.case.information import Information
from mvest.reporting.figures import DISTANCE_MAP
from mvest.reporting.findings import Spread
from mvest.typing import FloatArray, IntArray

__all__ = [
    "case_figure",
    "distance_top",
    "figure3_caption",
    "information_figure",
    "innovation_map_figure",
    "shapes_figure",
    "views_figure",
]

INFORMATION_MAP = "YlOrRd"
HIGH_QUANTILE = 0.99


def shapes_figure(fields: CaseFields, names: Sequence[str]) -> Figure:
    """The valve at rest and in the closed frame (observed, personalised), from two sides."""
    k = fields.closed
    shapes: list[tuple[str, FloatArray, int]] = [("open (reference)", fields.rest, 0)]
    if fields.observed is not None:
        shapes.append(("closed, observed", fields.observed[k], k + 1))
    if fields.fitted is not None:
        shapes.append(("closed, personalised model", fields.fitted[k], k + 1))
    elif fields.generic is not None:
        shapes.append(("closed, generic model", fields.generic[k], k + 1))
    return views_figure([(title, fields, points, frame) for title, points, frame in shapes], names)


def views_figure(
    shapes: Sequence[tuple[str, CaseFields, FloatArray, int]], names: Sequence[str]
) -> Figure:
    """Shapes of valves from two sides: title, valve, positions ``(n, 3)`` mm and whose tips."""
    figure = Figure(figsize=(3.0 * len(shapes), 5.9), layout="constrained")
    grid = figure.subplots(2, len(shapes), squeeze=False, height_ratios=[1.0, 1.15])
    for row, view in enumerate(VIEWS):
        reach = []
        for axes, (title, fields, points, frame) in zip(grid[row], shapes, strict=True):
            colours = leaflet_colours(fields.region)
            shut = view is ATRIUM and frame > 0
            # Seen from the atrium, a closed valve hides them.
            draw_valve(axes, fields, points, colours, view, frame, chords=not shut)
            if shut:
                paint_leak(axes, fields, points, frame)
            reach += [points, fields.tips[frame]] if view is SIDE else [points]
            if row == 0:
                axes.set_title(title, fontsize=10, pad=10)
                name_leaflets(axes, fields, names)
        same_scale(grid[row], reach, view)
        _say_view(grid[row, 0], f"seen {view.name}")
    return figure


def case_figure(fields: CaseFields | Path, names: Sequence[str] = ()) -> Figure:
    """The closed valve coloured by pointwise distance: generic beside personalised, on one scale.

    Parameters
    ----------
    fields : CaseFields or Path
        A path is read by `mvest.reporting.case.fields.read_case_fields`.
    names : sequence of str
        Of the leaflets, written beside them.

    Raises
    ------
    InputError
        If a shape or its distances are missing.
    """
    if isinstance(fields, Path):
        fields = read_case_fields(fields)
    k = fields.closed
    if fields.generic is None or fields.fitted is None:
        raise InputError("Figure 3 needs the generic and the personalised closed valve")
    if fields.distance_generic is None or fields.distance_fitted is None:
        raise InputError("Figure 3 needs the distances of the generic and the personalised valve")
    panels = (
        ("generic stiffness", fields.generic[k], fields.distance_generic[k]),
        ("personalised stiffness", fields.fitted[k], fields.distance_fitted[k]),
    )
    top = distance_top(*(distance for _, _, distance in panels))
    scale = ScalarMappable(Normalize(0.0, top), DISTANCE_MAP)
    figure = Figure(figsize=(8.6, 6.6), layout="constrained")
    grid = figure.subplots(2, 2, height_ratios=[1.25, 1.0])
    for row, view in enumerate(VIEWS):
        for column, (title, points, distance) in enumerate(panels):
            axes = grid[row, column]
            colours = corner_colours(scale, distance, fields.triangles)
            draw_valve(axes, fields, points, colours, view, k + 1, strength=0.3)
            if row == 0:
                paint_leak(axes, fields, points, k + 1)
                axes.set_title(f"{title}\n{Spread.of(distance)} mm", fontsize=11, pad=10)
                name_leaflets(axes, fields, names)
        same_scale(grid[row], [points for _, points, _ in panels], view)
        _say_view(grid[row, 0], f"seen {view.name}")
    beyond = any(np.nanmax(distance) > top for _, _, distance in panels)
    bar = figure.colorbar(
        scale, ax=grid, shrink=0.7, pad=0.02, extend="max" if beyond else "neither"
    )
    bar.set_label("distance from the observed closed valve [mm]")
    return figure


MIDSURFACES = (
    "Drawn are midsurfaces: leaflets that touch lie a thickness apart. What opens between them "
    "without a leak is grey or, where their reach is not known, white; a gap is red."
)


def figure3_caption(fields: CaseFields) -> str:
    """What Figure 3 shows, with the mean ± SD of both panels."""
    k = fields.closed
    if fields.distance_generic is None or fields.distance_fitted is None:
        raise InputError("Figure 3 needs the distances of the generic and the personalised valve")
    generic, fitted = Spread.of(fields.distance_generic[k]), Spread.of(fields.distance_fitted[k])
    count = np.isfinite(fields.distance_fitted[k]).sum()
    return (
        f"The closed valve (frame “{fields.frames[k]}”), coloured by the distance of each point "
        f"from where the valve was observed; mean ± standard deviation over {count} points. "
        f"Left: generic stiffness, {generic} mm (largest {generic.max:.2f} mm). Right: "
        f"personalised stiffness, {fitted} mm (largest {fitted.max:.2f} mm). Both on one colour "
        "scale; black line: annulus. Grey: not observed. " + MIDSURFACES
    )


def fitted_figure(fields: Path) -> Figure:
    """A fitted valve open and closed, from the atrium and from the side.

    The closed valve is coloured by the distance of each vertex from where it was observed, and grey
    where it was not seen (NaN).

    Parameters
    ----------
    fields : Path
        As `mvest.reporting.case.fields.read_case_fields` reads it, with the fitted shape and its
        distances.

    Raises
    ------
    InputError
        If it cannot be read or has none.
    """
    valve = read_case_fields(fields)
    if valve.fitted is None or valve.distance_fitted is None:
        raise InputError(f"{fields}: no fields of a fitted valve")
    k = valve.closed
    largest = float(np.nanmax(valve.distance_fitted[k]))
    # In the unit in which the largest is a number above 0.1.
    unit, factor = next(
        ((name, f) for name, f in (("mm", 1.0), ("µm", 1e3)) if f * largest >= 0.1), ("nm", 1e6)
    )
    scale = ScalarMappable(Normalize(0.0, max(factor * largest, 1e-3)), DISTANCE_MAP)
    coloured = corner_colours(scale, factor * valve.distance_fitted[k], valve.triangles)
    shapes = (
        ("open", valve.rest, leaflet_colours(valve.region), 0),
        ("closed", valve.fitted[k], coloured, k + 1),
    )
    figure = Figure(figsize=(8.4, 6.4), layout="constrained")
    panels = figure.subplots(2, 2)
    for row, view in zip(panels, VIEWS, strict=True):
        for axes, (name, points, colours, frame) in zip(row, shapes, strict=True):
            draw_valve(axes, valve, points, colours, view, frame, strength=0.3)
            if view is ATRIUM and frame:
                paint_leak(axes, valve, points, frame)
            axes.set_title(f"{name}, {view.name}", fontsize=10)
        same_scale(row, [points for _, points, _, _ in shapes], view)
    bar = figure.colorbar(scale, ax=panels[:, 1], shrink=0.6, pad=0.02)
    bar.set_label(f"distance, fitted to observed [{unit}]")
    return figure


def distance_top(*distances: FloatArray) -> float:
    """Upper end in mm of a scale for several fields: a round number at or above nearly all."""
    top = max(float(np.nanquantile(values, HIGH_QUANTILE)) for values in distances)
    if top <= 0:
        return 1e-3
    step = 10.0 ** np.floor(np.log10(top)) / 2
    return float(step * np.ceil(top / step - 1e-9))


def information_figure(fields: CaseFields, informations: Sequence[Information]) -> Figure:
    """Where on the closed valve each modulus shows: alone (top), and beyond nuisances (bottom).

    Parameters
    ----------
    fields : CaseFields
        With the fitted shape.
    informations : sequence of Information
        One for each modulus; the two maps of one share its colour scale.
    """
    if not informations:
        raise InputError("the run stored no sensitivities that fit its parameters")
    points = _closed_shape(fields)
    figure = Figure(figsize=(max(3.1 * len(informations), 4.6), 6.0), layout="constrained")
    grid = figure.subplots(2, len(informations), squeeze=False)
    for column, information in enumerate(informations):
        top = max(float(np.nanmax(information.raw)), 1e-12)
        scale = ScalarMappable(PowerNorm(0.5, 0.0, top), INFORMATION_MAP)
        for row, field in enumerate((information.raw, information.beyond)):
            axes = grid[row, column]
            colours = corner_colours(scale, field, fields.triangles)
            draw_valve(axes, fields, points, colours, ATRIUM, fields.closed + 1, strength=0.2)
            paint_leak(axes, fields, points, fields.closed + 1)
            share = "" if row == 0 else f"{100 * information.kept:.0f} % remains"
            axes.set_title(information.label if row == 0 else share, fontsize=10)
        bar = figure.colorbar(scale, ax=grid[:, column], orientation="horizontal", shrink=0.85)
        bar.set_label("information per point", fontsize=8)
        bar.ax.tick_params(labelsize=7)
        bar.set_ticks([0.0, 0.25 * top, top], labels=["0", f"{0.25 * top:.2g}", f"{top:.2g}"])
    for row, text in enumerate(("the modulus alone", "beyond what the nuisances explain")):
        same_scale(grid[row], [points], ATRIUM)
        _say_view(grid[row, 0], text)
    return figure


def innovation_map_figure(fields: CaseFields, names: Sequence[str]) -> Figure:
    """Size of the standardised innovation on the closed valve, rms of the three coordinates."""
    if fields.innovation is None:
        raise InputError("a map of the innovation needs the innovation")
    size = np.sqrt((fields.innovation**2).mean(axis=1))
    points = _closed_shape(fields)
    top = max(2.0, distance_top(size))
    scale = ScalarMappable(Normalize(0.0, top), "cividis")
    figure = Figure(figsize=(8.6, 3.6), layout="constrained")
    grid = figure.subplots(1, 2, width_ratios=[1.0, 1.1])
    for axes, view in zip(grid, VIEWS, strict=True):
        colours = corner_colours(scale, size, fields.triangles)
        draw_valve(axes, fields, points, colours, view, fields.closed + 1, strength=0.2)
        same_scale([axes], [points], view)
        axes.set_title(f"seen {view.name}", fontsize=10, pad=14)
    paint_leak(grid[0], fields, points, fields.closed + 1)
    name_leaflets(grid[0], fields, names)
    beyond = np.nanmax(size) > top
    bar = figure.colorbar(scale, ax=grid, shrink=0.85, extend="max" if beyond else "neither")
    bar.set_label("innovation over its predicted SD\n(about 1 where the model fits)")
    return figure


def corner_colours(scale: ScalarMappable, values: FloatArray, triangles: IntArray) -> FloatArray:
    """Colours ``(m, 3, 3)`` of the corners of triangles from a field ``(n,)``.

    A triangle is grey where one of its corners has no value.
    """
    known = np.isfinite(values)
    colours: FloatArray = scale.to_rgba(np.where(known, values, 0.0))[:, :3]
    whole = np.asarray(known[triangles].all(axis=1))
    return np.where(whole[:, None, None], colours[triangles], UNSEEN)


def _closed_shape(fields: CaseFields) -> FloatArray:
    for shape in (fields.fitted, fields.generic, fields.observed):
        if shape is not None:
            return shape[fields.closed]
    return fields.rest


def _say_view(axes: Any, text: str) -> None:
    axes.text(
        -0.03, 0.5, text, transform=axes.transAxes, rotation=90, ha="right", va="center", fontsize=9
    )
