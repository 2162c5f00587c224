"""Figures of a sweep over initial guesses: the basin of convergence, and the way into it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullLocator

from experiments.sweeps.collected import Sweep
from experiments.sweeps.rows import Run, factor_names, runs_of, short_names
from experiments.sweeps.statistics import BASIN_PERCENT, converged, grouped, in_basin
from mvest.reporting.style import (
    BAD,
    GOOD,
    SEQUENTIAL,
    SMALL,
    TEXT,
    headline,
    log_axis,
    panels,
    plain_axes,
    plain_number,
)
from mvest.typing import FloatArray

__all__ = ["basin_figure", "paths_figure"]

COLOUR_RANGE = (1e-3, 1e2)
"""Percent; smaller and larger errors have the colours of the ends."""
ZOOM = 5
"""Half height of an inset in standard deviations."""
MAX_NUMBERS = 8
"""Cells along one side up to which each cell can hold its number."""


def basin_figure(sweep: Sweep) -> Figure | None:
    """Error against the initial guess, a map per filter mode; None unless two starts are varied."""
    starts = [name for name in factor_names(sweep) if name.startswith("start_")]
    groups = grouped(runs_of(sweep), ["filter"])
    if len(starts) != 2 or not groups:
        return None
    figure, axes = panels(1, len(groups), 4.5, sharex=True, sharey=True)
    shown = ScalarMappable(LogNorm(*COLOUR_RANGE, clip=True), SEQUENTIAL)
    names = [name.removeprefix("start_") for name in starts]
    for one, ((mode,), group) in zip(axes.flat, groups.items(), strict=True):
        _map(one, group, starts, shown)
        inside = sum(map(in_basin, group))
        one.set_title(
            f"{mode}: {inside} of {len(group)} starts\nwithin {BASIN_PERCENT:g} %",
            fontsize=TEXT,
        )
        one.set_xlabel(f"initial guess, {names[0]} [MPa]")
    axes[0, 0].set_ylabel(f"initial guess, {names[1]} [MPa]")
    bar = figure.colorbar(shown, ax=list(axes.flat), shrink=0.85, pad=0.02, extend="both")
    bar.set_label("largest error of the moduli [%]", fontsize=SMALL + 0.5)
    bar.ax.tick_params(labelsize=SMALL)
    bar.ax.axhline(BASIN_PERCENT, color=BAD, linewidth=2.5)
    log_axis(bar.ax.yaxis)
    headline(
        figure,
        "From which initial guesses are the true moduli found?",
        f"Orange outline: basin of convergence (error at most {BASIN_PERCENT:g} %). "
        "Star: truth. Hatched ×: the run failed.",
    )
    return figure


def _map(axes: Any, runs: Sequence[Run], starts: Sequence[str], shown: ScalarMappable) -> None:
    """Cells where the guesses form a grid, single marks where they do not."""
    axes.grid(False)
    places: dict[tuple[float, ...], Run] = {}
    for run in runs:
        place = tuple(float(run.factors[name]) for name in starts)
        # Of several runs from one guess the worst is shown.
        if place not in places or _badness(run) > _badness(places[place]):
            places[place] = run
    ticks = [np.unique([place[k] for place in places]) for k in range(2)]
    scales = ["log" if _is_geometric(values) else "linear" for values in ticks]
    axes.set(xscale=scales[0], yscale=scales[1])
    if len(places) > 0.5 * len(ticks[0]) * len(ticks[1]):
        _grid(axes, places, ticks, shown)
    else:
        _marks(axes, places, shown)
    truth = runs[0].truth
    if np.isfinite(truth).all() and len(truth) == 2:
        axes.plot(*truth, marker="*", markersize=17, color=BAD, mec="white", mew=1.2, zorder=6)


def _badness(run: Run) -> float:
    return run.largest_error if run.converged and np.isfinite(run.largest_error) else np.inf


def _grid(
    axes: Any,
    places: Mapping[tuple[float, ...], Run],
    ticks: Sequence[FloatArray],
    shown: ScalarMappable,
) -> None:
    edges = [_edges(values) for values in ticks]
    numbered = max(len(values) for values in ticks) <= MAX_NUMBERS
    inside = set()
    for middle, run in places.items():
        i, j = (int(np.searchsorted(values, m)) for values, m in zip(ticks, middle, strict=True))
        corner = edges[0][i], edges[1][j]
        size = edges[0][i + 1] - corner[0], edges[1][j + 1] - corner[1]
        error = _badness(run)
        if in_basin(run):
            inside.add((i, j))
        if np.isinf(error):
            cell = Rectangle(corner, *size, facecolor="0.92", edgecolor="0.6", hatch="////", lw=0)
            axes.plot(*middle, marker="x", color="black", markersize=8, mew=1.8)
        else:
            colour = shown.to_rgba(np.array([error]))[0]
            cell = Rectangle(corner, *size, facecolor=colour, edgecolor="white", lw=0.5)
            if numbered:
                light = float(np.dot(colour[:3], (0.299, 0.587, 0.114)))
                axes.annotate(
                    plain_number(error), middle, ha="center", va="center", fontsize=SMALL - 1,
                    color="black" if light > 0.5 else "white",
                )  # fmt: skip
        axes.add_patch(cell)
    _outline(axes, inside, edges)
    for values, axis in zip(ticks, (axes.xaxis, axes.yaxis), strict=True):
        axis.set_minor_locator(NullLocator())
        step = 1 if len(values) <= 2 * MAX_NUMBERS else len(values) // MAX_NUMBERS
        axis.set_ticks(values[::step], [plain_number(value) for value in values[::step]])
    axes.set_xlim(edges[0][0], edges[0][-1])
    axes.set_ylim(edges[1][0], edges[1][-1])


def _marks(axes: Any, places: Mapping[tuple[float, ...], Run], shown: ScalarMappable) -> None:
    for place, run in places.items():
        error = _badness(run)
        if np.isinf(error):
            axes.plot(*place, marker="x", color="black", markersize=8, mew=1.8)
            continue
        ring = {"mec": BAD, "mew": 2.2} if in_basin(run) else {"mec": "white", "mew": 0.5}
        colour = shown.to_rgba(np.array([error]))[0]
        axes.plot(*place, marker="s", markersize=12, color=colour, **ring)
    for axis in (axes.xaxis, axes.yaxis):
        log_axis(axis)


def _is_geometric(values: FloatArray) -> bool:
    """Whether positive guesses are spaced more evenly by their ratios than by their differences."""
    if len(values) < 3 or values[0] <= 0:
        return False
    steps = np.diff(values), np.diff(np.log(values))
    even, geometric = (float(step.std() / step.mean()) for step in steps)
    return geometric < even


def _edges(values: FloatArray) -> FloatArray:
    """Cell borders: midpoints on the axis's scale, the outer cells as wide as their neighbours."""
    geometric = _is_geometric(values)
    x = np.log(values) if geometric else values
    if len(x) == 1:
        return np.array([x[0] - 0.5, x[0] + 0.5])
    middle = 0.5 * (x[1:] + x[:-1])
    edges = np.concatenate([[2 * x[0] - middle[0]], middle, [2 * x[-1] - middle[-1]]])
    return np.exp(edges) if geometric else edges


