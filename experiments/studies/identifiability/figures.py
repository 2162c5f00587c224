"""Figures of the study of designs: deviations, profiles, and the valley they follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from mvest.reporting.figures import COLOURS, MARKERS, save_figure
from mvest.typing import FloatArray

__all__ = [
    "designs_figure",
    "profiles_figure",
    "valley_figure",
    "write_identifiability_figures",
]

Record = Mapping[str, Any]

LABELS = {
    "chord_rest_length": "rest length of chordae",
    "pressure_scale": "pressure",
    "chord_stiffness": "stiffness of chordae",
}
MOST_PERCENT = 300.0
"""Deviations beyond this are drawn at the edge: nothing is known there."""


def write_identifiability_figures(folder: Path, record: Record) -> list[Path]:
    """``identifiability_designs``, ``_profiles`` and ``_valley`` as PNG and PDF."""
    if not record.get("designs"):
        return []
    written = save_figure(folder / "identifiability_designs", designs_figure(record), record)
    if record["profiles"]:
        written += save_figure(folder / "identifiability_profiles", profiles_figure(record), record)
        written += save_figure(folder / "identifiability_valley", valley_figure(record), record)
    return written


def label(name: str) -> str:
    """A parameter's name for readers."""
    kind, _, region = name.partition(".")
    return LABELS.get(name, f"E_f {region}" if kind == "E_f" else name)


def designs_figure(record: Record) -> Figure:
    """Deviation of the first modulus with each design, one panel for each knowledge."""
    told = record["settings"]
    modulus = next(row["parameter"] for row in record["designs"])
    typical = f"{told['typical_mm']:g}"
    own = [row for row in record["designs"] if row["parameter"] == modulus]
    panels = list(dict.fromkeys(row["knowledge"] for row in own))
    frames = list(dict.fromkeys(row["frames"] for row in own))
    lines = list(dict.fromkeys((row["vertices_words"], row["errors"]) for row in own))
    figure = Figure(figsize=(2.5 * len(panels) + 2.4, 0.36 * len(lines) + 1.8))
    figure.set_layout_engine("constrained")
    grid = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
    for axes, knowledge in zip(grid, panels, strict=True):
        for k, some in enumerate(frames):
            chosen = [r for r in own if r["knowledge"] == knowledge and r["frames"] == some]
            std = [_shown(row["std"][typical]) for row in chosen]
            place = [lines.index((row["vertices_words"], row["errors"])) for row in chosen]
            # Open and closed lies on closed: drawn as a ring around it.
            ring = some == "open and closed"
            axes.plot(
                std, place, linestyle="none", marker=MARKERS[k % len(MARKERS)],
                color=COLOURS[k % len(COLOURS)], label=some, markersize=9 if ring else 5,
                fillstyle="none" if ring else "full",
            )  # fmt: skip
        axes.axvline(100 * told["target"], color="black", linewidth=1, linestyle="--")
        axes.set_xscale("log")
        axes.set_xlim(0.3, 1.3 * MOST_PERCENT)
        axes.set_title(knowledge, fontsize=9)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlabel("standard deviation [%]", fontsize=8)
        axes.tick_params(labelsize=8)
    grid[0].set_yticks(range(len(lines)), [f"{v}, {e}" for v, e in lines])
    grid[0].invert_yaxis()
    _titled_legend(
        figure,
        axes,
        f"How well {label(modulus)} would be known with {typical} mm of noise "
        f"(dashed: {100 * told['target']:g} %; simulated)",
    )
    return figure


def _shown(std: float | None) -> float:
    return MOST_PERCENT if std is None else min(100 * std, MOST_PERCENT)


def profiles_figure(record: Record) -> Figure:
    """The deviance of each parameter, and below it how the others follow."""
    found = record["profiles"]
    names = list(dict.fromkeys(one["parameter"] for one in found))
    labels = list(dict.fromkeys(one["label"] for one in found))
    figure = Figure(figsize=(2.9 * len(names), 5.8), layout="constrained")
    grid = figure.subplots(2, len(names), sharex="col", sharey="row", squeeze=False)
    for column, name in enumerate(names):
        upper, lower = grid[:, column]
        for k, text in enumerate(labels):
            one = next(o for o in found if o["parameter"] == name and o["label"] == text)
            at = one["parameters"].index(name)
            path = np.array(one["path"])
            style = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k], "markersize": 3}
            upper.plot(path[:, at], one["deviance"], label=text, linewidth=1, **style)
        upper.axhline(one["threshold"], color="black", linestyle="--", linewidth=1)
        upper.set_ylim(-0.3, 10)
        upper.set_title(label(name), fontsize=10)
        _draw_followers(lower, record, _first_of(found, name), name)
        lower.set_xlabel(label(name) + (" [MPa]" if name.startswith("E_f.") else " [factor]"))
        for axes in (upper, lower):
            axes.grid(alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].set_ylabel("deviance (95 % below the dashed line)", fontsize=8)
    grid[1, 0].set_ylabel("change of the others [%]", fontsize=8)
    _titled_legend(
        figure,
        grid[0, 0],
        f"Profile likelihoods, and (below, {labels[0]}) how the other parameters make up for the "
        f"one that is held; simulated",
    )
    return figure


