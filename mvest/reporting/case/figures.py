"""Figures of one case: shapes, distances and intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from mvest.errors import InputError
from mvest.problem.fields import CaseFields, read_case_fields, turn_of
from mvest.problem.record import EstimateRecord, Spread, Unknown
from mvest.reporting.case.drawing import (
    UNSEEN,
    draw_valve,
    leaflet_colours,
    name_leaflets,
    paint_leak,
    same_scale,
)
from mvest.reporting.figures import ATRIUM, COLOURS, DISTANCE_MAP, SIDE, VIEWS
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_coordinates import boundary_loops

if TYPE_CHECKING:
    from mvest.cases.case import ValveCase

HIGH_QUANTILE = 0.99
PRIOR, POSTERIOR, WITHOUT = "0.75", COLOURS[0], COLOURS[1]
TWO_SIDED = 1.96
"""Standard deviations within which 95 % of a normal distribution lie."""


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
    return _views_figure([(title, fields, points, frame) for title, points, frame in shapes], names)


def _views_figure(
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


def frames_figure(case: ValveCase, reach_mm: float) -> Figure:
    """The frames of a case as they were given, from two sides.

    Parameters
    ----------
    case : ValveCase
    reach_mm : float
        Distance of midsurfaces within which leaflets touch: the gap of the closed frame is drawn.
    """
    surface, chordae = case.surface, case.chordae
    # Imports what reads cases, which figures of a synthetic valve do not need.
    from mvest.cases.case import Role

    tips = case.frame(Role.REFERENCE).papillary_tips
    middle, axes = turn_of(surface.vertices, case.annulus, surface.triangles, surface.region, tips)
    shapes, none = [], np.zeros(0, dtype=np.int64)
    for frame in case.frames:
        at_rest, shut = frame.role is Role.REFERENCE, frame.role is Role.CLOSED
        vertices, annulus = ((x - middle) @ axes for x in (frame.vertices, frame.annulus))
        ring = cKDTree(annulus)
        gaps = [(np.mean(ring.query(vertices[loop])[0]), loop) for loop in
                boundary_loops(frame.triangles)]  # fmt: skip
        loops = [loop for _, loop in sorted(gaps, key=lambda one: float(one[0]))]
        insertion = (chordae.insertion - middle) @ axes
        fields = CaseFields(
            frame.triangles,
            frame.region,
            vertices,
            loops[0],
            loops[-1],
            (frame.name,),
            np.array([True]),
            np.stack([(frame.papillary_tips - middle) @ axes] * 2),
            chordae.tip if at_rest else none,
            np.asarray(cKDTree(vertices).query(insertion)[1]) if at_rest else none,
            {},
            reach_mm=reach_mm if shut else None,
        )
        title = f"{frame.name} ({frame.role.value})\n{frame.time:g} s, {frame.pressure_mmHg:g} mmHg"
        # Of a closed one the gap is drawn, as of a frame that is not the reference.
        shapes.append((title, fields, vertices, int(shut)))
    return _views_figure(shapes, surface.region_names)


def case_figure(fields: CaseFields | Path, names: Sequence[str] = ()) -> Figure:
    """The closed valve coloured by pointwise distance: generic beside personalised, on one scale.

    Parameters
    ----------
    fields : CaseFields or Path
        A path is read by `mvest.problem.fields.read_case_fields`.
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
        As `mvest.problem.fields.read_case_fields` reads it, with the fitted shape and its
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


def corner_colours(scale: ScalarMappable, values: FloatArray, triangles: IntArray) -> FloatArray:
    """Colours ``(m, 3, 3)`` of the corners of triangles from a field ``(n,)``.

    A triangle is grey where one of its corners has no value.
    """
    known = np.isfinite(values)
    colours: FloatArray = scale.to_rgba(np.where(known, values, 0.0))[:, :3]
    whole = np.asarray(known[triangles].all(axis=1))
    return np.where(whole[:, None, None], colours[triangles], UNSEEN)


def _say_view(axes: Any, text: str) -> None:
    axes.text(
        -0.03, 0.5, text, transform=axes.transAxes, rotation=90, ha="right", va="center", fontsize=9
    )


def estimates_figure(record: EstimateRecord) -> Figure:
    """Each unknown with its 95 % intervals: prior, estimate, and the truth if it is known.

    Moduli are in their units, nuisances in standard deviations of the prior from its mean.

    Raises
    ------
    InputError
        If there is no unknown.
    """
    nuisances = [one for one in record.unknowns if one.kind == "nuisance"]
    groups = [group for group in (list(record.moduli), nuisances) if group]
    if not groups:
        raise InputError("a case without free parameters has no intervals to draw")
    alone = record.alternatives.get("moduli_only")
    without = {} if alone is None else {one.name: one for one in alone.moduli}
    rows = [len(group) + 0.6 for group in groups]
    figure = Figure(figsize=(8.2, 1.5 + 0.62 * sum(rows)), layout="constrained")
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=rows)[:, 0]
    for axes, group in zip(panels, groups, strict=True):
        in_sd = group is nuisances
        for row, unknown in enumerate(group):
            _intervals(axes, row, unknown, without.get(unknown.name), in_sd)
        axes.set_yticks(range(len(group)), [p.label for p in group])
        axes.set_ylim(len(group) - 0.45, -0.55)
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="x", alpha=0.3)
        if in_sd:
            axes.axvline(0.0, color="0.6", linewidth=0.8)
            axes.set_xlabel("nuisances: prior standard deviations from the prior mean")
        else:
            units = dict.fromkeys(p.unit for p in group)
            axes.set_xlabel(f"modulus [{', '.join(units)}]")
            axes.set_xlim(left=0.0)
    handles: dict[str, Any] = {}
    for axes in panels:
        handles |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(
        handles.values(), handles.keys(), loc="outside upper center", ncols=2, frameon=False,
        fontsize=8,
    )  # fmt: skip
    return figure


def _intervals(axes: Any, row: int, unknown: Unknown, without: Unknown | None, in_sd: bool) -> None:
    mean, std = unknown.prior_mean or 0.0, unknown.prior_std or 0.0
    shift, scale = (mean, std or 1.0) if in_sd else (0.0, 1.0)

    def place(*values: Any) -> Any:
        return (np.array(values, dtype=float) - shift) / scale

    ends = place(mean - TWO_SIDED * std, mean + TWO_SIDED * std)
    axes.plot(ends, [row, row], color=PRIOR, linewidth=11, solid_capstyle="butt",
              label="prior, 95 %")  # fmt: skip
    shown: tuple[tuple[Unknown | None, str, float, str, str], ...] = (
        (unknown, POSTERIOR, -0.09, "o", "estimate with its 95 % interval"),
        (without, WITHOUT, 0.17, "s", "estimate if the nuisances were taken as known"),
    )
    for source, colour, offset, marker, label in shown:
        if source is None or source.estimate is None:
            continue
        if source.low is not None and source.high is not None:
            axes.plot(place(source.low, source.high), [row + offset] * 2, color=colour,
                      linewidth=2.2, solid_capstyle="butt")  # fmt: skip
        axes.plot(place(source.estimate), [row + offset], marker, color=colour, markersize=6,
                  label=label)  # fmt: skip
    if unknown.truth is not None:
        axes.plot(place(unknown.truth), [row], "x", color="black", markersize=9,
                  markeredgewidth=2, label="truth of the simulation", zorder=5)  # fmt: skip