def _outline(axes: Any, inside: set[tuple[int, int]], edges: Sequence[FloatArray]) -> None:
    """Lines between cells in the basin and those that are not."""
    x, y = edges
    for i, j in sorted(inside):
        for neighbour, xs, ys in (
            ((i - 1, j), (x[i], x[i]), (y[j], y[j + 1])),
            ((i + 1, j), (x[i + 1], x[i + 1]), (y[j], y[j + 1])),
            ((i, j - 1), (x[i], x[i + 1]), (y[j], y[j])),
            ((i, j + 1), (x[i], x[i + 1]), (y[j + 1], y[j + 1])),
        ):
            if neighbour not in inside:
                axes.plot(xs, ys, color=BAD, linewidth=3, solid_capstyle="projecting", zorder=5,
                          clip_on=False)  # fmt: skip


def paths_figure(sweep: Sweep) -> Figure | None:
    """Estimate against iteration for all starts, a row per parameter and a column per filter."""
    runs = [run for run in runs_of(sweep) if len(run.iterates)]
    groups = grouped(runs, ["filter"])
    if not groups:
        return None
    names = short_names(sweep.parameters)
    figure, axes = panels(len(names), len(groups), 2.5 * len(names) + 0.4, sharey="row")
    for column, ((mode,), group) in enumerate(groups.items()):
        for k, name in enumerate(names):
            one = axes[k, column]
            _paths(one, group, k)
            _zoom(one, group, k)
            if column == 0:
                one.set_ylabel(f"{name} [MPa]" if _moduli(sweep) else name)
            if k == 0:
                one.set_title(mode, fontsize=TEXT)
            if k == len(names) - 1:
                one.set_xlabel("iteration")
    one = axes[0, -1]
    truth = runs[0].truth
    if np.isfinite(truth).all():
        one.annotate(
            "truth", (1.0, truth[0]), xycoords=("axes fraction", "data"), xytext=(4, 0),
            textcoords="offset points", fontsize=SMALL, va="center", annotation_clip=False,
        )  # fmt: skip
    headline(
        figure,
        "How the estimates approach the truth from every start",
        f"Blue: ends within {BASIN_PERCENT:g} % of the truth. Orange: ends elsewhere (●) or fails "
        "(×).\nInsets: the same near the truth; shaded: ± 2 SD as the filter reports it.",
    )
    return figure


