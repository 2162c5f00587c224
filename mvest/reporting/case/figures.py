"""Figures of one case: shapes, distances and intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from mvest.errors import InputError
from mvest.problem.fields import CaseFields, case_fields, turn_of
from mvest.problem.record import EstimateRecord, Spread, Unknown
from mvest.reporting.case.drawing import (
    corner_colours,
    distance_top,
    draw_valve,
    leaflet_colours,
    name_leaflets,
    paint_leak,
    same_scale,
)
from mvest.reporting.figures import ATRIUM, COLOURS, DISTANCE_MAP, SIDE, TEXT, VIEWS
from mvest.typing import FloatArray
from mvest.valve.geometry.surface_coordinates import boundary_loops

if TYPE_CHECKING:
    from mvest.cases.case import ValveCase

PRIOR, POSTERIOR, WITHOUT = "0.75", COLOURS[0], COLOURS[1]
TWO_SIDED = 1.96
"""Standard deviations within which 95 % of a normal distribution lie."""


class _Shape(NamedTuple):
    """A valve at ``points (n, 3)`` mm with the papillary tips of a frame.

    Where it has ``colours (m, 3, 3)`` of the corners of its triangles, neither chordae nor tips are
    drawn, so that they are seen.
    """

    title: str
    fields: CaseFields
    points: FloatArray
    frame: int
    colours: FloatArray | None = None


def shapes_figure(fields: CaseFields, names: Sequence[str]) -> Figure:
    """The valve at rest and in the closed frame (observed, personalised), from two sides."""
    k, model = fields.closed, "generic" if fields.fitted is None else "personalised"
    closed = {
        "closed, observed": fields.observed,
        f"closed, {model} model": fields.generic if fields.fitted is None else fields.fitted,
    }
    shapes = [_Shape("open (reference)", fields, fields.rest, 0)]
    for title, points in closed.items():
        if points is not None:
            shapes.append(_Shape(title, fields, points[k], k + 1))
    return _views_figure(shapes, names, (3.0 * len(shapes), 5.9), 1.15)[0]


def _views_figure(
    shapes: Sequence[_Shape], names: Sequence[str], size: tuple[float, float], lower: float
) -> tuple[Figure, Any]:
    """Shapes of valves from two sides, the lower row so many times as high as the upper one."""
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(2, len(shapes), squeeze=False, height_ratios=[1.0, lower])
    for row, view in zip(grid, VIEWS, strict=True):
        reach = []
        for axes, (title, fields, points, frame, colours) in zip(row, shapes, strict=True):
            shut = view is ATRIUM and frame > 0
            reach.append(points)
            if colours is not None:
                draw_valve(axes, fields, points, colours, view, frame, strength=0.3)
            else:
                # Seen from the atrium, a closed valve hides its chordae and tips.
                own = leaflet_colours(fields.region)
                draw_valve(axes, fields, points, own, view, frame, chords=not shut)
                reach += [fields.tips[frame]] if view is SIDE else []
            if shut:
                paint_leak(axes, fields, points, frame)
            if view is ATRIUM:
                axes.set_title(title, fontsize=TEXT, pad=10)
                name_leaflets(axes, fields, names)
        same_scale(row, reach, view)
        row[0].text(
            -0.03, 0.5, f"seen {view.name}", transform=row[0].transAxes, rotation=90, ha="right",
            va="center", fontsize=9,
        )  # fmt: skip
    return figure, grid


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
    shapes = []
    insertion = (chordae.insertion - middle) @ axes
    for frame in case.frames:
        at_rest, shut = frame.role is Role.REFERENCE, frame.role is Role.CLOSED
        vertices, annulus = ((x - middle) @ axes for x in (frame.vertices, frame.annulus))
        ring = cKDTree(annulus)
        loops = boundary_loops(frame.triangles)
        loops.sort(key=lambda loop: float(np.mean(ring.query(vertices[loop])[0])))
        fields = CaseFields(
            triangles=frame.triangles,
            region=frame.region,
            rest=vertices,
            annulus=loops[0],
            free_edge=loops[-1],
            frames=(frame.name,),
            seen=np.array([True]),
            tips=np.stack([(frame.papillary_tips - middle) @ axes] * 2),
            observed_points={},
            reach_mm=reach_mm if shut else None,
        )
        if at_rest:
            ends = np.asarray(cKDTree(vertices).query(insertion)[1], dtype=np.int64)
            fields = replace(fields, chord_tip=chordae.tip, chord_insertion=ends)
        title = f"{frame.name} ({frame.role.value})\n{frame.time:g} s, {frame.pressure_mmHg:g} mmHg"
        # Of a closed one the gap is drawn, as of a frame that is not the reference.
        shapes.append(_Shape(title, fields, vertices, int(shut)))
    return _views_figure(shapes, surface.region_names, (3.0 * len(shapes), 5.9), 1.15)[0]


def case_figure(fields: CaseFields | Path, names: Sequence[str] = ()) -> Figure:
    """The closed valve coloured by pointwise distance from the observed one, on one scale.

    The generic valve, if there is one, is beside the personalised one.

    Parameters
    ----------
    fields : CaseFields or Path
        A path is read by `mvest.problem.fields.case_fields`.
    names : sequence of str
        Of the leaflets, written beside them.

    Raises
    ------
    InputError
        If the personalised shape or its distances are missing.
    """
    fields = case_fields(fields) if isinstance(fields, Path) else fields
    if fields.fitted is None or fields.distance_fitted is None:
        raise InputError("Figure 3 needs the personalised closed valve and its distances")
    k = fields.closed
    models = {"personalised": (fields.fitted[k], fields.distance_fitted[k])}
    if fields.generic is not None and fields.distance_generic is not None:
        models = {"generic": (fields.generic[k], fields.distance_generic[k]), **models}
    largest = max(float(np.nanmax(distance)) for _, distance in models.values())
    # In the unit in which the largest is a number above 0.1.
    unit, factor = next(
        ((name, f) for name, f in (("mm", 1.0), ("µm", 1e3)) if f * largest >= 0.1), ("nm", 1e6)
    )
    top = distance_top(*(factor * distance for _, distance in models.values()))
    scale = ScalarMappable(Normalize(0.0, top), DISTANCE_MAP)
    shapes = [
        _Shape(
            f"{name} stiffness\n{Spread.of(factor * distance)} {unit}",
            fields,
            points,
            k + 1,
            corner_colours(scale, factor * distance, fields.triangles),
        )
        for name, (points, distance) in models.items()
    ]
    figure, grid = _views_figure(shapes, names, (4.3 * len(shapes), 6.6), 0.8)
    beyond = "max" if factor * largest > top else "neither"
    bar = figure.colorbar(scale, ax=grid, shrink=0.7, pad=0.02, extend=beyond)
    bar.set_label(f"distance from the observed closed valve [{unit}]")
    return figure


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
    handles: dict[str, Any] = {}
    for axes, group in zip(panels, groups, strict=True):
        in_sd = group is nuisances
        others = [without.get(one.name, Unknown(name=one.name)) for one in group]
        _draw_intervals(axes, group, others, in_sd)
        axes.set_yticks(range(len(group)), [p.label for p in group])
        axes.set_ylim(len(group) - 0.45, -0.55)
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="x", alpha=0.3)
        if in_sd:
            axes.axvline(0.0, color="0.6", linewidth=0.8)
            axes.set_xlabel("nuisances: prior standard deviations from the prior mean")
        else:
            axes.set_xlabel(f"modulus [{', '.join(dict.fromkeys(p.unit for p in group))}]")
            axes.set_xlim(left=0.0)
        handles |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(
        handles.values(), handles.keys(), loc="outside upper center", ncols=2, frameon=False,
        fontsize=8,
    )  # fmt: skip
    return figure


def _draw_intervals(
    axes: Any, unknowns: Sequence[Unknown], without: Sequence[Unknown], in_sd: bool
) -> None:
    """A row for each unknown; what is None is NaN, which matplotlib leaves out."""

    def values(source: Sequence[Unknown], name: str) -> FloatArray:
        return np.array([getattr(one, name) for one in source], dtype=float)

    rows = np.arange(len(unknowns))
    mean, std = (np.nan_to_num(values(unknowns, f"prior_{name}")) for name in ("mean", "std"))
    shift, scale = (mean, np.where(std > 0, std, 1.0)) if in_sd else (0.0, 1.0)
    low, high = ((mean + side * TWO_SIDED * std - shift) / scale for side in (-1, 1))
    axes.hlines(rows, low, high, color=PRIOR, linewidth=11, label="prior, 95 %", zorder=2)
    for source, colour, offset, marker, label in (
        (unknowns, POSTERIOR, -0.09, "o", "estimate with its 95 % interval"),
        (without, WITHOUT, 0.17, "s", "estimate if the nuisances were taken as known"),
    ):
        low, place, high = (
            (values(source, n) - shift) / scale for n in ("low", "estimate", "high")
        )
        if np.isfinite(place).any():
            axes.plot(place, rows + offset, marker, color=colour, ms=6, label=label)
            axes.hlines(rows + offset, low, high, color=colour, linewidth=2.2, zorder=2)
    truth = (values(unknowns, "truth") - shift) / scale
    if np.isfinite(truth).any():
        label = "truth of the simulation"
        axes.plot(truth, rows, "x", color="black", ms=9, mew=2, label=label, zorder=5)
