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
from mvest.problem.fields import CaseFields, case_fields, chord_fields, turn_of
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
from mvest.reporting.markup import number
from mvest.reporting.skill import HALF
from mvest.typing import FloatArray
from mvest.valve.geometry.surface_coordinates import boundary_loops

if TYPE_CHECKING:
    from mvest.cases.case import ValveCase

PRIOR, POSTERIOR, WITHOUT = "0.75", COLOURS[0], COLOURS[1]


class _Shape(NamedTuple):
    """A valve at ``points (n, 3)`` mm with the papillary tips of a frame.

    With ``colours (m, 3, 3)`` of the corners of its triangles it is drawn without chordae and tips.
    """

    title: str
    fields: CaseFields
    points: FloatArray
    frame: int
    colours: FloatArray | None = None


def shapes_figure(fields: CaseFields, names: Sequence[str]) -> Figure:
    """The valve at rest and in the closed frame (observed, personalised), from two sides."""
    k, fitted = fields.closed, fields.fitted is not None
    model = ("personalised", fields.fitted) if fitted else ("generic", fields.generic)
    shapes = [_Shape("open (reference)", fields, fields.rest, 0)]
    for title, points in (("observed", fields.observed), (f"{model[0]} model", model[1])):
        if points is not None:
            shapes.append(_Shape(f"closed, {title}", fields, points[k], k + 1))
    return _views_figure(shapes, names, (3.0 * len(shapes), 5.9), 1.15)[0]


def _views_figure(
    shapes: Sequence[_Shape], names: Sequence[str], size: tuple[float, float], lower: float
) -> tuple[Figure, Any]:
    """Shapes of valves from two sides; ``lower`` is the lower row's height over the upper one's."""
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
                # A closed valve hides its chordae and tips from the atrium.
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
    """The frames of a case as given, from two sides.

    ``reach_mm``: distance of midsurfaces within which leaflets touch. The closed frame shows its
    gap.
    """
    # Figures of a synthetic valve do not need what this imports.
    from mvest.cases.case import Role

    surface, chordae = case.surface, case.chordae
    tips = case.frame(Role.REFERENCE).papillary_tips
    middle, axes = turn_of(surface.vertices, case.annulus, surface.triangles, surface.region, tips)
    chords = chord_fields(chordae, surface.vertices)
    ends = chords["chord_insertion"]
    shapes = []
    for frame in case.frames:
        shut = frame.role is Role.CLOSED
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
        if frame.corresponds:
            # Elsewhere the insertions of the chordae are not known.
            moved = (frame.vertices - surface.vertices)[ends]
            junction = chordae.moved(frame.papillary_tips - tips, moved).junction
            fields = replace(fields, **chords | {"chord_junction": (junction - middle) @ axes})
        role = "held out" if frame.role is Role.HELD_OUT else frame.role.value
        about = f"{frame.time:g} s, {frame.pressure_mmHg:g} mmHg"
        shapes.append(_Shape(f"{frame.name} ({role})\n{about}", fields, vertices, int(shut)))
    return _views_figure(shapes, surface.region_names, (3.0 * len(shapes), 5.9), 1.15)[0]


def case_figure(fields: CaseFields | Path, names: Sequence[str] = ()) -> Figure:
    """The fitted valve coloured by pointwise distance (mm) from the observed one.

    A generic valve is drawn next to it on the same scale.

    InputError if the personalised shape or its distances are missing.

    Parameters
    ----------
    fields : CaseFields or Path
        A path is read by `mvest.problem.fields.case_fields`.
    names : sequence of str
        Of the leaflets, written next to them.
    """
    fields = case_fields(fields) if isinstance(fields, Path) else fields
    if fields.fitted is None or fields.distance_fitted is None:
        raise InputError("Figure 3 needs the personalised closed valve and its distances")
    k = fields.closed
    models = {"personalised": (fields.fitted[k], fields.distance_fitted[k])}
    if fields.generic is not None and fields.distance_generic is not None:
        models = {"generic": (fields.generic[k], fields.distance_generic[k]), **models}
    distances = [distance for _, distance in models.values()]
    top = distance_top(*distances)
    scale = ScalarMappable(Normalize(0.0, top), DISTANCE_MAP)
    shapes = []
    for name, (points, distance) in models.items():
        spread = Spread.of(distance)
        small = f"{number(spread.mean, 2)} ± {number(spread.std, 2)}"
        title = f"{name} stiffness\n{spread if spread.mean >= 0.01 else small} mm"
        colours = corner_colours(scale, distance, fields.triangles)
        shapes.append(_Shape(title, fields, points, k + 1, colours))
    figure, grid = _views_figure(shapes, names, (4.3 * len(shapes), 6.6), 0.8)
    beyond = "max" if np.nanmax(distances) > top else "neither"
    bar = figure.colorbar(scale, ax=grid, shrink=0.7, pad=0.02, extend=beyond)
    bar.set_label("distance from the observed valve [mm]")
    return figure


def estimates_figure(record: EstimateRecord) -> Figure:
    """Prior and estimate of each unknown with 95 % intervals, and the truth if it is known.

    Moduli are in their units, nuisances in prior standard deviations from the prior mean. A record
    without unknowns is an InputError.
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
    """A row for each unknown; None becomes NaN, which matplotlib leaves out."""

    def values(source: Sequence[Unknown], name: str) -> FloatArray:
        return np.array([getattr(one, name) for one in source], dtype=float)

    rows = np.arange(len(unknowns))
    mean, std = (np.nan_to_num(values(unknowns, f"prior_{name}")) for name in ("mean", "std"))
    shift, scale = (mean, np.where(std > 0, std, 1.0)) if in_sd else (0.0, 1.0)
    low, high = ((mean + side * HALF * std - shift) / scale for side in (-1, 1))
    axes.hlines(rows, low, high, color=PRIOR, linewidth=11, label="prior, 95 %", zorder=2)
    for source, colour, offset, marker, label in (
        (unknowns, POSTERIOR, -0.09, "o", "estimate with its 95 % interval"),
        (without, WITHOUT, 0.17, "s", "estimate with the nuisances taken as known"),
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
