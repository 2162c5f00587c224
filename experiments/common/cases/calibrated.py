"""The calibration of moduli on virtual patients: its numbers, and how each patient does without it.

Each patient's calibrated estimate is predicted from all other patients (left out).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import linregress, sem

from mvest.errors import InputError
from mvest.estimation.recalibration import left_out
from mvest.personalisation.calibration import calibrate, pairs_of
from mvest.problem.record import UNCALIBRATED, EstimateRecord, Unknown
from mvest.reporting.skill import HALF, skill_table
from mvest.reporting.tables import Column, Table, table
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TICKS = (0.3, 0.5, 1.0, 2.0, 3.0)
BEFORE, AFTER = UNCALIBRATED, "calibrated"


def before_and_after(estimates: Sequence[EstimateRecord]) -> dict[str, list[Unknown]]:
    """``uncalibrated, NAME`` and ``calibrated, NAME`` -> moduli and their ratios, by patient.

    All are relative to their prior means. InputError as `pairs_of`.
    """
    pairs = pairs_of(estimates)
    names = [str(name).removeprefix("E_f.") for name in pairs.row["parameters"]]
    directions = dict(zip(names, np.eye(len(names)), strict=True))
    for a, b in combinations(names, 2):
        directions[f"{a} / {b}"] = directions[a] - directions[b]
    own = pairs.estimates[0].moduli
    prior = np.array([float(m.prior_std or 0) / float(m.prior_mean or 1) for m in own])

    def along(name: str, means: FloatArray, covariances: FloatArray) -> list[Unknown]:
        d = directions[name]
        stds = np.sqrt(np.einsum("i,nij,j->n", d, covariances, d))
        return [
            Unknown(
                name=f"E_f.{name}",
                kind="modulus" if name in names else "quantity",
                prior_mean=1.0,
                prior_std=float(np.linalg.norm(d * prior)),
                estimate=float(np.exp(mean)),
                std=float(np.exp(mean) * std),
                low=float(np.exp(mean - HALF * std)),
                high=float(np.exp(mean + HALF * std)),
                truth=float(np.exp(truth)),
            )
            for mean, std, truth in zip(means @ d, stds, pairs.truth @ d, strict=True)
        ]

    found = {BEFORE: (pairs.x, pairs.V), AFTER: left_out(pairs.x, pairs.V, pairs.truth)}
    return {f"{when}, {name}": along(name, *found[when]) for name in directions for when in found}


def calibration_tables(estimates: Sequence[EstimateRecord]) -> dict[str, Table]:
    """The calibration, and skill and bias of the estimates before and after it, left out.

    Only the reason if there is none: too few patients, or some of other detectors.
    """
    try:
        known, groups = calibrate(estimates), before_and_after(estimates)
    except InputError as fault:
        return {"": table([{"no calibration": str(fault)}])}
    measured = known.measured
    stds = np.sqrt(np.diag(measured.covariance)).reshape(2, -1)
    columns = {
        "modulus": known.parameters,
        "offset": measured.offset,
        "offset SD": stds[0],
        "slope": measured.slope,
        "slope SD": stds[1],
        "spread": np.exp(measured.log_spread),
        "spread SD": np.exp(measured.log_spread) * np.sqrt(np.diag(measured.log_spread_covariance)),
    }
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    about = {name: Column(digits=".2f", std=f"{name} SD") for name in ("offset", "slope", "spread")}
    return {
        "": table(
            [row | {"patients": known.patients, "simulated": known.simulated} for row in rows],
            modulus=Column(),
            **about,
        ),
        "skill": skill_table("estimate", groups),
        "bias": bias_table("estimate", groups, of_truth=True),
    }


def bias_table(
    by: str, groups: Mapping[str, Sequence[Unknown]], *, of_truth: bool = False
) -> Table:
    """Mean error of the logarithms, and their slope over the truths', if they have estimates.

    With ``of_truth`` the truths' slope over the estimates, which is 1 after a calibration.
    """
    rows = []
    for name, own in groups.items():
        known = [(one.truth, one.estimate) for one in own if one.estimate is not None]
        truth, found = np.log(np.array(known, dtype=np.float64).reshape(-1, 2).T)
        row = {by: name, "n": len(known), **dict.fromkeys(("bias", "bias SE", "slope", "slope SE"))}
        if len(known) > 1:
            row |= {"bias": np.mean(found - truth), "bias SE": sem(found - truth)}
        if len(known) > 2 and np.ptp(truth) > 0:
            line = linregress(found, truth) if of_truth else linregress(truth, found)
            row |= {"slope": line.slope, "slope SE": line.stderr}
        rows.append(row)
    digits, text = (
        (".3f", "the truth's slope over it") if of_truth else (".2f", "slope over the truth's")
    )
    bias = Column(digits=digits, std="bias SE", label="mean error of the logarithm ± SE")
    slope = Column(digits=".2f", std="slope SE", label=f"{text} ± SE")
    return table(rows, **{by: Column(), "n": Column()}, bias=bias, slope=slope)


def calibration_figure(estimates: Sequence[EstimateRecord]) -> dict[str, Figure]:
    """True moduli and ratios over their estimates before and after calibration, left out.

    Nothing if there is no calibration.
    """
    from mvest.reporting.figures import COLOURS, GREY, panels

    try:
        groups: Mapping[str, Sequence[Unknown]] = before_and_after(estimates)
    except InputError:
        return {}
    names = list(dict.fromkeys(group.partition(", ")[2] for group in groups))
    drawn, (grid,) = panels(1, len(names), 3.4)
    for axes, name in zip(grid, names, strict=True):
        for when, colour, marker in ((BEFORE, GREY, "x"), (AFTER, COLOURS[0], "o")):
            own = groups[f"{when}, {name}"]
            x, truth = ([getattr(one, key) for one in own] for key in ("estimate", "truth"))
            axes.plot(x, truth, marker, color=colour, ms=4, ls="", label=when)
        axes.axline((1.0, 1.0), (2.0, 2.0), color="0.3", lw=0.8)
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_ticks(TICKS, labels=[f"{tick:g}" for tick in TICKS])
        axes.minorticks_off()
        axes.set_title(f"E_f {name}", fontsize=9)
        axes.set_xlabel("estimate / prior mean")
    grid[0].set_ylabel("truth / prior mean")
    grid[0].legend(fontsize=8, frameon=False)
    return {"": drawn}
