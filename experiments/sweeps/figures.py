"""Figures of any sweep: errors along each factor, and errors over two factors."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from experiments.sweeps.collected import Sweep, short_names
from experiments.sweeps.report import Z95, factors_of, good_of, is_number, runs_of, values_of
from mvest.reporting.figures import (
    BAD,
    COLOURS,
    SEQUENTIAL,
    SMALL,
    TEXT,
    headline,
    log_axis,
    panels,
    plain_number,
)
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from pandas import DataFrame

SPAN = 10.0  # ratio of values from which an axis is logarithmic
# Most values of a factor that get a panel each, and most cells of panels in one row.
MOST_PANELS, MOST_CELLS = 4, 16
# Most tick labels, characters of a label that is not rotated, and of a line of a label.
TICKS, SHORT, LINE = 8, 8, 18

Values = dict[str, list[Any]]


def figures_of(sweep: Sweep) -> dict[str, Figure]:
    """Errors along each factor (``""``) and over two factors (``matrix``), if there are data."""
    runs = runs_of(sweep).frame
    values = values_of(sweep, runs)
    if good_of(runs)["signed error"].isna().all():
        return {}
    drawn = {"": _along(sweep, runs, values), "matrix": _matrix(sweep, runs, values)}
    return {name: figure for name, figure in drawn.items() if figure is not None}


def _along(sweep: Sweep, runs: DataFrame, values: Values) -> Figure | None:
    """Error and interval of each parameter against each factor, over all values of the others."""
    if not values:
        return None
    rows = -(-len(values) // 3)
    columns = -(-len(values) // rows)
    figure, grid = panels(rows, columns, 3.1 * rows + 0.8, sharey=True)
    reach: list[float] = []
    for axes, column in zip(grid.flat, values, strict=False):
        reach += _panel(axes, sweep, runs, column, values[column])
        axes.set_xlabel(_heading(sweep, column))
    for axes in grid.flat[len(values) :]:
        axes.remove()
    for axes in grid[:, 0]:
        axes.set_ylabel("error [% of the truth]")
    usual, most = float(np.percentile(reach, 25.0)), 1.2 * max(reach) or 1.0
    if most > SPAN * usual > 0:
        grid[0, 0].set_yscale("symlog", linthresh=10.0 ** np.round(np.log10(usual)))
        grid[0, 0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        most *= 2.0
    grid[0, 0].set_ylim(-most, most)
    for k, name in enumerate(short_names(sweep.parameters)):
        grid[0, 0].plot([], [], "o-", color=COLOURS[k % len(COLOURS)], label=name)
    grid[0, 0].legend(fontsize=SMALL, frameon=False)
    note = (
        "Errors along each factor, over all values of the others. Dots: median; lines: 95 % of the "
        "runs;\nbands: the 95 % interval that the filter states; crosses: some runs failed."
    )
    return _titled(figure, sweep, note)


def _panel(
    axes: Any, sweep: Sweep, runs: DataFrame, column: str, values: Sequence[Any]
) -> list[float]:
    """Draw one factor; returns the largest errors or intervals at each of its values."""
    places = _places(values)
    gap, count = float(np.diff(places).min()), len(sweep.parameters)
    reach = []
    for place, value in zip(places, values, strict=True):
        group = runs[runs[column] == value]
        good = good_of(group).dropna(subset="signed error")
        if (group["status"] != "converged").any():
            axes.plot(place, 0.02, "x", color=BAD, markersize=6, mew=1.6, clip_on=False,
                      transform=axes.get_xaxis_transform(), zorder=6)  # fmt: skip
        for k, name in enumerate(sweep.parameters):
            own = good[good["parameter"] == name]
            error = own["signed error"].to_numpy()
            if not error.size:
                continue
            colour = COLOURS[k % len(COLOURS)]
            at = place + 0.6 * gap * ((k + 0.5) / count - 0.5)
            half = float(np.nan_to_num((100.0 * Z95 * own["std"] / own["true value"]).mean()))
            low, middle, high = np.percentile(error, [2.5, 50.0, 97.5])
            axes.bar(at, 2 * half, 0.4 * gap / count, middle - half, color=colour, alpha=0.25)
            axes.plot([at, at], [low, high], color=colour, linewidth=1.5)
            axes.plot(at, middle, "o", color=colour, markersize=4)
            reach.append(max(half, float(np.abs(error).max())))
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.grid(axis="x", visible=False)
    axes.set_xlim(places[0] - 0.6 * gap, places[-1] + 0.6 * gap)
    shown: list[int] = []
    for k, place in enumerate(places):
        crowded = is_number(values) and shown and place - places[shown[-1]] < np.ptp(places) / TICKS
        if not crowded:
            shown.append(k)
    axes.set_xticks(places[shown], [fill(_label(values[k]), LINE) for k in shown])
    if max(len(_label(value)) for value in values) > SHORT:
        for text in axes.get_xticklabels():
            text.set(rotation=40, rotation_mode="anchor", horizontalalignment="right")
    return reach


def _places(values: Sequence[Any]) -> FloatArray:
    """Positions of values: names evenly spaced, numbers at their value or its logarithm.

    Logarithms are used if they are more evenly spaced; a zero is then one decade below the others.
    """
    if not is_number(values):
        return np.arange(len(values), dtype=np.float64)
    numbers = np.array(values, dtype=np.float64)
    some = numbers[numbers > 0]
    if (numbers < 0).any() or len(some) < 2 or some.max() < SPAN * some.min():
        return numbers
    logarithms = np.log10(np.where(numbers > 0, numbers, 0.1 * some.min()))
    even, uneven = np.diff(logarithms), np.diff(numbers)
    return logarithms if even.min() / even.max() >= uneven.min() / uneven.max() else numbers


def _matrix(sweep: Sweep, runs: DataFrame, values: Values) -> Figure | None:
    """Error of the worst parameter over the two factors with the most combinations of values."""
    if len(values) < 2:
        return None
    up, across = max(combinations(values, 2), key=lambda pair: runs[[*pair]].value_counts().size)
    if len(values[across]) < len(values[up]) or not is_number(values[across]):
        up, across = across, up
    # A panel for each value of a third factor with few values, names before numbers.
    few = [one for one in values if one not in (up, across) and len(values[one]) <= MOST_PANELS]
    part = min(few, key=lambda name: is_number(values[name]), default="")
    parts = values.get(part, [None])
    pair, maps = [up, across], []
    for value in parts:
        group = runs[runs[part] == value] if part else runs
        each = good_of(group).groupby([*pair, "parameter"])["signed error"]
        worst = each.agg(lambda error: np.sqrt((error**2).mean())).groupby(level=pair).max()
        both = (one.unstack().reindex(index=values[up], columns=values[across])
                for one in (worst, group.groupby(pair).size()))  # fmt: skip
        maps.append([one.to_numpy(dtype=np.float64) for one in both])
    known = np.concatenate([errors[np.isfinite(errors)] for errors, _ in maps])
    low, high = max(float(known.min()), 1e-9), max(float(known.max()), 2e-9)
    norm = LogNorm(low, high) if high > SPAN * low else Normalize(0.0, high)
    beside = len(values[across]) * len(parts) <= MOST_CELLS
    shape = (1, len(parts)) if beside else (len(parts), 1)
    figure, grid = panels(*shape, shape[0] * (0.27 * len(values[up]) + 1.1) + 0.9)
    for axes, value, (errors, count) in zip(grid.flat, parts, maps, strict=True):
        axes.grid(visible=False)
        colours = axes.pcolormesh(errors, norm=norm, cmap=SEQUENTIAL, edgecolor="white", lw=0.5)
        for row, column in np.argwhere(count > 0):
            error = errors[row, column]
            text, ink = "×", BAD
            if np.isfinite(error):
                light = sum(colormaps[SEQUENTIAL](norm(error))[:3]) > 1.4
                text, ink = plain_number(error), "black" if light else "white"
            axes.text(column + 0.5, row + 0.5, text, color=ink, fontsize=SMALL - 2.5,
                      ha="center", va="center")  # fmt: skip
        axes.set_xticks(np.arange(len(values[across])) + 0.5, map(_label, values[across]))
        axes.set_yticks(np.arange(len(values[up])) + 0.5, map(_label, values[up]))
        axes.set_xlabel(_heading(sweep, across))
        axes.set_ylabel(_heading(sweep, up))
        axes.set_title(f"{part}: {_label(value)}" if part else "", fontsize=TEXT)
    bar = figure.colorbar(colours, ax=grid, fraction=0.03, pad=0.02)
    log_axis(bar.ax.yaxis)
    bar.ax.tick_params(labelsize=SMALL)
    others = [name for name in values if name not in (up, across, part)]
    pooled = f", over all values of {', '.join(others)}" if others else ""
    note = f"Root mean square error [%] of the worst parameter{pooled}. ×: all runs failed."
    return _titled(figure, sweep, note)


def _heading(sweep: Sweep, column: str) -> str:
    unit = dict(factors_of(sweep).values())[column]
    return f"{column} [{unit}]" if unit else column


def _label(value: Any) -> str:
    return plain_number(float(value)) if is_number([value]) else str(value)


def _titled(figure: Figure, sweep: Sweep, note: str) -> Figure:
    simulated = {run.simulated for record in sweep.records for run in record.estimates} == {True}
    title = sweep.title.removesuffix(" (simulated)") + (" (simulated)" if simulated else "")
    headline(figure, title, note)
    return figure