def _titled_legend(figure: Figure, axes: Any, title: str, columns: int | None = None) -> None:
    """One legend above all panels, with the figure's title: below is where provenance is told."""
    handles, texts = axes.get_legend_handles_labels()
    figure.legend(
        handles, texts, loc="outside upper center", ncols=columns or len(texts), frameon=False,
        fontsize=8, title=title, title_fontsize=10,
    )  # fmt: skip


def _first_of(found: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    """The first observation's profile."""
    return next(one for one in found if one["parameter"] == name)


def _draw_followers(axes: Any, record: Record, one: Mapping[str, Any], name: str) -> None:
    path = np.array(one["path"])
    at = one["parameters"].index(name)
    for other in one["parameters"]:
        if other == name:
            continue
        k = one["parameters"].index(other)
        start = record["assumed"][record["parameters"].index(other)]
        which = record["parameters"].index(other)
        axes.plot(
            path[:, at],
            100 * (path[:, k] / start - 1),
            color=COLOURS[which % len(COLOURS)],
            linestyle=("-", "--", ":", "-.")[which % 4],
            label=label(other),
        )
    axes.legend(frameon=False, fontsize=7)


def valley_figure(record: Record) -> Figure:
    """95 % ellipses of the first modulus against each nuisance, and the profile's valley."""
    own = [e for e in record["ellipses"] if e["errors"] == "independent"]
    modulus = next(name for name in own[0]["names"] if name.startswith("E_f."))
    nuisances = [name for name in own[0]["names"] if not name.startswith("E_f.")]
    figure = Figure(figsize=(4.4 * len(nuisances), 4.4), layout="constrained")
    for axes, nuisance in zip(
        figure.subplots(1, len(nuisances), squeeze=False)[0], nuisances, strict=True
    ):
        for k, some in enumerate(own):
            _draw_ellipse(axes, some, modulus, nuisance, COLOURS[k % len(COLOURS)])
        first = next(
            (o for o in record["profiles"] if o["parameter"] == nuisance and o["low"]), None
        )
        if first is not None:
            path = _relative(record, first)
            i, j = (first["parameters"].index(name) for name in (nuisance, modulus))
            axes.plot(
                path[:, i], path[:, j], color="black", marker=".", linewidth=1,
                label=f"floor of the valley, {first['label']}",
            )  # fmt: skip
        axes.set_xlabel(f"{label(nuisance)} [%]")
        axes.set_ylabel(f"{label(modulus)} [%]")
        axes.autoscale_view()
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    _titled_legend(
        figure,
        axes,
        f"95 % regions with {record['settings']['typical_mm']:g} mm of independent noise, all "
        f"vertices; simulated",
        columns=3,
    )
    return figure


def _relative(record: Record, one: Mapping[str, Any]) -> FloatArray:
    """Change of each parameter along a profile, %."""
    start = [record["assumed"][record["parameters"].index(n)] for n in one["parameters"]]
    return np.asarray(100 * (np.array(one["path"]) / np.array(start) - 1))


def _draw_ellipse(
    axes: Any, some: Mapping[str, Any], modulus: str, nuisance: str, colour: str
) -> None:
    """Both parameters together lie in it with 95 %: chi-square with two degrees of freedom."""
    at = [some["names"].index(name) for name in (nuisance, modulus)]
    C = np.array(some["covariance"], dtype=float)[np.ix_(at, at)]
    if not np.all(np.isfinite(C)):
        return
    values, vectors = np.linalg.eigh(C * 1e4)
    width, height = 2 * np.sqrt(scipy.stats.chi2.ppf(0.95, 2) * values)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    dashed = some["frames"] == "open and closed"
    axes.add_patch(
        Ellipse(
            (0.0, 0.0), width, height, angle=angle, fill=False, color=colour, linewidth=1.5,
            linestyle="--" if dashed else "-", label=some["frames"],
        )
    )  # fmt: skip
