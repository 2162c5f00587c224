"""How often the intervals of the virtual patients drawn at random contain the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.common.cases.findings import Findings
from experiments.common.cases.skill import (
    GENERIC,
    PRIOR,
    generic_guess,
    prior_alone,
    share_bounds,
    skill_words,
)
from experiments.common.records.record import Record
from experiments.common.records.report import cautions, provenance_of
from experiments.common.records.tables import write_table
from experiments.studies.patient.tables import (
    distance_words,
    table3,
    verdict_word,
    without_estimate,
)
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY
from mvest.reporting.figures import save_figure_with
from mvest.reporting.markup import MISSING

__all__ = ["population_frame", "write_population_tables"]

WITH = "with nuisances"
"""The estimation of all unknowns, on which there is a verdict."""

COLUMNS = ("name", "unit", "truth", "estimate", "std", "low", "high", "inside")
"""What is listed of an unknown."""


def population_frame(records: Sequence[Record[Findings]]) -> pd.DataFrame:
    """One row for each patient and unknown: truth, estimate and interval, and of the guesses."""
    rows = []
    for record in records:
        case = record.findings.case
        alone = case.without_nuisances
        moduli = [row for row in case.unknowns if row.is_modulus]
        for estimation, unknowns in (
            (WITH, case.unknowns),
            ("without nuisances", alone.parameters if alone else ()),
            (GENERIC, list(map(generic_guess, moduli))),
            (PRIOR, list(map(prior_alone, moduli))),
        ):
            rows += [
                {
                    "patient": case.about.name,
                    "estimation": estimation,
                    "status": record.status,
                    "verdict": verdict_word(case),
                    **{name: getattr(row, name) for name in COLUMNS},
                }
                for row in unknowns
            ]
    return pd.DataFrame(rows)


def write_population_tables(results: Path, records: Sequence[Record[Findings]]) -> list[Path]:
    """``population.*`` from kept patients drawn at random."""
    table = population_frame(records)
    readable = []
    for (estimation, name), group in table.groupby(["estimation", "name"], sort=False):
        known = group[group["estimate"].notna() & group["truth"].notna()]
        if estimation == WITH:
            known = known[known["verdict"] != NONE]
        judged = known["inside"].dropna()
        inside, n = int(judged.sum()), len(judged)
        low, high = share_bounds(inside, n)
        error = (known["estimate"] - known["truth"]).astype(float)
        relative = str(name).startswith("E_f.") or "_" in str(name)
        scale = known["truth"].astype(float) if relative else 1.0
        width = (known["high"] - known["low"]).astype(float) / scale
        readable.append(
            {
                "estimation": str(estimation),
                "unknown": str(name),
                "patients": f"{len(known)} of {len(group)}",
                "95 % interval contains the truth": f"{inside} ({100 * inside / n:.0f} %)"
                if n
                else MISSING,
                "95 % bounds of that share": f"{100 * low:.0f} to {100 * high:.0f} %"
                if n
                else MISSING,
                "mean error": _amount((error / scale).mean(), relative),
                "median size of the error": _amount((error / scale).abs().median(), relative),
                "mean width": _amount(width.mean(), relative),
            }
        )
    distances = table3(records)
    cases = [record.findings.case for record in records]
    unknowns = [row for case in cases if case.is_stated for row in case.unknowns]
    notes = [
        *cautions(records),
        "Simulated valves with anatomies and moduli drawn at random; the truth was revealed after "
        "the estimation.",
        *without_estimate(cases),
        skill_words([row for row in unknowns if row.is_modulus]),
        *_both_moduli(table),
        *_by_verdict(table),
        *distance_words(distances),
    ]
    base = results / "population"
    written = write_table(base, table, readable, provenance_of(records), notes)
    return [*written, *save_figure_with(base, population_figure(table), records[0].line)]


def _both_moduli(table: pd.DataFrame) -> list[str]:
    out = []
    for estimation, group in table[table["estimation"] != GENERIC].groupby(
        "estimation", sort=False
    ):
        known = group[group["name"].str.startswith("E_f.") & group["inside"].notna()]
        if estimation == WITH:
            known = known[known["verdict"] != NONE]
        inside = int(known["inside"].sum())
        out.append(
            f"Both moduli, {estimation}: the 95 % interval contains the truth {inside} times of "
            f"{len(known)} ({100 * inside / max(len(known), 1):.0f} %)."
        )
    return out


def _by_verdict(table: pd.DataFrame) -> list[str]:
    """What verdicts are worth."""
    own = table[(table["estimation"] == WITH) & table["name"].str.startswith("E_f.")]
    out = []
    for verdict in (TRUSTWORTHY, DOUBTFUL):
        known = own[(own["verdict"] == verdict) & own["inside"].notna()]
        if known.empty:
            continue
        error = ((known["estimate"] - known["truth"]) / known["truth"]).abs().median()
        inside, patients = int(known["inside"].sum()), known["patient"].nunique()
        out.append(
            f"Called {verdict}: {patients} patients, {inside} of {len(known)} moduli inside, "
            f"median error {100 * error:.1f} %."
        )
    return out


def population_figure(table: pd.DataFrame) -> Figure:
    """Estimates with their intervals against the truth, with and without nuisances."""
    names = [n for n in table["name"].unique() if n.startswith("E_f.")]
    kinds = [kind for kind in table["estimation"].unique() if kind not in (GENERIC, PRIOR)]
    figure = Figure(figsize=(4.2 * len(names), 3.9 * len(kinds)), layout="constrained")
    grid = figure.subplots(len(kinds), len(names), squeeze=False)
    for i, kind in enumerate(kinds):
        for j, name in enumerate(names):
            axes = grid[i, j]
            part = table[(table["estimation"] == kind) & (table["name"] == name)]
            part = part[part["inside"].notna()]
            if kind == WITH:
                part = part[part["verdict"] != NONE]
            axes.set_title(f"{name.replace('E_f.', 'E_f ')}, {kind}", fontsize=10)
            if part.empty:
                axes.set_axis_off()
                continue
            truth, estimate = part["truth"].astype(float), part["estimate"].astype(float)
            inside = part["inside"].astype(bool)
            for chosen, colour, words in (
                (inside, "#2b6ca3", "contains the truth"),
                (~inside, "#c8452f", "does not"),
            ):
                reach = np.array(
                    [
                        (estimate - part["low"].astype(float))[chosen],
                        (part["high"].astype(float) - estimate)[chosen],
                    ]
                )
                axes.errorbar(
                    truth[chosen], estimate[chosen], yerr=reach, fmt="o", ms=3.5, lw=1.0,
                    color=colour, label=f"{words} ({int(chosen.sum())})",
                )  # fmt: skip
            ends = np.array([truth.min() * 0.8, truth.max() * 1.25])
            axes.plot(ends, ends, color="0.4", lw=0.8, zorder=0)
            axes.set_xscale("log")
            axes.set_yscale("log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_formatter(lambda v, _: f"{v:g}")
                axis.set_minor_formatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "2357" else "")
                axis.set_tick_params(which="minor", labelsize=8)
            axes.set_xlabel("hidden truth [MPa]")
            axes.set_ylabel("estimate, 95 % interval [MPa]")
            axes.legend(fontsize=8, loc="upper left", frameon=False)
            axes.spines[["top", "right"]].set_visible(False)
    return figure


def _amount(value: float, relative: bool) -> str:
    if not np.isfinite(value):
        return MISSING
    return f"{100 * value:.1f} %" if relative else f"{value:.2f}"
