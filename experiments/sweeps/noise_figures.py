"""Figures of a sweep over noise: error against its bound, and whether intervals can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.sweeps.collected import Sweep
from experiments.sweeps.families import NoiseGroup, noise_groups
from experiments.sweeps.rows import Run, runs_of, short_names
from experiments.sweeps.statistics import (
    BOUND_FACTOR,
    LEVELS,
    accuracy,
    converged,
    coverage,
)
from mvest.reporting.style import (
    BAD,
    COLOURS,
    GOOD,
    GREY,
    SMALL,
    TEXT,
    WIDTH,
    headline,
    label_ends,
    levels,
    panels,
    plain_axes,
)
from mvest.typing import FloatArray

__all__ = ["calibration_figure", "noise_figure"]

CURVES = ("bound", "RMS")
OTHERS = "other errors"


@dataclass(frozen=True, slots=True)
class Family:
    """Groups that share a panel: levels of one kind of noise, or kinds of a single level."""

    title: str
    groups: list[NoiseGroup]
    is_curve: bool

    def places(self) -> list[float]:
        """Where each group stands: at its level, or one beside the other."""
        return [g.level if self.is_curve else float(k) for k, g in enumerate(self.groups)]

    def name(self, group: NoiseGroup) -> str:
        """What tells a group apart within its panel."""
        return f"{group.level:g} mm" if self.is_curve else group.label


def _families(runs: Sequence[Run], *, noisy: bool = False) -> list[Family]:
    groups = [group for group in noise_groups(runs) if group.level or not noisy]
    by_kind: dict[str, list[NoiseGroup]] = {}
    for group in groups:
        by_kind.setdefault(group.kind, []).append(group)
    families = [Family(kind, found, True) for kind, found in by_kind.items() if len(found) > 1]
    single = [found[0] for found in by_kind.values() if len(found) == 1]
    return families + ([Family(OTHERS if families else "", single, False)] if single else [])


def noise_figure(sweep: Sweep) -> Figure | None:
    """Error against the noise level: a row per parameter, a column per kind of noise.

    Kinds with a single level stand side by side in one column, on a scale of their own: errors that
    the filter does not know of are larger by an order of magnitude.
    """
    runs = runs_of(sweep)
    if not any(np.isfinite(run.error).any() for run in runs if run.converged):
        return None
    families, names = _families(runs), short_names(sweep.parameters)
    figure, axes = _grid(families, names)
    top = np.zeros((len(names), len(families)))
    for column, family in enumerate(families):
        for k, name in enumerate(names):
            one = axes[k, column]
            top[k, column] = _errors(one, family, k)
            if column == 0:
                one.set_ylabel(f"error, {name} [% of truth]")
            if k == 0:
                one.set_title(_counted(family), fontsize=TEXT)
            if not family.is_curve:
                shown = k == len(names) - 1
                _name_places(one, [_wrapped(g.label) for g in family.groups], shown=shown)
            elif k == len(names) - 1:
                one.set_xlabel("noise per coordinate [mm]")
    for k in range(len(names)):
        for scale in (True, False):
            alike = [column for column, f in enumerate(families) if f.is_curve == scale]
            for column in alike:
                axes[k, column].set_ylim(0, 1.05 * top[k, alike].max() or 1.0)
                axes[k, column].tick_params(labelleft=column == alike[0])
        last = [line for line in axes[k, -1].lines if line.get_label() in CURVES]
        ends = [(line.get_ydata()[-1], line.get_label(), line.get_color()) for line in last]
        label_ends(axes[k, -1], float(axes[k, -1].get_xlim()[1]), ends, gap=0.08)
    headline(
        figure,
        "How large is the error of the moduli under noise?",
        "Dots: single seeds. Blue: root mean square. Dashed: Cramér–Rao bound; shaded: up to "
        f"{BOUND_FACTOR:g} × bound. Crosses: failed runs.",
    )
    return figure


def _grid(families: Sequence[Family], names: Sequence[str]) -> tuple[Figure, Any]:
    """Panels whose widths follow from what they hold."""
    figure = Figure(figsize=(WIDTH, 2.4 * len(names) + 0.9), layout="constrained")
    widths = [max(3.0, len(f.groups)) if f.is_curve else 1.1 * len(f.groups) for f in families]
    axes = figure.subplots(
        len(names), len(families), squeeze=False, sharex="col", width_ratios=widths
    )
    for one in axes.flat:
        plain_axes(one)
    return figure, axes


def _wrapped(text: str) -> str:
    return fill(text, 11)


def _name_places(axes: Any, labels: Sequence[str], *, shown: bool) -> None:
    axes.set_xlim(-0.5, len(labels) - 0.5)
    axes.set_xticks(range(len(labels)), labels if shown else [""] * len(labels))
    axes.tick_params(axis="x", labelsize=SMALL - 1)
    axes.grid(axis="x", visible=False)


def _counted(family: Family) -> str:
    runs = [run for group in family.groups for run in group.runs]
    failed = sum(not run.converged for run in runs)
    return f"{family.title}\n({failed} of {len(runs)} failed)" if failed else family.title


def _errors(axes: Any, family: Family, k: int) -> float:
    """Draw one panel; returns the largest error drawn."""
    places = family.places()
    step = float(np.median(np.diff(places))) if len(places) > 1 else 1.0
    largest = 0.0
    curve = []
    for place, group in zip(places, family.groups, strict=True):
        good = converged(group.runs)
        if len(good) < len(group.runs):
            size = 6 if good else 8
            axes.plot(place, 0.02, "x", color=BAD, markersize=size, mew=size / 4, clip_on=False,
                      transform=axes.get_xaxis_transform(), zorder=6)  # fmt: skip
        if not good:
            continue
        errors = np.abs([run.error[k] for run in good])
        # Side by side in a fixed order, so that equal results give equal pictures.
        shift = _beside(len(good), 0.14 * step)
        axes.plot(place + shift, errors, ".", color=GREY, markersize=5, alpha=0.5, mew=0)
        found = accuracy(group.runs, k)
        truth = float(np.mean([run.truth[k] for run in good]))
        curve.append((place, found.rmse_percent, 100.0 * found.bound / truth))
        largest = max(largest, float(errors.max()))
    if curve:
        _summary(axes, np.array(curve), joined=family.is_curve)
    return largest


def _summary(axes: Any, curve: FloatArray, *, joined: bool) -> None:
    """Root mean square and bound: curves over the level, or marks for each group."""
    place, rms, bound = curve.T
    shade = {"color": "black", "alpha": 0.09, "linewidth": 0}
    if joined:
        axes.fill_between(place, bound, BOUND_FACTOR * bound, **shade)
        axes.plot(place, bound, color="black", linestyle="--", linewidth=1.2, label=CURVES[0])
        axes.plot(place, rms, color=GOOD, marker="o", markersize=4.5, lw=1.8, label=CURVES[1])
        return
    axes.bar(place, (BOUND_FACTOR - 1) * bound, 0.8, bound, **shade)
    for at, height in zip(place, bound, strict=True):
        axes.plot([at - 0.4, at + 0.4], [height, height], color="black", linestyle="--", lw=1.2)
    axes.plot(place, rms, color=GOOD, marker="o", markersize=7, linestyle="none")


def _beside(n: int, width: float) -> FloatArray:
    """N places side by side within ± width; one alone stands in the middle."""
    return np.linspace(-width, width, n) if n > 1 else np.zeros(n)


def calibration_figure(sweep: Sweep) -> Figure | None:
    """Observed against nominal coverage, a row per parameter and a column per kind of noise."""
    parameters = range(len(sweep.parameters))
    families = [
        family
        for family in _families(runs_of(sweep), noisy=True)
        if any(coverage(group.runs, k).n for group in family.groups for k in parameters)
    ]
    if not families:
        return None
    names = short_names(sweep.parameters)
    strengths = sorted({g.level for family in families if family.is_curve for g in family.groups})
    by_level = dict(zip(strengths, levels(len(strengths)), strict=True))
    figure, axes = panels(
        len(names), len(families), 2.4 * len(names) + 0.7, sharex=True, sharey=True
    )
    for column, family in enumerate(families):
        colours = [
            by_level[group.level] if family.is_curve else COLOURS[k % len(COLOURS)]
            for k, group in enumerate(family.groups)
        ]
        for k, name in enumerate(names):
            one = axes[k, column]
            ends = _calibration(one, family, k, colours)
            if column == 0:
                one.set_ylabel(f"{name}\ncovers the truth [% of runs]")
            if k == 0:
                one.set_title(family.title, fontsize=TEXT)
            if k == len(names) - 1:
                one.set_xlabel("nominal interval [%]")
            one.set_xlim(-0.5, len(LEVELS) - 0.5)
            one.set_ylim(0, 104)
            one.set_xticks(range(len(LEVELS)), [f"{100 * level:.0f}" for level in LEVELS])
            one.grid(axis="x", visible=False)
            # Levels have the same colours in every panel, kinds only in their own.
            if column == len(families) - 1 or (not _same_colours(families) and k == 0):
                lines = max((text.count("\n") + 1 for _, text, _ in ends), default=1)
                label_ends(one, len(LEVELS) - 0.5, ends, gap=0.03 + 0.08 * lines)
    headline(
        figure,
        "Can the reported intervals be trusted?",
        "Dashes: what an interval promises. Points below: the filter is too sure. "
        "Bars: 95 % Monte-Carlo interval (Wilson).",
    )
    return figure


def _same_colours(families: Sequence[Family]) -> bool:
    return all(family.is_curve for family in families)


def _calibration(
    axes: Any, family: Family, k: int, colours: Sequence[Any]
) -> list[tuple[float, str, Any]]:
    place = np.arange(len(LEVELS))
    axes.hlines([100 * level for level in LEVELS], place - 0.42, place + 0.42, "black", lw=1.5)
    ends = []
    shifts = _beside(len(family.groups), 0.32)
    for group, colour, shift in zip(family.groups, colours, shifts, strict=True):
        found = [coverage(group.runs, k, level) for level in LEVELS]
        if not found[0].n:
            continue
        share = 100 * np.array([c.share for c in found])
        bars = np.abs(100 * np.array([[c.low for c in found], [c.high for c in found]]) - share)
        axes.errorbar(
            place + shift, share, yerr=bars, color=colour, marker="o", markersize=4.5,
            linestyle="none", elinewidth=1.3, capsize=0,
        )  # fmt: skip
        ends.append((float(share[-1]), fill(family.name(group), 22), colour))
    return ends
