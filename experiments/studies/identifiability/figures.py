"""Figures of the study of designs: deviations, profiles, and the valley they follow."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from experiments.common.report import axis_label
from mvest.reporting.figures import COLOURS, MARKERS, save_figure
from mvest.reporting.style import SMALL, headline, panels, plain_number
from mvest.typing import FloatArray

__all__ = [
    "designs_figure",
    "profiles_figure",
    "valley_figure",
    "write_identifiability_figures",
]

Record = Mapping[str, Any]

MULTIPLES = (1.0, 2.0, 6.0)
"""Of the target: where a deviation's colour changes."""

SHADES = ("#0072B2", "#9ECAE1", "#F6E3C5", "#E8A87C")
"""From within the target to far from it; blue is what all figures show as good."""


def write_identifiability_figures(folder: Path, record: Record) -> list[Path]:
    """``identifiability_designs``, ``_profiles`` and ``_valley`` as PNG and PDF."""
    if not record.get("designs"):
        return []
    written = save_figure(folder / "identifiability_designs", designs_figure(record), record)
    if record["profiles"]:
        written += save_figure(folder / "identifiability_profiles", profiles_figure(record), record)
        written += save_figure(folder / "identifiability_valley", valley_figure(record), record)
    return written


def designs_figure(record: Record) -> Figure:
    """Deviation of the first modulus as a table in colours, one panel for each knowledge."""
    settings = record["settings"]
    modulus = next(row["parameter"] for row in record["designs"])
    typical, target = f"{settings['typical_mm']:g}", 100 * settings["target"]
    table = pd.DataFrame(
        {
            "knowledge": row["knowledge"],
            "seen": f"{row['vertices_words']}, {row['errors']}",
            "frames": row["frames"],
            "percent": np.inf if row["std"][typical] is None else 100 * row["std"][typical],
        }
        for row in record["designs"]
        if row["parameter"] == modulus
    )
    shown, knowledges = _without_twins(table), list(table["knowledge"].unique())
    seen, frames = list(shown["seen"].unique()), list(shown["frames"].unique())
    figure, grid = panels(1, len(knowledges), 0.3 * len(seen) + 2.6, sharey=True)
    colours = ListedColormap(SHADES)
    norm = BoundaryNorm([0.0, *(m * target for m in MULTIPLES), np.inf], len(SHADES))
    for axes, knowledge in zip(grid[0], knowledges, strict=True):
        own = shown[shown["knowledge"] == knowledge].pivot(
            index="seen", columns="frames", values="percent"
        )
        values = own.loc[seen, frames].to_numpy()
        axes.imshow(values, cmap=colours, norm=norm, aspect="auto")
        for (row, column), value in np.ndenumerate(values):
            axes.text(
                column, row, plain_number(value) if np.isfinite(value) else "∞", ha="center",
                va="center", fontsize=SMALL - 1, color="white" if value <= target else "black",
            )  # fmt: skip
        reached = int((values <= target).sum())
        title = textwrap.fill(knowledge, 18)
        axes.set_title(f"{title}\n{reached} of {values.size}", fontsize=SMALL)
        axes.set_xticks(range(len(frames)), [textwrap.fill(f, 24) for f in frames], rotation=90)
        axes.grid(visible=False)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0, labelsize=SMALL - 1)
    grid[0, 0].set_yticks(range(len(seen)), seen)
    within = shown[shown["percent"] <= target]
    never = [k for k in knowledges if k not in set(within["knowledge"])]
    text = f"{len(within)} of {len(shown)} designs would tell {axis_label(modulus)} to "
    text += f"{target:g} %" + (f"; none with {' or '.join(never)}" if never else "")
    headline(
        figure,
        text,
        f"Standard deviation expected [%] with {typical} mm of noise; dark: at most {target:g} %. "
        f"Simulated.",
    )
    return figure


def _without_twins(table: pd.DataFrame) -> pd.DataFrame:
    """Frames that tell the same as earlier ones everywhere are shown together with these."""
    names: list[str] = []
    kept: list[FloatArray] = []
    for name, rows in table.groupby("frames", sort=False):
        values = rows["percent"].to_numpy()
        twin = next((k for k, v in enumerate(kept) if np.allclose(v, values, rtol=1e-3)), None)
        if twin is None:
            names.append(str(name))
            kept.append(values)
        else:
            table = table[table["frames"] != name]
            table = table.replace({"frames": {names[twin]: f"{names[twin]} = {name}"}})
            names[twin] = f"{names[twin]} = {name}"
    return table


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
        upper.set_title(axis_label(name), fontsize=10)
        _draw_followers(lower, record, _first_of(found, name), name)
        lower.set_xlabel(axis_label(name) + (" [MPa]" if name.startswith("E_f.") else " [factor]"))
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
            label=axis_label(other),
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
        axes.set_xlabel(f"{axis_label(nuisance)} [%]")
        axes.set_ylabel(f"{axis_label(modulus)} [%]")
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