def _moduli(sweep: Sweep) -> bool:
    return all(name.startswith("E_f.") for name in sweep.parameters)


def _paths(axes: Any, runs: Sequence[Run], k: int) -> None:
    good = converged(runs)
    values = np.concatenate([run.iterates[:, k] for run in runs])
    values = values[np.isfinite(values)]
    span = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    margin = 0.06 * (span[1] - span[0] or 1.0)
    for run in runs:
        _path(axes, run, k, "o" if run in good else "x")
    if np.isfinite(runs[0].truth[k]):
        axes.axhline(runs[0].truth[k], color="black", linestyle="--", linewidth=1.2)
    axes.set_ylim(span[0] - margin, span[1] + margin)
    axes.xaxis.get_major_locator().set_params(integer=True)


def _path(axes: Any, run: Run, k: int, end: str) -> None:
    colour = GOOD if in_basin(run) else BAD
    rounds, m = np.arange(len(run.iterates)), run.iterates[:, k]
    if len(run.iterate_std) == len(m):
        s = run.iterate_std[:, k]
        # The first is the prior's, often wider than the whole picture, and no estimate.
        low, high = (m - 2 * s)[1:], (m + 2 * s)[1:]
        axes.fill_between(rounds[1:], low, high, color=colour, alpha=0.05, linewidth=0)
    axes.plot(rounds, m, color=colour, linewidth=0.9, alpha=0.75)
    axes.plot(rounds[-1], m[-1], color=colour, markersize=4, marker=end)


def _zoom(axes: Any, runs: Sequence[Run], k: int) -> None:
    """The same within a few standard deviations of the truth, where the whole leaves room."""
    good = converged(runs)
    std = [float(run.std[k]) for run in good if np.isfinite(run.std[k]) and run.std[k] > 0]
    truth = float(runs[0].truth[k])
    if not std or not np.isfinite(truth):
        return
    half = ZOOM * float(np.median(std))
    low, high = axes.get_ylim()
    if 2 * half > 0.3 * (high - low):
        return  # The whole picture shows the band already.
    above = high - truth > truth - low
    inset = axes.inset_axes((0.45, 0.62 if above else 0.1, 0.53, 0.33))
    plain_axes(inset)
    for run in runs:
        _path(inset, run, k, "o" if run in good else "x")
    inset.axhline(truth, color="black", linestyle="--", linewidth=1.2)
    inset.set_ylim(truth - half, truth + half)
    inset.set_xlim(0.5, max(len(run.iterates) for run in runs) - 0.5)
    inset.tick_params(labelsize=SMALL - 1.5)
    inset.xaxis.get_major_locator().set_params(integer=True)
    inset.yaxis.get_major_locator().set_params(nbins=3)
