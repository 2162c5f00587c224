"""Figures of the study of designs: deviations, profiles, and the valley they follow."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
import pandas as pd
import scipy
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from experiments.common.records.record import Record
from experiments.common.records.report import axis_label
from experiments.studies.identifiability.findings import Findings, Joint, Profile
from mvest.reporting.figures import COLOURS, MARKERS
from mvest.reporting.style import SMALL, headline, panels, plain_number
from mvest.typing import FloatArray

__all__ = [
    "designs_answer",
    "designs_figure",
    "identifiability_figures",
    "profiles_figure",
    "valley_figure",
]

MULTIPLES = (1.0, 2.0, 6.0)
"""Of the target: where a deviation's colour changes."""

SHADES = ("#0072B2", "#9ECAE1", "#F6E3C5", "#E8A87C")
"""From within the target to far from it; blue is what all figures show as good."""


def identifiability_figures(record: Record[Findings]) -> dict[str, Figure]:
    """Figures by the ends of their names: designs, and what profiles there are to show."""
    findings = record.findings
    figures = {"designs": designs_figure(findings)}
    if findings.profiles:
        figures["profiles"] = profiles_figure(findings, record.parameters)
        figures["valley"] = valley_figure(findings, record.parameters)
    return figures


def _deviations(findings: Findings) -> pd.DataFrame:
    """Deviation of the first modulus with the typical noise: one row for each different design."""
    modulus = _modulus(findings)
    typical = f"{findings.settings.typical_mm:g}"
    table = pd.DataFrame(
        {
            "knowledge": one.knowledge,
            "seen": f"{design.vertices_words}, {design.errors}",
            "frames": design.frames,
            "percent": np.inf if (std := one.std[typical]) is None else 100 * std,
        }
        for design in findings.designs
        for one in design.moduli
        if one.parameter == modulus
    )
    return _without_twins(table)


def _modulus(findings: Findings) -> str:
    return findings.designs[0].moduli[0].parameter


def designs_answer(findings: Findings) -> str:
    """How many designs would do."""
    shown, target = _deviations(findings), 100 * findings.settings.target
    within = shown[shown["percent"] <= target]
    never = [k for k in shown["knowledge"].unique() if k not in set(within["knowledge"])]
    text = f"{len(within)} of {len(shown)} designs would tell {axis_label(_modulus(findings))} to "
    return text + f"{target:g} %" + (f"; none with {' or '.join(never)}" if never else "")


def designs_figure(findings: Findings) -> Figure:
    """Deviation of the first modulus as a table in colours, one panel for each knowledge."""
    settings, shown = findings.settings, _deviations(findings)
    typical, target = f"{settings.typical_mm:g}", 100 * settings.target
    knowledges = list(shown["knowledge"].unique())
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
    headline(
        figure,
        designs_answer(findings),
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


def profiles_figure(findings: Findings, parameters: tuple[str, ...]) -> Figure:
    """The deviance of each parameter, and below it how the others follow."""
    profiles = findings.profiles
    names = list(dict.fromkeys(one.parameter for one in profiles))
    labels = list(dict.fromkeys(one.label for one in profiles))
    figure = Figure(figsize=(2.9 * len(names), 5.8), layout="constrained")
    grid = figure.subplots(2, len(names), sharex="col", sharey="row", squeeze=False)
    for column, name in enumerate(names):
        upper, lower = grid[:, column]
        own = {one.label: one for one in profiles if one.parameter == name}
        for k, text in enumerate(labels):
            one = own[text]
            held = np.array(one.path)[:, one.at]
            upper.plot(
                held, one.deviance, label=text, linewidth=1, markersize=3,
                color=COLOURS[k % len(COLOURS)], marker=MARKERS[k],
            )  # fmt: skip
        upper.axhline(one.threshold, color="black", linestyle="--", linewidth=1)
        upper.set_ylim(-0.3, 10)
        upper.set_title(axis_label(name), fontsize=10)
        _draw_followers(lower, findings, own[labels[0]], parameters)
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
    """One legend above all panels, with the figure's title: below stands where it comes from."""
    handles, texts = axes.get_legend_handles_labels()
    figure.legend(
        handles, texts, loc="outside upper center", ncols=columns or len(texts), frameon=False,
        fontsize=8, title=title, title_fontsize=10,
    )  # fmt: skip


def _draw_followers(
    axes: Any, findings: Findings, one: Profile, parameters: tuple[str, ...]
) -> None:
    change = _relative(findings, one, parameters)
    for k, other in enumerate(one.parameters):
        if other == one.parameter:
            continue
        which = parameters.index(other)
        axes.plot(
            np.array(one.path)[:, one.at],
            change[:, k],
            color=COLOURS[which % len(COLOURS)],
            linestyle=("-", "--", ":", "-.")[which % 4],
            label=axis_label(other),
        )
    axes.legend(frameon=False, fontsize=7)


def valley_figure(findings: Findings, parameters: tuple[str, ...]) -> Figure:
    """95 % ellipses of the first modulus against each nuisance, and the profile's valley."""
    own = [
        (design.frames, design.joint)
        for design in findings.designs
        if design.joint is not None and design.errors == "independent"
    ]
    names = own[0][1].names
    modulus = next(name for name in names if name.startswith("E_f."))
    nuisances = [name for name in names if not name.startswith("E_f.")]
    figure = Figure(figsize=(4.4 * len(nuisances), 4.4), layout="constrained")
    for axes, nuisance in zip(
        figure.subplots(1, len(nuisances), squeeze=False)[0], nuisances, strict=True
    ):
        for k, (frames, joint) in enumerate(own):
            colour = COLOURS[k % len(COLOURS)]
            _draw_ellipse(axes, frames, joint, (nuisance, modulus), colour)
        first = next((o for o in findings.profiles if o.parameter == nuisance and o.low), None)
        if first is not None:
            path = _relative(findings, first, parameters)
            axes.plot(
                path[:, first.at], path[:, first.parameters.index(modulus)], color="black",
                marker=".", linewidth=1, label=f"floor of the valley, {first.label}",
            )  # fmt: skip
        axes.set_xlabel(f"{axis_label(nuisance)} [%]")
        axes.set_ylabel(f"{axis_label(modulus)} [%]")
        axes.autoscale_view()
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    _titled_legend(
        figure,
        axes,
        f"95 % regions with {findings.settings.typical_mm:g} mm of independent noise, all "
        f"vertices; simulated",
        columns=3,
    )
    return figure


def _relative(findings: Findings, one: Profile, parameters: tuple[str, ...]) -> FloatArray:
    """Change of each parameter along a profile, %."""
    start = [findings.assumed[parameters.index(name)] for name in one.parameters]
    return np.asarray(100 * (np.array(one.path) / np.array(start) - 1))


def _draw_ellipse(
    axes: Any, frames: str, joint: Joint, names: tuple[str, str], colour: str
) -> None:
    """Both parameters together lie in it with 95 %: chi-square with two degrees of freedom."""
    at = [joint.names.index(name) for name in names]
    C = np.array(joint.covariance, dtype=float)[np.ix_(at, at)]
    if not np.all(np.isfinite(C)):
        return
    values, vectors = np.linalg.eigh(C * 1e4)
    width, height = 2 * np.sqrt(scipy.stats.chi2.ppf(0.95, 2) * values)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(
        Ellipse(
            (0.0, 0.0), width, height, angle=angle, fill=False, color=colour, linewidth=1.5,
            linestyle="--" if frames == "open and closed" else "-", label=frames,
        )
    )  # fmt: skip
