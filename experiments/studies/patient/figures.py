"""Figure 3 of the virtual patients, and ranks of the truth in each scenario's posteriors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import kstwo, norm

from experiments.common.cases.revealed import Groups
from mvest.errors import InputError
from mvest.problem.record import Spread
from mvest.problem.verdict import TRUSTWORTHY
from mvest.reporting.skill import score
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mvest.problem.fields import CaseFields

MODELS = {"generic": "generic", "personalised": "fitted"}
"""Names of models in Figure 3 -> their fields of a case."""

AT = np.linspace(0.0, 1.0, 101)[1:-1]
"""Quantiles at which distributions are drawn."""

LEAFLETS = ("#2b6ca3", "#c8452f")
"""Colours of the moduli."""


def figure_3(fields: Mapping[str, CaseFields], denied: Sequence[str] = ()) -> Figure:
    """The closed valves seen from the atrium, generic above personalised, on one scale.

    InputError if a patient's distances are missing.

    Parameters
    ----------
    fields : mapping
        Name of each patient -> its arrays.
    denied : sequence of str
        Names of patients with the verdict "no estimate", which the figure shows above them.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from mvest.reporting.case import drawing
    from mvest.reporting.figures import ATRIUM, DISTANCE_MAP

    closed = {
        name: {label: _closed(valve, which) for label, which in MODELS.items()}
        for name, valve in fields.items()
    }
    distances = [distance for models in closed.values() for _, distance in models.values()]
    scale = ScalarMappable(Normalize(0.0, drawing.distance_top(*distances)), DISTANCE_MAP)
    drawn = Figure(figsize=(2.6 * len(fields) + 0.6, 5.4), layout="constrained")
    grid = drawn.subplots(2, len(fields), squeeze=False)
    for column, (name, valve) in zip(grid.T, fields.items(), strict=True):
        no_estimate = "NO ESTIMATE" if name in denied else ""
        above = {"generic": name.replace("_", " "), "personalised": no_estimate}
        k = valve.closed + 1
        for axes, (label, (shape, distance)) in zip(column, closed[name].items(), strict=True):
            colours = drawing.corner_colours(scale, distance, valve.triangles)
            drawing.draw_valve(axes, valve, shape, colours, ATRIUM, k, strength=0.3)
            drawing.paint_leak(axes, valve, shape, k)
            axes.set_title(f"{above[label]}\n{Spread.of(distance)} mm".strip(), fontsize=9)
        shapes = [shape for shape, _ in closed[name].values()]
        drawing.same_scale(list(column), shapes, ATRIUM)
    for axes, label in zip(grid[:, 0], MODELS, strict=True):
        axes.text(
            -0.06, 0.5, label, transform=axes.transAxes, rotation=90, va="center", ha="right",
            fontsize=11,
        )  # fmt: skip
    bar = drawn.colorbar(scale, ax=grid, shrink=0.7, pad=0.01, extend="max")
    bar.set_label("distance from the observed closed valve [mm]")
    drawn.suptitle("Closed valves of virtual patients (simulated), seen from the atrium")
    return drawn


def _closed(valve: CaseFields, which: str) -> tuple[FloatArray, FloatArray]:
    """A model's closed positions and distances."""
    positions, distance = getattr(valve, which), getattr(valve, f"distance_{which}")
    if positions is None or distance is None:
        raise InputError("Figure 3 needs the distances of the generic and personalised valves")
    return positions[valve.closed], distance[valve.closed]


def ranks_figure(scenarios: Groups) -> Figure:
    """Ranks of the truth in the posterior, one panel per scenario.

    Each panel shows the empirical minus the uniform distribution function of the ranks, with the
    simultaneous 95 % band (Kolmogorov 1933, Giorn. Ist. Ital. Attuari 4:83). Values above zero on
    the left mean that truths are too low in the posterior.
    """
    from mvest.reporting.figures import panels

    columns = max(min(4, len(scenarios.members)), 1)
    lines = max(-(-len(scenarios.members) // columns), 1)
    drawn, grid = panels(lines, columns, 2.0 * lines + 0.6, sharex=True, sharey=True)
    for axes, (name, group) in zip(grid.flat, scenarios.members.items(), strict=False):
        trusted = sum(trust == TRUSTWORTHY for _, trust in group)
        axes.set_title(f"{name}\n{trusted} of {len(group)} trustworthy", fontsize=8)
        axes.axhline(0.0, color="0.5", lw=0.6)
        moduli = Groups({"": group}).unknowns(by_name=True, stated=False)
        for (modulus, unknowns), colour in zip(moduli.items(), LEAFLETS, strict=False):
            places = np.sort(norm.cdf([z for own in unknowns if (z := score(own)) is not None]))
            if not (n := len(places)):
                continue
            band = kstwo.ppf(0.95, n)
            axes.axhspan(-band, band, color="0.9", lw=0, zorder=0)
            off = np.searchsorted(places, AT, side="right") / n - AT
            label = modulus.removeprefix(", ").replace(".", " ")
            axes.step(AT, off, where="mid", color=colour, lw=1.2, label=label)
    for axes in grid.flat[len(scenarios.members) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("truth in posterior", fontsize=8)
    grid[0, 0].legend(fontsize=7, frameon=False, loc="upper right")
    drawn.supylabel("empirical minus uniform distribution", fontsize=9)
    return drawn
