"""Figures of sweeps over settings (covariances, discrepancies, filters) and of any sweep's cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm

from mvest.reporting.markup import number
from mvest.reporting.sweep_rows import (
    Run,
    Sweep,
    cost_rows,
    factor_label,
    factor_names,
    factor_text,
    runs_of,
    short_names,
)
from mvest.reporting.sweep_statistics import accuracy, converged, coverage, grouped, spread_of
from mvest.reporting.sweep_style import (
    BAD,
    COLOURS,
    GREY,
    MARKERS,
    SMALL,
    TEXT,
    headline,
    label_ends,
    log_axis,
    panels,
)
from mvest.typing import FloatArray

__all__ = ["cost_figure", "covariance_figure", "discrepancy_figure", "filter_figure"]

Z95 = float(norm.ppf(0.975))
SMALLEST_PERCENT = 1e-5
"""Errors below this are drawn at it, on a logarithmic axis."""


def covariance_figure(sweep: Sweep) -> Figure | None:
    """Error and reported standard deviation against the scale, a panel per varied covariance."""
    runs = runs_of(sweep)
    by_mode = grouped(runs, ["filter"])
    varied = list(dict.fromkeys(run.factors.get("varied") for run in runs))
    if not any(np.isfinite(run.error).any() for run in runs if run.converged):
        return None
    names = short_names(sweep["parameters"])
    figure, axes = panels(
        len(by_mode), len(varied), 2.5 * len(by_mode) + 0.7, sharex=True, sharey=True
    )
    for row, ((mode,), group) in enumerate(by_mode.items()):
        for column, what in enumerate(varied):
            one = axes[row, column]
            one.set(xscale="log", yscale="log")
            log_axis(one.xaxis)
            log_axis(one.yaxis)
            chosen = [run for run in group if run.factors.get("varied") == what]
            _scaled(one, chosen, len(names))
            if row == 0:
                one.set_title("all three" if what == "all" else factor_text(what), fontsize=TEXT)
            if row == len(by_mode) - 1:
                one.set_xlabel("scale")
            if column == 0:
                one.set_ylabel(f"{mode} mode\n[% of truth]")
    for row in range(len(by_mode)):
        one = axes[row, -1]
        label_ends(one, float(one.get_xlim()[1]), _ends(one, names), gap=0.09)
    headline(
        figure,
        "How much do the filter's covariances matter?",
        "Full lines: error of each modulus. Dashed lines: standard deviation that the filter "
        "reports. Crosses at the bottom: failed runs.",
    )
    return figure


def _scaled(axes: Any, runs: Sequence[Run], parameters: int) -> None:
    groups = sorted((float(s), group) for (s,), group in grouped(runs, ["scale"]).items())
    for k in range(parameters):
        found = [(s, accuracy(group, k), group) for s, group in groups if converged(group)]
        if not found:
            continue
        truth = np.array([np.mean([run.truth[k] for run in group]) for _, _, group in found])
        scale = np.array([s for s, _, _ in found])
        error = np.array([a.rmse_percent for _, a, _ in found])
        std = 100.0 * np.array([a.reported for _, a, _ in found]) / truth
        style = {"color": COLOURS[k], "marker": MARKERS[k], "markersize": 4}
        axes.plot(scale, np.maximum(error, SMALLEST_PERCENT), linewidth=1.6, **style)
        axes.plot(scale, std, linewidth=1.2, linestyle=(0, (4, 2)), mfc="white", **style)
    for s, group in groups:
        if len(converged(group)) < len(group):
            axes.plot(s, 0.03, "x", color=BAD, markersize=7, mew=2, clip_on=False,
                      transform=axes.get_xaxis_transform(), zorder=6)  # fmt: skip


def _ends(axes: Any, names: Sequence[str]) -> list[tuple[float, str, Any]]:
    """Last point and name of each curve; they come in pairs of error and standard deviation."""
    lines = [line for line in axes.lines if line.get_marker() in MARKERS]
    return [
        (
            float(line.get_ydata()[-1]),
            f"{names[MARKERS.index(line.get_marker())]}, {'SD' if position % 2 else 'error'}",
            line.get_color(),
        )
        for position, line in enumerate(lines)
    ]


def discrepancy_figure(sweep: Sweep) -> Figure | None:
    """Signed error of each modulus per discrepancy, sorted by size, with the 95 % interval."""
    runs = runs_of(sweep)
    groups = {factor_text(what): g for (what,), g in grouped(runs, ["discrepancy"]).items()}
    p = len(sweep["parameters"])
    size = {
        what: max((abs(accuracy(g, k).bias_percent) for k in range(p)), default=np.nan)
        for what, g in groups.items()
    }
    if not any(np.isfinite(value) for value in size.values()):
        return None
    # Smallest first from the bottom; what failed stands below everything.
    order = sorted(groups, key=lambda what: (np.isfinite(size[what]), np.nan_to_num(size[what])))
    names = short_names(sweep["parameters"])
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
    largest = max((what for what in order if what != "none"), key=order.index)
    found = np.isfinite(size[largest])
    headline(
        figure,
        f"The largest error comes from “{largest}”" if found else "Errors by discrepancy",
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
    """Error, coverage where there are repetitions, and forward solves of each filter."""
    runs = runs_of(sweep)
    groups = {factor_text(name): g for (name,), g in grouped(runs, ["filter"]).items()}
    if not any(np.isfinite(run.error).any() for run in runs if run.converged):
        return None
    repeated = any(len(group) > 1 for group in groups.values())
    names, order = short_names(sweep["parameters"]), list(groups)[::-1]
    figure, axes = panels(1, 3 if repeated else 2, 0.42 * len(order) + 1.7, sharey=True)
    errors, covered, solves = axes[0, 0], axes[0, 1] if repeated else None, axes[0, -1]
    for y, name in enumerate(order):
        _filter_row(errors, covered, solves, y, groups[name], len(names))
    errors.set_yticks(range(len(order)), order)
    errors.set_ylim(-0.6, len(order) - 0.4)
    errors.set_xlabel("error [% of truth]")
    errors.set(xscale="log")
    log_axis(errors.xaxis)
    errors.set_title("error", fontsize=TEXT)
    if covered is not None:
        covered.axvline(95, color="black", linestyle="--", linewidth=1)
        covered.set_xlim(0, 103)
        covered.set_xlabel("95 % interval covers [% of runs]")
        covered.set_title("coverage", fontsize=TEXT)
    solves.margins(x=0.15)
    solves.set_xlabel("forward solves per run")
    solves.set_title("cost", fontsize=TEXT)
    words = [f"{COLOUR_WORDS[k % len(COLOURS)]}: {name}" for k, name in enumerate(names)]
    headline(
        figure,
        "Which filter finds the moduli, and at what cost?",
        ". ".join(words)
        + (". Small dots: seeds; large symbols: their root mean square." if repeated else "."),
    )
    return figure


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
        if covered is not None and share.n:
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
            run["forward_solves"]
            for k in groups[group]
            for run in sweep["jobs"][k]["runs"]
            if run.get("forward_solves")
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
        values = {factor_text(job["factors"].get(name)) for job in sweep["jobs"]}
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
