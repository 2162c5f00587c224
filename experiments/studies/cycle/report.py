"""What the frames of a cycle tell, and a modulus that drifts: tables, words and the figure."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common.building.whole_cycle import Bound
from experiments.common.records.record import Record
from experiments.common.records.report import parameter_label, percent
from experiments.studies.cycle.findings import Along, Drift, Findings
from mvest.reporting.figures import COLOURS, MARKERS
from mvest.reporting.markup import number

__all__ = ["cycle_answer", "cycle_figure", "cycle_table", "cycle_words"]


def _rows(found: Findings) -> list[tuple[str, Bound]]:
    sets = [(f"{bound.count} frames", bound) for bound in found.sets]
    return sets + [(f"only {bound.frames}", bound) for bound in found.phases]


def cycle_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per set of frames and parameter."""
    return pd.DataFrame(
        [
            {"frames": label, "count": bound.count, "parameter": name,
             "relative_std": bound.std[k]}
            for label, bound in _rows(record.findings)
            for k, name in enumerate(record.parameters)
        ]
    )  # fmt: skip


def _unevenness(along: Along) -> str:
    if along.reason:
        return f"not followed: {along.reason}"
    return f"{max(along.rms_mm) / np.median(along.rms_mm):.1f}"


def cycle_answer(record: Record[Findings]) -> str:
    """What more frames than two are worth."""
    two, whole = record.findings.sets[0], record.findings.sets[-1]
    gains = [
        few / many
        for few, many in zip(two.std, whole.std, strict=True)
        if few is not None and many is not None
    ]
    return (
        f"{whole.count} frames of a simulated cycle determine parameters {min(gains):.2g} to "
        f"{max(gains):.2g} times as sharply as the open and the closed one (Cramér-Rao)."
    )


def cycle_words(record: Record[Findings]) -> str:
    """The tables for readers, and what they say."""
    found = record.findings
    names = [parameter_label(name) for name in record.parameters]
    lines = [
        f"| frames | {' | '.join(names)} |",
        "|---|" + "---|" * len(names),
    ]
    for label, bound in _rows(found):
        if label.startswith("only"):
            label = f"{label} ({bound.count})"
        else:
            label = f"{label} ({'open and closed' if bound.count == 2 else 'spread evenly'})"
        values = (percent(v, ".2f", "not determined") for v in bound.std)
        lines.append(f"| {label} | {' | '.join(values)} |")
    steps, drift = found.steps, found.drift
    lines += [
        "",
        f"Smallest possible standard deviation (Cramér-Rao) of each parameter, relative to it, "
        f"with {found.noise_mm:g} mm noise per coordinate on {found.vertices} vertices per "
        f"frame, no prior. Everything is simulated.",
        "",
        f"| time step | RMS change of all frames when it is halved | order | largest change over "
        f"the median one, along {len(steps.path) - 1} equal steps of the {names[0]} from "
        f"{steps.path[0][0]:.2f} to {steps.path[-1][0]:.2f} MPa |",
        "|---|---|---|---|",
    ]
    for k, dt in enumerate(steps.dt):
        change = number(steps.rms_mm[k]) + " mm" if k < len(steps.rms_mm) else ""
        order = number(steps.order[k]) if k < len(steps.order) else ""
        lines.append(f"| {1e3 * dt:g} ms | {change} | {order} | {_unevenness(steps.along[k])} |")
    lines += [
        "",
        "Where the last column is large, frames jump: a fast motion of a leaflet falls into a time "
        "step that leaps over it to one side or the other. A filter that linearises can then end "
        "anywhere between the jumps, or nowhere.",
    ]
    if isinstance(drift, str):
        lines.append(f"The drift over beats was not followed: {drift}")
        return "\n".join(lines)
    lines += [
        "",
        f"The {parameter_label(drift.parameters[0])} drifts over {len(drift.truth)} "
        f"simulated beats, seen in {len(drift.times)} frames each:",
        "",
        "| | RMS error of the logarithm | mean std | within 95 % band |",
        "|---|---|---|---|",
    ]
    for label, band in (("filter", drift.filter), ("smoother", drift.smoother)):
        lines += [
            f"| {label}, {parameter_label(name)} | {band.rms_error[k]:.4f} | "
            f"{band.mean_std[k]:.4f} | {100 * band.coverage[k]:.0f} % |"
            for k, name in enumerate(drift.parameters)
        ]
    return "\n".join(lines)


