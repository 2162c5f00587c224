"""Figures of sweeps over settings (covariances, discrepancies, filters) and of any sweep's cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm

from experiments.sweeps.collected import Sweep
from experiments.sweeps.families import (
    Line,
    covariance_lines,
    discrepancies,
    filter_conditions,
    is_own_model,
)
from experiments.sweeps.rows import (
    Run,
    cost_rows,
    factor_label,
    factor_names,
    factor_text,
    runs_of,
    short_names,
)
from experiments.sweeps.statistics import accuracy, converged, coverage, spread_of
from mvest.reporting.markup import number
from mvest.reporting.style import (
    BAD,
    COLOURS,
    GREY,
    MARKERS,
    SMALL,
    TEXT,
    WIDTH,
    headline,
    log_axis,
    panels,
    plain_axes,
    plain_number,
)
from mvest.typing import FloatArray

__all__ = ["cost_figure", "covariance_figure", "discrepancy_figure", "filter_figure"]

Z95 = float(norm.ppf(0.975))
SMALLEST_PERCENT = 1e-5
"""Errors below this are drawn at it, on a logarithmic axis."""


def covariance_figure(sweep: Sweep) -> Figure | None:
    """Error and reported standard deviation along each covariance, a row per filter mode."""
    runs = runs_of(sweep)
    lines = covariance_lines(runs)
    modes = list(dict.fromkeys(line.mode for line in lines))
    quantities = list(dict.fromkeys(line.quantity for line in lines))
    if not lines or not any(np.isfinite(run.error).any() for run in runs if run.converged):
        return None
    figure, axes = panels(len(modes), len(quantities), 2.5 * len(modes) + 0.7, sharey=True)
    for row, mode in enumerate(modes):
        for column, quantity in enumerate(quantities):
            one = axes[row, column]
            chosen = [line for line in lines if (line.mode, line.quantity) == (mode, quantity)]
            values = sorted({v for o in lines if o.quantity == quantity for v, _ in o.points})
            if all(len(line.points) < 2 for line in chosen):
                _say(one, "not varied")
            else:
                for line in chosen:
                    _along(one, line, values)
            one.set_yscale("log")
            log_axis(one.yaxis)
            one.set_xlim(-0.4, len(values) - 0.6)
            one.set_xticks(range(len(values)), [plain_number(value) for value in values])
            if row == 0:
                one.set_title("all three" if quantity == "all" else quantity, fontsize=TEXT)
            if row == len(modes) - 1:
                one.set_xlabel("scale" if "varied" in runs[0].factors else f"{quantity}")
            if column == 0:
                one.set_ylabel(f"{mode} mode\n[% of truth]")
    headline(
        figure,
        "How much do the filter's covariances matter?",
        "Blue: largest error of a modulus. Orange, dashed: largest standard deviation that the "
        "filter reports.\nOne line for each setting of the others. Crosses: failed runs.",
    )
    return figure


def _say(axes: Any, words: str) -> None:
    """Why a panel is empty."""
    axes.annotate(
        words, (0.5, 0.5), xycoords="axes fraction", ha="center", va="center", color=GREY,
        fontsize=SMALL,
    )  # fmt: skip


def _along(axes: Any, line: Line, values: Sequence[float]) -> None:
    """One line at evenly spaced places, since a covariance may be zero."""
    found = []
    for value, group in line.points:
        place = values.index(value)
        good = converged(group)
        if len(good) < len(group):
            axes.plot(place, 0.03, "x", color="black", markersize=7, mew=2, clip_on=False,
                      transform=axes.get_xaxis_transform(), zorder=6)  # fmt: skip
        if good:
            parameters = range(len(good[0].truth))
            error = max(accuracy(group, k).rmse_percent for k in parameters)
            std = max(100.0 * accuracy(group, k).reported / good[0].truth[k] for k in parameters)
            found.append((place, max(error, SMALLEST_PERCENT), std))
    if found:
        place, error, std = np.array(found).T
        axes.plot(place, std, color=COLOURS[1], marker="s", markersize=4, mfc="white", lw=1.2,
                  linestyle=(0, (4, 2)), alpha=0.8)  # fmt: skip
        axes.plot(place, error, color=COLOURS[0], marker="o", markersize=4, lw=1.5, alpha=0.8)


def discrepancy_figure(sweep: Sweep) -> Figure | None:
    """Signed error of each modulus per discrepancy, sorted by size, with the 95 % interval."""
    runs = runs_of(sweep)
    groups = discrepancies(runs)
    p = len(sweep.parameters)
    size = {
        what: max((abs(accuracy(g, k).bias_percent) for k in range(p)), default=np.nan)
        for what, g in groups.items()
    }
    if not any(np.isfinite(value) for value in size.values()):
        return None
    # Smallest first from the bottom; what failed stands below everything.
    order = sorted(groups, key=lambda what: (np.isfinite(size[what]), np.nan_to_num(size[what])))
    names = short_names(sweep.parameters)
    figure, axes = panels(1, p, 0.36 * len(order) + 1.5, sharey=True, sharex=True)
    for k, one in enumerate(axes.flat):
        one.axvline(0, color="black", linewidth=1)
        for y, what in enumerate(order):
            _discrepancy_bar(one, y, groups[what], k)
        one.set_title(f"{names[k]} modulus", fontsize=TEXT)
        one.set_xlabel("signed error [% of truth]")
        one.margins(x=0.2)
        one.grid(axis="y", visible=False)
    axes[0, 0].set_yticks(range(len(order)), order)
    axes[0, 0].set_ylim(-0.6, len(order) - 0.4)
    real = [what for what in order if not is_own_model(groups[what]) and np.isfinite(size[what])]
    headline(
        figure,
        f"The largest error comes from “{real[-1]}”" if real else "Errors by discrepancy",
        "Bars: error of the estimate when the truth has what the model has not. "
        "Black lines: the filter's own 95 % interval.",
    )
    return figure


def _discrepancy_bar(axes: Any, y: int, runs: Sequence[Run], k: int) -> None:
    found = accuracy(runs, k)
    if not found.n:
        axes.annotate(
            "failed", (0, y), xytext=(5, 0), textcoords="offset points", va="center",
            fontsize=SMALL, color=BAD,
        )  # fmt: skip
        return
    error = found.bias_percent
    truth = float(np.mean([run.truth[k] for run in converged(runs)]))
    half = 100.0 * Z95 * found.reported / truth
    axes.barh(y, error, height=0.62, color=COLOURS[k], alpha=0.85)
    axes.plot([error - half, error + half], [y, y], color="black", linewidth=2)
    side = 1 if error >= 0 else -1
    edge = error + side * half
    axes.annotate(
        f"{error:+.1f}" if abs(error) >= 0.05 else f"{error:+.1g}", (edge, y), xytext=(4 * side, 0),
        textcoords="offset points", va="center", ha="left" if side > 0 else "right", fontsize=SMALL,
    )  # fmt: skip


def filter_figure(sweep: Sweep) -> Figure | None:
    """Error, coverage where there are repetitions, and forward solves; a row per condition."""
    runs = runs_of(sweep)
    conditions = filter_conditions(runs)
    if not any(np.isfinite(run.error).any() for run in runs if run.converged):
        return None
    repeated = any(len(g) > 1 for filters in conditions.values() for g in filters.values())
    names = short_names(sweep.parameters)
    rows = [len(filters) for filters in conditions.values()]
    figure = Figure(
        figsize=(WIDTH, 0.36 * sum(rows) + 0.75 * len(rows) + 0.8), layout="constrained"
    )
    axes = figure.subplots(
        len(rows), 3 if repeated else 2, squeeze=False, sharex="col", height_ratios=rows
    )
    for one in axes.flat:
        plain_axes(one)
    for row, (condition, filters) in enumerate(conditions.items()):
        _condition(axes[row], condition, filters, len(names), last=row == len(rows) - 1)
    words = [f"{COLOUR_WORDS[k % len(COLOURS)]}: {name}" for k, name in enumerate(names)]
    headline(
        figure,
        "Which filter finds the moduli, and at what cost?",
        ". ".join(words)
        + (". Small dots: seeds; large symbols: their root mean square." if repeated else "."),
    )
    return figure


def _condition(
    axes: Any, condition: str, filters: Mapping[str, list[Run]], parameters: int, *, last: bool
) -> None:
    """One row of panels: the filters under one condition."""
    errors, solves = axes[0], axes[-1]
    covered = axes[1] if len(axes) == 3 else None
    order = list(filters)[::-1]
    for y, name in enumerate(order):
        _filter_row(errors, covered, solves, y, filters[name], parameters)
    errors.set_xscale("log")
    log_axis(errors.xaxis)
    errors.set_title(condition, fontsize=TEXT, loc="left")
    for one in axes:
        one.set_yticks(range(len(order)), order if one is errors else [""] * len(order))
        one.set_ylim(-0.6, len(order) - 0.4)
    solves.margins(x=0.15)
    if covered is not None:
        covered.set_xlim(0, 103)
        if any(len(runs) > 1 for runs in filters.values()):
            covered.axvline(95, color="black", linestyle="--", linewidth=1)
        else:
            _say(covered, "single runs")
    if last:
        errors.set_xlabel("error [% of truth]")
        solves.set_xlabel("forward solves per run")
        if covered is not None:
            covered.set_xlabel("95 % interval covers [% of runs]")


COLOUR_WORDS = (
    "Blue circles",
    "Orange squares",
    "Green triangles",
    "Pink diamonds",
    "Light blue",
    "Yellow",
)
"""How `COLOURS` and `MARKERS` look."""


def _filter_row(
    errors: Any, covered: Any, solves: Any, y: int, runs: Sequence[Run], parameters: int
) -> None:
    good = converged(runs)
    if not good:
        errors.annotate(
            "failed", (0.03, y), xycoords=("axes fraction", "data"), va="center", color=BAD,
            fontsize=SMALL,
        )  # fmt: skip
        return
    for k in range(parameters):
        at = y + 0.13 * (1 - 2 * k / max(parameters - 1, 1))
        found, share = accuracy(runs, k), coverage(runs, k)
        single = np.maximum(np.abs([run.error[k] for run in good]), SMALLEST_PERCENT)
        if len(good) > 1:
            errors.plot(single, np.full(len(single), at), ".", color=GREY, markersize=4, alpha=0.6)
        style = {"color": COLOURS[k], "marker": MARKERS[k], "markersize": 7}
        errors.plot(max(found.rmse_percent, SMALLEST_PERCENT), at, **style)
        if covered is not None and share.n > 1:
            covered.plot([100 * share.low, 100 * share.high], [at, at], color=COLOURS[k], lw=1.5)
            covered.plot(100 * share.share, at, **style)
    mean = spread_of([run.forward_solves for run in good])["mean"]
    if np.isfinite(mean):
        solves.barh(y, mean, height=0.5, color=COLOURS[2], alpha=0.85)
        solves.annotate(
            f"{mean:.3g}", (mean, y), xytext=(4, 0), textcoords="offset points", va="center",
            fontsize=SMALL,
        )  # fmt: skip


def cost_figure(sweep: Sweep) -> Figure | None:
    """Forward solves per run and seconds per job, by the first factor with few values."""
    rows = cost_rows(sweep)
    name = _splitting_factor(sweep)
    label = None if name is None else factor_label(name)
    groups: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        groups.setdefault("all" if label is None else factor_text(row[label]), []).append(k)
    timed = [row for row in rows if row["whole job [s]"] is not None]
    if not timed:
        return None
    figure, axes = panels(1, 2, 0.3 * len(groups) + 1.5, sharey=True)
    order = list(groups)[::-1]
    for y, group in enumerate(order):
        jobs = [rows[k] for k in groups[group]]
        solves = [
            run.forward_solves
            for k in groups[group]
            for run in sweep.jobs[k].runs
            if run.forward_solves
        ]
        seconds = [row["whole job [s]"] for row in jobs if row["whole job [s]"] is not None]
        for one, values, colour in ((axes[0, 0], solves, 0), (axes[0, 1], seconds, 2)):
            _strip(one, y, np.array(values, dtype=np.float64), COLOURS[colour])
    axes[0, 0].set_yticks(range(len(order)), order)
    axes[0, 0].set_ylim(-0.6, len(order) - 0.4)
    axes[0, 0].set_xlabel("forward solves per run")
    axes[0, 1].set_xlabel("seconds per job (all its seeds)")
    for one in axes.flat:
        one.set_xlim(left=0)
        one.margins(x=0.15)
    hours = sum(row["whole job [s]"] for row in timed) / 3600
    total = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.1f} minutes"
    headline(
        figure,
        f"What the sweep costs: {len(timed)} jobs, {total} of computing",
        "Bars and numbers: medians. Dots: single runs or jobs."
        + (f" By {name.replace('_', ' ')}." if name else ""),
    )
    return figure


def _splitting_factor(sweep: Sweep) -> str | None:
    """The filter if it is varied, else the first factor with two to twelve values."""
    names = factor_names(sweep)
    for name in [*(n for n in names if n == "filter"), *names]:
        values = {factor_text(job.factors.get(name)) for job in sweep.jobs}
        if 2 <= len(values) <= 12:
            return name
    return None


def _strip(axes: Any, y: int, values: FloatArray, colour: str) -> None:
    if not len(values):
        axes.annotate(
            "no result", (0.03, y), xycoords=("axes fraction", "data"), va="center", color=BAD,
            fontsize=SMALL,
        )  # fmt: skip
        return
    middle = float(np.median(values))
    axes.barh(y, middle, height=0.62, color=colour, alpha=0.35)
    if len(values) > 1:
        height = y + np.linspace(-0.24, 0.24, len(values))
        axes.plot(values, height, ".", color=GREY, markersize=6, alpha=0.5, mew=0)
    axes.annotate(
        number(middle), (float(values.max()), y), xytext=(5, 0), textcoords="offset points",
        va="center", fontsize=SMALL,
    )  # fmt: skip
