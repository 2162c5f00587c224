"""Chordae by family: what of them is identified, as a table, in words and as a figure."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from experiments.common.records.record import Record
from experiments.common.records.report import parameter_label, percent
from experiments.studies.chord.findings import Findings, Fit
from mvest.reporting.figures import COLOURS, MARKERS

__all__ = ["chord_answer", "chord_figure", "chord_table", "chord_words"]

IDENTIFIED = 0.5
"""A parameter counts as identified whose standard deviation is below this share of its prior's."""


def _first(found: Findings) -> list[Fit]:
    """The two sets of frames with the first seed's noise."""
    return [fit for fit in found.results if fit.seed == 0]


def chord_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per estimate and parameter."""
    found = record.findings
    bounds = {bound.frames: bound.std for bound in found.bounds}
    return pd.DataFrame(
        [
            {
                "frames": fit.frames,
                "seed": fit.seed,
                "parameter": name,
                "truth": found.truth[k],
                "start": found.start[k],
                "prior_std": found.prior_std[k],
                "estimate": fit.estimate[k],
                "relative_error": fit.error[k],
                "relative_std": fit.std[k],
                "relative_bound": bounds[fit.frames][k],
                "identified": fit.std[k] < IDENTIFIED * found.prior_std[k],
                "status": fit.status,
            }
            for fit in found.results
            for k, name in enumerate(record.parameters)
        ]
    )


def _percent(value: float | None, form: str = ".1f") -> str:
    return percent(value, form, "unbounded")


def chord_words(record: Record[Findings]) -> str:
    """The table for readers, and what it says."""
    found = record.findings
    two, whole = _first(found)
    lines = [
        "| | truth | start | prior std | std, open and closed (bound without prior) | "
        "std, whole cycle (bound without prior) | error, whole cycle | identified by |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for k, name in enumerate(record.parameters):
        prior = found.prior_std[k]
        by = [fit.frames for fit in (two, whole) if fit.std[k] < IDENTIFIED * prior]
        cells = [
            parameter_label(name),
            f"{found.truth[k]:g}",
            f"{found.start[k]:g}",
            _percent(prior),
            *(
                f"{_percent(fit.std[k])} ({_percent(bound.std[k])})"
                for fit, bound in zip((two, whole), found.bounds, strict=True)
            ),
            _percent(whole.error[k], "+.1f"),
            "both" if len(by) == 2 else by[0] if by else "neither",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    cycles = [fit for fit in found.results if fit.frames == whole.frames]
    lines += [
        "",
        f"Identified: the data bring the standard deviation below {IDENTIFIED:g} of the prior's. "
        f"Relative standard deviations (of logarithms). {len(found.times)} frames of "
        f"{found.vertices} vertices, noise of {found.noise_mm:g} mm per coordinate, truth "
        "and estimate by the same model; everything is simulated.",
        "Normalised squared error of the whole vector (expected "
        f"{len(record.parameters)}): {two.nees:.1f} from open and closed frame; "
        + ", ".join(f"{fit.nees:.1f}" for fit in cycles)
        + f" from the whole cycle with {len(cycles)} seeds.",
        _pairs(record.parameters, whole),
    ]
    lines += [
        f"The estimate from the {fit.frames} (errors {fit.seed + 1}) ended: {fit.reason}."
        for fit in found.results
        if fit.status != "converged"
    ]
    return "\n".join(lines)


def chord_answer(record: Record[Findings]) -> str:
    """Which parameters the data determine, and which they do not."""
    found = record.findings
    whole = _first(found)[-1]
    known = [
        std < IDENTIFIED * prior for std, prior in zip(whole.std, found.prior_std, strict=True)
    ]
    rest = [
        parameter_label(name)
        for name, is_known in zip(record.parameters, known, strict=True)
        if not is_known
    ]
    besides = f", not {' and '.join(rest)}" if rest else ""
    return (
        f"A whole simulated cycle halves what is unknown of {sum(known)} of {len(known)} "
        f"parameters of leaflets and chordae{besides}."
    )


def _pairs(parameters: tuple[str, ...], fit: Fit) -> str:
    names = [parameter_label(name) for name in parameters]
    pairs = sorted(
        ((fit.correlation[i][j], names[j], names[i]) for i in range(len(names)) for j in range(i)),
        key=lambda pair: -abs(pair[0]),
    )[:3]
    words = "; ".join(f"{b} and {c} {a:+.2f}" for a, b, c in pairs)
    return f"Largest correlations after the whole cycle: {words}."


def chord_figure(record: Record[Findings]) -> Figure:
    """Standard deviations before and after the data, and the estimates against the truth."""
    found, names = record.findings, record.parameters
    y = np.arange(len(names))[::-1]
    figure = Figure(figsize=(13.0, 0.62 * len(names) + 1.9), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    left.plot(100 * np.array(found.prior_std), y, "|", color="0.4", ms=16, mew=2.5,
              label="before the data (prior)")  # fmt: skip
    for k, (fit, bound) in enumerate(zip(_first(found), found.bounds, strict=True)):
        shift = y + (0.14 if k == 0 else -0.14)
        left.plot(100 * np.array(fit.std), shift, MARKERS[k], color=COLOURS[k],
                  label=f"after {fit.frames}")  # fmt: skip
        limits = 100 * np.array(bound.std, dtype=float)
        left.plot(limits, shift, MARKERS[k], color=COLOURS[k], mfc="none", ms=10,
                  label=f"{fit.frames}, data alone (Cramér-Rao)")  # fmt: skip
        error, band = 100 * np.array(fit.error), 200 * np.array(fit.std)
        right.errorbar(error, shift, xerr=band, fmt=MARKERS[k], color=COLOURS[k], capsize=3,
                       label=fit.frames)  # fmt: skip
    offset = 100 * (np.array(found.start) / np.array(found.truth) - 1)
    right.plot(offset, y, "x", color="0.4", label="start (prior mean), right")
    left.set(xscale="log", xlabel="relative standard deviation (%)",
             yticks=y, yticklabels=[parameter_label(n) for n in names])  # fmt: skip
    left.xaxis.set_major_locator(LogLocator())
    left.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    left.xaxis.set_minor_formatter(NullFormatter())
    right.axvline(0, color="0.7", lw=1, zorder=0)
    right.set(xscale="symlog", xlabel="error of the estimate ± 2 standard deviations (%)")
    right.set_xticks([-100, -10, -1, 0, 1, 10, 100], ["-100", "-10", "-1", "0", "1", "10", "100"])
    for axes in (left, right):
        axes.grid(axis="x", color="0.9")
        axes.set_axisbelow(True)
    handles, labels = left.get_legend_handles_labels()
    start = right.get_legend_handles_labels()
    figure.legend([*handles, start[0][0]], [*labels, start[1][0]], loc="outside right upper",
                  fontsize=8, frameon=False)  # fmt: skip
    figure.suptitle("What is known of the chordae and leaflets before and after (simulated)")
    return figure