def cycle_figure(record: Record[Findings]) -> Figure:
    """The cycle and its frames, what they tell, and the drift."""
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2)
    _draw_cycle(axes[0, 0], record.findings)
    _draw_frames(axes[0, 1], record.findings, record.parameters)
    _draw_sets(axes[1, 0], record.findings.sets)
    _draw_drift(axes[1, 1], record.findings.drift)
    return figure


def _draw_cycle(axes: Axes, found: Findings) -> None:
    frames = found.frames
    axes.plot(found.curve.time, found.curve.pressure_mmHg, color="black", lw=1.2)
    times = [frame.time for frame in frames]
    axes.plot(times, [f.pressure_mmHg for f in frames], "o", color="black", ms=4)
    axes.set(xlabel="time (s)", ylabel="pressure (mmHg)")
    other = axes.twinx()
    other.plot(times, [f.displacement_mm for f in frames], color=COLOURS[4], marker="s", ms=3)
    other.set_ylabel("mean displacement (mm)", color=COLOURS[4])
    axes.set_title("a  one cycle; dots are the observed frames", loc="left", fontsize=10)


def _draw_frames(axes: Axes, found: Findings, names: tuple[str, ...]) -> None:
    for k, name in enumerate(names):
        shown = [(f.time, f.std_alone[k]) for f in found.frames]
        t, std = zip(*[(a, 100 * b) for a, b in shown if b is not None], strict=True)
        axes.plot(t, std, color=COLOURS[k], marker=MARKERS[k], ms=4, label=parameter_label(name))
    axes.set_yscale("log")
    axes.set_ylim(top=min(axes.get_ylim()[1], 300.0))
    axes.set(xlabel="time of the frame (s)", ylabel="std from this frame alone (%)")
    axes.set_title("b  each frame alone, other parameters known", loc="left", fontsize=10)
    axes.legend(fontsize=8, frameon=False)


def _draw_sets(axes: Axes, sets: tuple[Bound, ...]) -> None:
    counts = [bound.count for bound in sets]
    std = 100 * np.array([bound.std for bound in sets], dtype=float)
    for k in range(std.shape[1]):
        axes.plot(counts, std[:, k], color=COLOURS[k], marker=MARKERS[k], ms=4)
    axes.set(xlabel="number of frames", ylabel="smallest possible std (%)")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(counts, labels=[str(c) for c in counts])
    axes.minorticks_off()
    axes.set_title("c  all parameters unknown (2: open and closed)", loc="left", fontsize=10)


def _draw_drift(axes: Axes, drift: Drift | str) -> None:
    axes.set_title("d  a modulus that drifts from beat to beat", loc="left", fontsize=10)
    if isinstance(drift, str):
        axes.text(0.5, 0.5, "not followed", ha="center", transform=axes.transAxes)
        return
    beat = np.arange(1, len(drift.truth) + 1)
    for band, colour, label in (
        (drift.filter, COLOURS[5], "filter (beats so far)"),
        (drift.smoother, COLOURS[0], "smoother (all beats)"),
    ):
        mean, low, high = (np.array(rows)[:, 0] for rows in (band.mean, band.low, band.high))
        axes.fill_between(beat, low, high, color=colour, alpha=0.3, lw=0, label=f"{label}, 95 %")
        axes.plot(beat, mean, color=colour, lw=1.2)
    axes.plot(beat, np.array(drift.truth)[:, 0], "k.--", lw=1, label="truth (simulated)")
    axes.set(xlabel="beat", ylabel=f"{parameter_label(drift.parameters[0])} (MPa)")
    axes.legend(fontsize=8, frameon=False)
