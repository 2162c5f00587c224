"""What each part of what a volume leaves unknown costs the moduli: table, figure and words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from experiments.common.records.tables import write_table
from mvest.personalisation.error_budget import EVERYTHING, IMAGES, MOTION
from mvest.reporting.case.findings import Cost
from mvest.reporting.figures import save_figure_with
from mvest.reporting.style import SMALL, headline, panels

__all__ = ["budget_figure", "budget_table", "write_budget"]

NOTE = (
    "Standard deviation of a modulus' logarithm at the estimate, to first order, median over {n} "
    "simulated volumes. *Without*: the part known exactly and all else as it is; *alone*: all else "
    "known exactly ({everything} alone: nothing but the noise of single points). Errors of the "
    "images are of held-out volumes, each met with a gain that has not seen it, and not localised; "
    "their parts add up to them, but for {motion}: by how much they differ between open and closed "
    "frame. Prior of the moduli: {prior:.2f}."
)


def budget_table(budgets: Mapping[str, Sequence[Cost]]) -> pd.DataFrame:
    """One row for each patient, part and modulus."""
    return pd.DataFrame(
        [
            {
                "patient": patient,
                "part": row.part,
                "modulus": row.modulus.partition(".")[2],
                "without": row.without,
                "alone": row.alone,
            }
            for patient, rows in budgets.items()
            for row in rows
        ]
    )


def _medians(table: pd.DataFrame) -> pd.DataFrame:
    """Part -> (without or alone, modulus), in the order of the parts."""
    parts = list(dict.fromkeys(table["part"]))
    return table.pivot_table(
        index="part", columns="modulus", values=["without", "alone"], aggfunc="median"
    ).loc[parts]


def budget_figure(budgets: Mapping[str, Sequence[Cost]]) -> Figure:
    """What is left without each part, and with it alone, of each modulus."""
    medians = _medians(budget_table(budgets))
    parts = [part for part in medians.index if part != EVERYTHING]
    leaflets = list(medians["alone"].columns)
    figure, axes = panels(1, len(leaflets), 0.27 * len(parts) + 1.6, sharex=True, sharey=True)
    for one, leaflet in zip(axes[0], leaflets, strict=True):
        everything = medians.loc[EVERYTHING, ("without", leaflet)]
        one.axvline(everything, color="0.5", lw=0.9, ls="--")
        places = range(len(parts))
        for kind, colour, marker in (("alone", "#31446B", "o"), ("without", "#C8553D", "D")):
            one.plot(
                medians[kind][leaflet][parts], places, marker, color=colour, ms=4.5, label=kind
            )
        one.set_yticks(list(places), parts)
        one.set_ylim(len(parts) - 0.5, -0.5)
        one.set_xlim(0.0, 1.08 * float(medians.loc[parts].to_numpy().max()))
        one.set_title(leaflet, loc="left", fontsize=SMALL + 0.5)
        one.set_xlabel("SD of the modulus' logarithm")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower right", ncols=2, fontsize=SMALL, frameon=False
    )
    headline(
        figure,
        "Where the information dies between a volume and a modulus",
        "Each part of what is not known, alone and taken away; dashed: with all of it.",
    )
    return figure


def write_budget(
    base: Path, budgets: Mapping[str, Sequence[Cost]], prior: float, line: str
) -> list[Path]:
    """Table and figure of the budgets of some patients, named ``base``; nothing if there is none.

    Raises
    ------
    InputError
        A file that cannot be written.
    """
    budgets = {name: rows for name, rows in budgets.items() if rows}
    if not budgets:
        return []
    table = budget_table(budgets)
    medians = _medians(table)
    leaflets = list(medians["alone"].columns)
    readable = [
        {"part": str(part)}
        | {
            f"{leaflet}, {kind}": f"{row[kind, leaflet]:.3f}"
            for leaflet in leaflets
            for kind in ("without", "alone")
        }
        for part, row in medians.iterrows()
    ]
    note = NOTE.format(
        n=len(budgets),
        everything=f"*{EVERYTHING}*",
        motion=f"*{MOTION}*",
        prior=prior,
    )
    return [
        *write_table(base, table, readable, line, [note, budget_words(medians)]),
        *save_figure_with(base, budget_figure(budgets), line),
    ]


def budget_words(medians: pd.DataFrame) -> str:
    """What costs most, in one sentence for each modulus."""
    said = []
    for leaflet in medians["alone"].columns:
        without, alone = medians["without"][leaflet], medians["alone"][leaflet]
        parts = [part for part in medians.index if part not in (EVERYTHING, IMAGES, MOTION)]
        worst = alone[parts].sort_values(ascending=False).index[:3]
        listed = ", ".join(f"{part} ({alone[part]:.2f})" for part in worst)
        said.append(
            f"{leaflet.capitalize()}: {without[EVERYTHING]:.2f} with everything, "
            f"{without[IMAGES]:.2f} without errors of the images, {without[MOTION]:.2f} if these "
            f"were the same in both frames. Alone cost most: {listed}."
        )
    return " ".join(said)
