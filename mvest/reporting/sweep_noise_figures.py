"""Figures of a sweep over noise: error against its bound, and whether intervals can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mvest.reporting.sweep_rows import Run, Sweep, factor_text, runs_of, short_names
from mvest.reporting.sweep_statistics import (
    BOUND_FACTOR,
    LEVELS,
    accuracy,
    converged,
    coverage,
    grouped,
)
from mvest.reporting.sweep_style import (
    BAD,
    GOOD,
    GREY,
    TEXT,
    headline,
    label_ends,
    levels,
    panels,
)
from mvest.typing import FloatArray

__all__ = ["calibration_figure", "noise_figure"]

CURVES = ("bound", "RMS")


def noise_figure(sweep: Sweep) -> Figure | None:
    """Error against the noise level: a row per parameter, a column per kind of noise."""
    by_kind = grouped(runs_of(sweep), ["kind"])
    if not any(np.isfinite(run.error).any() for run in runs_of(sweep) if run.converged):
        return None
    names = short_names(sweep["parameters"])
    figure, axes = panels(
        len(names), len(by_kind), 2.4 * len(names) + 0.7, sharex=True, sharey="row"
    )
    top = np.zeros(len(names))
    for column, ((kind,), group) in enumerate(by_kind.items()):
        for k, name in enumerate(names):
            one = axes[k, column]
            top[k] = max(top[k], _errors(one, group, k))
            if column == 0:
                one.set_ylabel(f"error, {name} [% of truth]")
            if k == 0:
                one.set_title(_counted(factor_text(kind), group), fontsize=TEXT)
            if k == len(names) - 1:
                one.set_xlabel("noise per coordinate [mm]")
    for k in range(len(names)):
        axes[k, 0].set_ylim(0, 1.05 * top[k] or 1.0)
        last = [line for line in axes[k, -1].lines if line.get_label() in CURVES]
        if last:
            ends = [(line.get_ydata()[-1], line.get_label(), line.get_color()) for line in last]
            label_ends(axes[k, -1], float(axes[k, -1].get_xlim()[1]), ends, gap=0.08)
    headline(
        figure,
        "How large is the error of the moduli under noise?",
        "Dots: single seeds. Blue: root mean square. Dashed: Cramér–Rao bound; shaded: up to "
        f"{BOUND_FACTOR:g} × bound. Crosses: failed runs.",
    )
    return figure


def _counted(title: str, runs: Sequence[Run]) -> str:
    failed = sum(not run.converged for run in runs)
    return f"{title}\n({failed} of {len(runs)} failed)" if failed else title


def _errors(axes: Any, runs: Sequence[Run], k: int) -> float:
    """Draw one panel; returns the largest error drawn."""
    found = sorted((float(level), group) for (level,), group in grouped(runs, ["noise_mm"]).items())
    largest = 0.0
    curve = []
    step = float(np.median(np.diff([level for level, _ in found]))) if len(found) > 1 else 1.0
    for level, group in found:
        good = converged(group)
        errors = np.abs([run.error[k] for run in good])
        # Side by side in a fixed order, so that equal results give equal pictures.
        shift = _beside(len(good), 0.14 * step)
        axes.plot(level + shift, errors, ".", color=GREY, markersize=5, alpha=0.5, mew=0)
        if not good:
            axes.plot(level, 0.02, "x", color=BAD, markersize=8, mew=2, clip_on=False,
                      transform=axes.get_xaxis_transform(), zorder=6)  # fmt: skip
            continue
        summary = accuracy(group, k)
        truth = float(np.mean([run.truth[k] for run in good]))
        curve.append((level, summary.rmse_percent, 100.0 * summary.bound / truth))
        largest = max(largest, float(errors.max()))
        if summary.failed:
            axes.plot(level, 0.02, "x", color=BAD, markersize=6, mew=1.4, clip_on=False,
                      transform=axes.get_xaxis_transform(), zorder=6)  # fmt: skip
    if curve:
        level, rms, bound = np.array(curve).T
        axes.fill_between(level, bound, BOUND_FACTOR * bound, color="black", alpha=0.09, lw=0)
        axes.plot(level, bound, color="black", linestyle="--", linewidth=1.2, label=CURVES[0])
        axes.plot(level, rms, color=GOOD, marker="o", markersize=4.5, lw=1.8, label=CURVES[1])
    return largest


def _beside(n: int, width: float) -> FloatArray:
    """N places side by side within ± width; one alone stands in the middle."""
    return np.linspace(-width, width, n) if n > 1 else np.zeros(n)


def calibration_figure(sweep: Sweep) -> Figure | None:
    """Observed against nominal coverage, a row per parameter and a column per kind of noise."""
    runs = [run for run in runs_of(sweep) if run.factors.get("noise_mm")]
    by_kind = {
        kind: group
        for (kind,), group in grouped(runs, ["kind"]).items()
        if any(coverage(group, k).n for k in range(len(sweep["parameters"])))
    }
    if not by_kind:
        return None
    names = short_names(sweep["parameters"])
    strengths = sorted({float(run.factors["noise_mm"]) for run in runs})
    colours = dict(zip(strengths, levels(len(strengths)), strict=True))
    figure, axes = panels(
        len(names), len(by_kind), 2.4 * len(names) + 0.7, sharex=True, sharey=True
    )
    for column, (kind, group) in enumerate(by_kind.items()):
        for k, name in enumerate(names):
            one = axes[k, column]
            ends = _calibration(one, group, k, colours)
            if column == 0:
                one.set_ylabel(f"{name}\ncovers the truth [% of runs]")
            if k == 0:
                one.set_title(factor_text(kind), fontsize=TEXT)
            if k == len(names) - 1:
                one.set_xlabel("nominal interval [%]")
            one.set_xlim(-0.5, len(LEVELS) - 0.5)
            one.set_ylim(0, 104)
            one.set_xticks(range(len(LEVELS)), [f"{100 * level:.0f}" for level in LEVELS])
            one.grid(axis="x", visible=False)
            if column == len(by_kind) - 1:
                label_ends(one, len(LEVELS) - 0.5, ends, gap=0.11)
    headline(
        figure,
        "Can the reported intervals be trusted?",
        "Dashes: what an interval promises. Points below: the filter is too sure. "
        "Colours: noise level. Bars: 95 % Monte-Carlo interval (Wilson).",
    )
    return figure


def _calibration(
    axes: Any, runs: Sequence[Run], k: int, colours: dict[float, Any]
) -> list[tuple[float, str, Any]]:
    place = np.arange(len(LEVELS))
    axes.hlines([100 * level for level in LEVELS], place - 0.42, place + 0.42, "black", lw=1.5)
    ends = []
    groups = {float(level): group for (level,), group in grouped(runs, ["noise_mm"]).items()}
    for position, level in enumerate(sorted(groups)):
        found = [coverage(groups[level], k, nominal_level) for nominal_level in LEVELS]
        if not found[0].n:
            continue
        share = 100 * np.array([c.share for c in found])
        bars = np.abs(100 * np.array([[c.low for c in found], [c.high for c in found]]) - share)
        shift = 0.64 * (position - 0.5 * (len(groups) - 1)) / max(len(groups) - 1, 1)
        axes.errorbar(
            place + shift, share, yerr=bars, color=colours[level], marker="o", markersize=4.5,
            linestyle="none", elinewidth=1.3, capsize=0,
        )  # fmt: skip
        ends.append((float(share[-1]), f"{level:g} mm", colours[level]))
    return ends
