"""Plots of one case: intervals, iterations, innovation, distances and what would narrow them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.special import ndtri

from mvest.errors import InputError
from mvest.reporting.case.fields import CaseFields
from mvest.reporting.case.findings import CaseFindings, FrameDistances, Narrower, UnknownRow
from mvest.reporting.case.information import columns_of
from mvest.reporting.figures import COLOURS, MARKERS

__all__ = [
    "distances_figure",
    "estimates_figure",
    "innovation_figure",
    "iterations_figure",
    "narrow_figure",
]

PRIOR, POSTERIOR, WITHOUT = "0.75", COLOURS[0], COLOURS[1]
TWO_SIDED = 1.96
"""Standard deviations within which 95 % of a normal distribution lie."""
WIDE_RATIO = 30.0
"""Of the largest objective to the smallest, beyond which its axis is logarithmic."""


def estimates_figure(case: CaseFindings) -> Figure:
    """Every parameter with its 95 % intervals: beforehand, from the images, and the truth if known.

    Moduli are in their units, nuisances in standard deviations from what was believed beforehand.
    """
    parameters = [p for p in case.unknowns if p.treatment != "fixed"]
    moduli = [p for p in parameters if p.is_modulus]
    nuisances = [p for p in parameters if not p.is_modulus]
    groups = [group for group in (moduli, nuisances) if group]
    if not groups:
        raise InputError("a case without free parameters has no intervals to draw")
    alone = case.without_nuisances
    without = {} if alone is None else {p.name: p for p in alone.parameters}
    rows = [len(group) + 0.6 for group in groups]
    figure = Figure(figsize=(8.2, 1.5 + 0.62 * sum(rows)), layout="constrained")
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=rows)[:, 0]
    for axes, group in zip(panels, groups, strict=True):
        in_sd = group is nuisances
        for row, parameter in enumerate(group):
            _intervals(axes, row, parameter, without.get(parameter.name), in_sd)
        axes.set_yticks(range(len(group)), [p.label for p in group])
        axes.set_ylim(len(group) - 0.45, -0.55)
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="x", alpha=0.3)
        if in_sd:
            axes.axvline(0.0, color="0.6", linewidth=0.8)
            axes.set_xlabel("nuisances: standard deviations from what was believed beforehand")
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


def _intervals(
    axes: Any, row: int, parameter: UnknownRow, without: UnknownRow | None, in_sd: bool
) -> None:
    mean, std = parameter.prior_mean, parameter.prior_std
    shift, scale = (mean, std or 1.0) if in_sd else (0.0, 1.0)

    def place(*values: Any) -> Any:
        return (np.array(values, dtype=float) - shift) / scale

    ends = place(mean - TWO_SIDED * std, mean + TWO_SIDED * std)
    axes.plot(ends, [row, row], color=PRIOR, linewidth=11, solid_capstyle="butt",
              label="believed beforehand (prior), 95 %")  # fmt: skip
    shown: tuple[tuple[UnknownRow | None, str, float, str, str], ...] = (
        (parameter, POSTERIOR, -0.09, "o", "estimate with its 95 % interval"),
        (without, WITHOUT, 0.17, "s", "estimate if the nuisances were taken as known"),
    )
    for source, colour, offset, marker, label in shown:
        # What is only considered stays as it was believed to be.
        if source is None or source.estimate is None or source.treatment == "considered":
            continue
        if source.low is not None and source.high is not None:
            axes.plot(place(source.low, source.high), [row + offset] * 2, color=colour,
                      linewidth=2.2, solid_capstyle="butt")  # fmt: skip
        axes.plot(place(source.estimate), [row + offset], marker, color=colour, markersize=6,
                  label=label)  # fmt: skip
    if parameter.truth is not None:
        axes.plot(place(parameter.truth), [row], "x", color="black", markersize=9,
                  markeredgewidth=2, label="truth of the simulation", zorder=5)  # fmt: skip


def iterations_figure(case: CaseFindings) -> Figure:
    """Moduli with ± 2 SD, nuisances, and the objective over the iterations."""
    if not case.iterates:
        raise InputError("the run kept no iterates")
    iterates, std = np.array(case.iterates), np.array(case.iterate_std)
    columns = columns_of(case.unknowns, iterates.shape[1])
    if not columns:
        raise InputError(f"iterates of {iterates.shape[1]} values fit no choice of the parameters")
    moduli = [k for k, p in enumerate(columns) if p.is_modulus]
    nuisances = [k for k, p in enumerate(columns) if not p.is_modulus]
    objective = np.array(case.objective, dtype=float)
    count = bool(moduli) + bool(nuisances) + bool(objective.size)
    figure = Figure(figsize=(max(3.6 * count, 4.6), 3.5), layout="constrained")
    panels = iter(figure.subplots(1, count, squeeze=False)[0])
    rounds = np.arange(len(iterates))
    if moduli:
        axes = next(panels)
        for at, k in enumerate(moduli):
            colour, m = COLOURS[at % len(COLOURS)], iterates[:, k]
            low, high = m - 2 * std[:, k], m + 2 * std[:, k]
            axes.fill_between(rounds, low, high, color=colour, alpha=0.15, linewidth=0)
            axes.plot(rounds, m, color=colour, marker=MARKERS[at % len(MARKERS)], markersize=4,
                      label=columns[k].label)  # fmt: skip
            truth = columns[k].truth
            if truth is not None:
                axes.axhline(truth, color=colour, linestyle="--", linewidth=1)
        units = dict.fromkeys(columns[k].unit for k in moduli)
        axes.set_ylabel(f"modulus [{', '.join(units)}]")
        axes.set_ylim(bottom=0.0)
        axes.set_title("moduli (band: ± 2 SD; dashed: truth)", fontsize=9)
    if nuisances:
        axes = next(panels)
        for at, k in enumerate(nuisances):
            mean, width = columns[k].prior_mean, columns[k].prior_std or 1.0
            axes.plot(rounds, (iterates[:, k] - mean) / width, color=COLOURS[at % len(COLOURS)],
                      marker=MARKERS[at % len(MARKERS)], markersize=4,
                      linestyle="-" if at < len(COLOURS) else ":",
                      label=columns[k].label)  # fmt: skip
        # Room for the names of all beside the lines.
        axes.set_xlim(right=max(len(rounds) - 1, 1) * (1.9 if len(nuisances) > 4 else 1.05))
        axes.axhline(0.0, color="0.6", linewidth=0.8)
        axes.set_ylabel("SD from the prior mean")
        axes.set_title("nuisances", fontsize=9)
    if objective.size:
        axes = next(panels)
        axes.plot(objective, "o-", color="black", markersize=4)
        if 0 < WIDE_RATIO * np.nanmin(objective) < np.nanmax(objective):
            axes.set_yscale("log")
        axes.set_ylabel("objective")
        axes.set_title("misfit plus departure from the prior", fontsize=9)
    for axes in figure.axes:
        axes.set_xlabel("iteration")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=6.5, loc="best")
    return figure


def innovation_figure(fields: CaseFields) -> Figure:
    """Histogram and quantiles of the standardised innovation against the normal distribution."""
    if fields.innovation is None or not np.isfinite(fields.innovation).any():
        raise InputError("a histogram of the innovation needs the innovation")
    values = np.sort(fields.innovation[np.isfinite(fields.innovation)])
    reach = min(max(4.0, float(np.abs(values).max())), 8.0)
    figure = Figure(figsize=(8.2, 3.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    bins = np.linspace(-reach, reach, 41)
    left.hist(np.clip(values, -reach, reach), bins=bins, density=True, color=COLOURS[4],
              label="innovation")  # fmt: skip
    x = np.linspace(-reach, reach, 201)
    left.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="black", label="N(0, 1)")
    left.set_xlabel("innovation over its predicted SD")
    left.set_ylabel("share per SD")
    left.legend(frameon=False, fontsize=8)
    expected = ndtri((np.arange(len(values)) + 0.5) / len(values))
    step = max(len(values) // 2000, 1)
    right.plot(expected[::step], values[::step], ".", color=COLOURS[0], markersize=3)
    right.axline((0, 0), slope=1, color="black", linewidth=1)
    right.set_xlabel("quantile of N(0, 1)")
    right.set_ylabel("quantile of the innovation")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
    return figure


def distances_figure(distances: Sequence[FrameDistances]) -> Figure:
    """Mean distance from the observed valve, frame by frame, of each model; bars end at + 1 SD."""
    if not distances:
        raise InputError("no frame has a distance to draw")
    models = (
        ("generic", [d.generic for d in distances], "0.55"),
        ("generic, moved rigidly", [d.registered for d in distances], COLOURS[4]),
        ("personalised", [d.personalised for d in distances], COLOURS[0]),
    )
    figure = Figure(figsize=(max(1.9 * len(distances) + 3.4, 5.8), 3.4), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(models)
    for k, (label, spreads, colour) in enumerate(models):
        x = np.arange(len(distances)) + (k - (len(models) - 1) / 2) * width
        mean = np.array([spread.mean for spread in spreads])
        std = np.array([spread.std for spread in spreads])
        axes.bar(x, mean, 0.92 * width, color=colour, label=label)
        axes.errorbar(x, mean, yerr=[np.zeros_like(std), std], fmt="none", ecolor="0.2",
                      elinewidth=1, capsize=2)  # fmt: skip
        for place, value, top in zip(x, mean, mean + std, strict=True):
            axes.annotate(f"{value:.2f}", (place, top), xytext=(0, 2), textcoords="offset points",
                          ha="center", fontsize=7.5)  # fmt: skip
    labels = [f"{d.frame}\n({'shown to the filter' if d.seen else 'held out'})" for d in distances]
    axes.set_xticks(range(len(distances)), labels)
    axes.set_ylabel("distance [mm], mean + SD")
    axes.margins(y=0.14)
    axes.set_ylim(bottom=0.0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return figure


def narrow_figure(narrow: Sequence[Narrower]) -> Figure:
    """By how much the standard deviation of a modulus would fall if more were measured."""
    if not narrow:
        raise InputError("the run did not ask what else would narrow the intervals")
    rows = sorted(narrow, key=lambda r: r.std_if_known / r.std_now, reverse=True)
    share = [100 * r.std_if_known / r.std_now for r in rows]
    figure = Figure(figsize=(7.6, 1.1 + 0.42 * len(rows)), layout="constrained")
    axes = figure.subplots()
    axes.barh(range(len(rows)), share, color=COLOURS[0], height=0.62)
    for row, value in enumerate(share):
        axes.annotate(f"{value:.0f} %", (value, row), xytext=(3, 0), textcoords="offset points",
                      va="center", fontsize=8)  # fmt: skip
    axes.axvline(100.0, color="0.4", linewidth=1, linestyle="--")
    axes.set_yticks(range(len(rows)), [r.what for r in rows])
    axes.set_xlim(0.0, max(112.0, *(1.08 * v for v in share)))
    axes.set_xlabel("width of the interval if this were measured, % of its width now")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    return figure
