"""Chordae by family: what of them is identified, as a table, in words and as a figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from mvest.reporting.figures import COLOURS, MARKERS, write_study

__all__ = ["chord_figure", "chord_text", "write_chord"]

Record = Mapping[str, Any]

IDENTIFIED = 0.5
"""A parameter counts as identified whose standard deviation is below this share of its prior's."""

WORDS = {
    "E_f": "modulus",
    "chord_stiffness": "stiffness",
    "chord_rest_length": "length",
}


def _label(name: str) -> str:
    kind, _, part = name.partition(".")
    word = WORDS.get(kind, kind)
    return f"{part} {word}" if kind == "E_f" else f"{part} chordal {word}".strip()


def _first(record: Record) -> list[Mapping[str, Any]]:
    """The two sets of frames with the first seed's noise."""
    return [entry for entry in record["results"] if entry["seed"] == 0]


def _table(record: Record) -> pd.DataFrame:
    bounds = {bound["frames"]: bound["std"] for bound in record["bounds"]}
    return pd.DataFrame(
        [
            {
                "frames": entry["frames"],
                "seed": entry["seed"],
                "parameter": name,
                "truth": record["truth"][k],
                "start": record["start"][k],
                "prior_std": record["prior_std"][k],
                "estimate": entry["estimate"][k],
                "relative_error": entry["error"][k],
                "relative_std": entry["std"][k],
                "relative_bound": bounds[entry["frames"]][k],
                "identified": entry["std"][k] < IDENTIFIED * record["prior_std"][k],
                "status": entry["status"],
            }
            for entry in record["results"]
            for k, name in enumerate(record["parameters"])
        ]
    )


def _percent(value: float | None, form: str = ".1f") -> str:
    return "unbounded" if value is None else f"{100 * value:{form}} %"


def _words(record: Record) -> str:
    two, whole = _first(record)
    bounds = record["bounds"]
    lines = [
        "| | truth | start | prior std | std, open and closed (bound without prior) | "
        "std, whole cycle (bound without prior) | error, whole cycle | identified by |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for k, name in enumerate(record["parameters"]):
        prior = record["prior_std"][k]
        by = [e["frames"] for e in (two, whole) if e["std"][k] < IDENTIFIED * prior]
        told = "both" if len(by) == 2 else by[0] if by else "neither"
        cells = [
            _label(name),
            f"{record['truth'][k]:g}",
            f"{record['start'][k]:g}",
            _percent(prior),
            *(
                f"{_percent(entry['std'][k])} ({_percent(bound['std'][k])})"
                for entry, bound in zip((two, whole), bounds, strict=True)
            ),
            _percent(whole["error"][k], "+.1f"),
            told,
        ]
        lines.append("| " + " | ".join(cells) + " |")
    cycles = [entry for entry in record["results"] if entry["frames"] == whole["frames"]]
    lines += [
        "",
        f"Identified: the data bring the standard deviation below {IDENTIFIED:g} of the prior's. "
        f"Relative standard deviations (of logarithms). {len(record['times'])} frames of "
        f"{record['vertices']} vertices, noise of {record['noise_mm']:g} mm per coordinate, truth "
        "and estimate by the same model; everything is simulated.",
        "Normalised squared error of the whole vector (expected "
        f"{len(record['parameters'])}): {two['nees']:.1f} from open and closed frame; "
        + ", ".join(f"{entry['nees']:.1f}" for entry in cycles)
        + f" from the whole cycle with {len(cycles)} seeds.",
        _pairs(record, whole),
    ]
    lines += [
        f"The estimate from the {entry['frames']} (errors {entry['seed'] + 1}) ended: "
        f"{entry['reason']}."
        for entry in record["results"]
        if entry["status"] != "converged"
    ]
    return "\n".join(lines)


def _pairs(record: Record, entry: Mapping[str, Any]) -> str:
    names = [_label(name) for name in record["parameters"]]
    found = sorted(
        (
            (entry["correlation"][i][j], names[j], names[i])
            for i in range(len(names))
            for j in range(i)
        ),
        key=lambda pair: -abs(pair[0]),
    )[:3]
    told = "; ".join(f"{b} and {c} {a:+.2f}" for a, b, c in found)
    return f"Largest correlations after the whole cycle: {told}."


def chord_text(record: Record) -> str:
    """The summary for the terminal."""
    return _words(record)


def chord_figure(record: Record) -> Figure:
    """Standard deviations before and after the data, and the estimates against the truth."""
    names = record["parameters"]
    y = np.arange(len(names))[::-1]
    figure = Figure(figsize=(13.0, 0.62 * len(names) + 1.9), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    left.plot(100 * np.array(record["prior_std"]), y, "|", color="0.4", ms=16, mew=2.5,
              label="before the data (prior)")  # fmt: skip
    for k, (entry, bound) in enumerate(zip(_first(record), record["bounds"], strict=True)):
        shift = y + (0.14 if k == 0 else -0.14)
        left.plot(100 * np.array(entry["std"]), shift, MARKERS[k], color=COLOURS[k],
                  label=f"after {entry['frames']}")  # fmt: skip
        limits = np.array([np.nan if v is None else 100 * v for v in bound["std"]])
        left.plot(limits, shift, MARKERS[k], color=COLOURS[k], mfc="none", ms=10,
                  label=f"{entry['frames']}, data alone (Cramér-Rao)")  # fmt: skip
        error, band = 100 * np.array(entry["error"]), 200 * np.array(entry["std"])
        right.errorbar(error, shift, xerr=band, fmt=MARKERS[k], color=COLOURS[k], capsize=3,
                       label=entry["frames"])  # fmt: skip
    offset = 100 * (np.array(record["start"]) / np.array(record["truth"]) - 1)
    right.plot(offset, y, "x", color="0.4", label="start (prior mean), right")
    left.set(xscale="log", xlabel="relative standard deviation (%)",
             yticks=y, yticklabels=[_label(n) for n in names])  # fmt: skip
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


def write_chord(folder: Path, record: Record) -> list[Path]:
    """Table, words and figure, named after the experiment."""
    return write_study(folder, record, _table(record), _words(record), chord_figure(record))
