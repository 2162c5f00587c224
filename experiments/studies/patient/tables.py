"""Tables 2 and 3 and Figure 3 of the paper for the virtual patients.

Made from the kept records (simulated), each with the truth that was revealed
after its estimation.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from experiments.common.cases.findings import Findings
from experiments.common.cases.report import interval_words
from experiments.common.cases.skill import baselines, prior_alone, skill_words
from experiments.common.records.record import Record
from experiments.common.records.report import cautions, provenance_of
from experiments.common.records.tables import write_table
from mvest.errors import InputError
from mvest.problem.verdict import NONE
from mvest.reporting.case.drawing import ATRIUM, draw_valve, paint_leak, same_scale
from mvest.reporting.case.fields import CaseFields, read_case_fields
from mvest.reporting.case.figures import corner_colours, distance_top
from mvest.reporting.case.findings import CaseFindings, ModuliAlone, UnknownRow
from mvest.reporting.figures import DISTANCE_MAP, save_figure_with
from mvest.reporting.findings import Spread
from mvest.reporting.markup import MISSING, number

__all__ = [
    "PATIENTS",
    "POPULATION",
    "distance_words",
    "in_order",
    "table2",
    "table3",
    "verdict_word",
    "without_estimate",
    "write_patient_tables",
]

PATIENTS, POPULATION = "patients", "population"
"""Folders of the kept records within the results."""

ORDER = ("normal_small", "normal_large", "functional_mr", "prolapse", "fibroelastic")
"""In which the five patients are listed; others follow by name."""

WHICH = ("generic", "registered", "personalised")
"""The closed valves whose distances are listed; registered: generic, laid on the frame rigidly."""

NOTE = (
    "Simulated valves; the moduli and distances in the rows of the paper belong to five patients "
    "whose images are not public, and the anatomies here have nothing to do with theirs. The truth "
    "was revealed after the estimation."
)


def in_order(records: Mapping[str, Record[Findings]]) -> dict[str, Record[Findings]]:
    """Name -> record, in the order of the tables."""

    def place(item: tuple[str, Record[Findings]]) -> tuple[int, str]:
        name = _patient(item[1])
        return (ORDER.index(name) if name in ORDER else len(ORDER)), name

    return dict(sorted(records.items(), key=place))


# -- Tables 2 and 3 -------------------------------------------------------------------------------
def table2(records: Sequence[Record[Findings]]) -> pd.DataFrame:
    """One row for each patient and modulus E_f: estimates with intervals beside the truth, MPa."""
    rows = []
    for record in records:
        case, revealed = record.findings.case, record.findings.revealed
        paper = revealed.paper_moduli if revealed else ()
        for k, row in enumerate(_moduli(case.unknowns)):
            plain: dict[str, Any] = {
                "patient": case.about.name,
                "verdict": verdict_word(case),
                "modulus": row.name,
                "hidden truth [MPa]": row.truth,
                "estimate [MPa]": row.estimate,
                "95 % low [MPa]": row.low,
                "95 % high [MPa]": row.high,
                "inside": row.inside,
            }
            for alone, words in (
                (case.without_nuisances, "without nuisances"),
                (case.as_in_the_paper, "paper's filter"),
            ):
                other = _moduli(alone.parameters)[k] if alone else None
                plain |= {
                    f"{words} [MPa]": other and other.estimate,
                    f"{words} 95 % low [MPa]": other and other.low,
                    f"{words} 95 % high [MPa]": other and other.high,
                    f"{words} inside": other and other.inside,
                    f"{words} ended": alone and alone.reason,
                }
            before = prior_alone(row)
            plain |= {
                "generic guess [MPa]": row.prior_mean,
                "prior alone 95 % low [MPa]": before.low,
                "prior alone 95 % high [MPa]": before.high,
                "prior alone inside": before.inside,
                "paper's estimate for its patient [MPa]": paper[k] if paper else None,
            }
            rows.append(plain)
    return pd.DataFrame(rows)


def table3(records: Sequence[Record[Findings]]) -> pd.DataFrame:
    """One row for each patient and frame: distances generic, registered, personalised, mm."""
    rows = []
    for record in records:
        revealed = record.findings.revealed
        for distance in record.findings.case.distances:
            plain: dict[str, Any] = {
                "patient": _patient(record),
                "verdict": verdict_word(record.findings.case),
                "frame": distance.frame,
                "shown to the filter": distance.seen,
            }
            models = (distance.generic, distance.registered, distance.personalised)
            for which, spread in zip(WHICH, models, strict=True):
                plain[f"{which} mean [mm]"] = spread.mean
                plain[f"{which} SD [mm]"] = spread.std
            generic, own = distance.generic.mean, distance.personalised.mean
            plain["closer [%]"] = 100.0 * (generic - own) / generic
            truth = distance.to_truth
            for which in WHICH:
                off: Spread | None = getattr(truth, which) if truth else None
                plain[f"{which} to the truth [mm]"] = off and off.mean
            paper = revealed.paper_distance_mm if revealed and distance.seen else ()
            plain["paper generic [mm]"] = paper[0] if paper else None
            plain["paper personalised [mm]"] = paper[1] if paper else None
            rows.append(plain)
    return pd.DataFrame(rows)


def write_patient_tables(
    results: Path, kept: Mapping[str, Record[Findings]], arrays: Mapping[str, Path]
) -> list[Path]:
    """``table2.*``, ``table3.*`` and ``figure3.*`` from kept patients and their arrays.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    records = list(kept.values())
    line, notes = provenance_of(records), [*cautions(records), NOTE]
    second, third = table2(records), table3(records)
    written = write_table(
        results / "table2", second, _readable2(records), line, [*notes, *_words2(second, records)]
    )
    if not third.empty:
        written += write_table(
            results / "table3", third, _readable3(third), line, [*notes, *distance_words(third)]
        )
    fields = {
        _patient(record): read_case_fields(arrays[name])
        for name, record in kept.items()
        if name in arrays
    }
    if fields:
        cases = {_patient(record): record.findings.case for record in records}
        failed = [name for name, case in cases.items() if not case.is_stated]
        figure = figure3(fields, failed)
        written += save_figure_with(results / "figure3", figure, records[0].line)
    return written


def _readable2(records: Sequence[Record[Findings]]) -> list[dict[str, str]]:
    rows = []
    for record in records:
        case = record.findings.case
        row = {"patient (simulated)": _words(case.about.name), "verdict": verdict_word(case)}
        for k, unknown in enumerate(_moduli(case.unknowns)):
            short = "E_AL" if k == 0 else "E_PL"
            row[f"{short} truth"] = number(unknown.truth)
            row[f"{short} estimate, 95 %"] = interval_words(unknown) if case.is_stated else "none"
            row[f"{short} without nuisances"] = _other_words(case.without_nuisances, k)
            row[f"{short} paper's filter"] = _other_words(case.as_in_the_paper, k)
        rows.append(row)
    return [*rows, *_guessed2(records, rows[0])]


def _guessed2(records: Sequence[Record[Findings]], like: Mapping[str, str]) -> list[dict[str, str]]:
    """Rows of the generic guess and of the prior alone, with the columns of a patient's."""
    rows: dict[str, dict[str, str]] = {}
    moduli = [row for record in records for row in _moduli(record.findings.case.unknowns)]
    names = list(dict.fromkeys(row.name for row in moduli))
    for one in baselines(moduli):
        row = rows.setdefault(one.what, dict.fromkeys(like, MISSING))
        row["patient (simulated)"] = one.what
        short = "E_AL" if one.row.name == names[0] else "E_PL"
        row[f"{short} estimate, 95 %"] = one.words
    return list(rows.values())


def _other_words(other: ModuliAlone | None, k: int) -> str:
    """What another estimation says of modulus k."""
    if other is None:
        return MISSING
    row = _moduli(other.parameters)[k]
    if row.estimate is None:
        return "none"
    return interval_words(row) + ("" if other.converged else ", not converged")


def _readable3(table: pd.DataFrame) -> list[dict[str, str]]:
    rows = []
    for _, row in table.iterrows():
        frame = row["frame"] + ("" if row["shown to the filter"] else " (not shown)")
        rows.append(
            {
                "patient (simulated)": _words(row["patient"]),
                "verdict": row["verdict"],
                "frame": frame,
                **{f"{which} [mm]": _mean_and_sd(row, which) for which in WHICH},
                "closer": f"{row['closer [%]']:.0f} %",
                "to the truth, each of these [mm]": " / ".join(
                    number(row[f"{which} to the truth [mm]"], 2) for which in WHICH
                ),
                "paper [mm]": MISSING
                if pd.isna(row["paper generic [mm]"])
                else f"{row['paper generic [mm]']:.2f} → {row['paper personalised [mm]']:.2f}",
            }
        )
    return rows


def _mean_and_sd(row: Any, which: str) -> str:
    return f"{row[f'{which} mean [mm]']:.2f} ± {row[f'{which} SD [mm]']:.2f}"


def _words2(table: pd.DataFrame, records: Sequence[Record[Findings]]) -> list[str]:
    """What Table 2 says, in numbers."""
    known = table[table["inside"].notna() & (table["verdict"] != NONE)]
    said = [
        f"The 95 % interval contains the truth for {int(known['inside'].sum())} of {len(known)} "
        "moduli"
    ]
    for words in ("without nuisances", "paper's filter"):
        column = table[f"{words} inside"]
        if column.notna().any():
            said.append(f"{words} for {int(column.sum())} of {int(column.notna().sum())}")
    cases = [record.findings.case for record in records]
    moduli = [row for case in cases if case.is_stated for row in _moduli(case.unknowns)]
    if known.empty:
        return ["No estimation of these patients ended with moduli."]
    relative = (known["95 % high [MPa]"] - known["95 % low [MPa]"]) / known["estimate [MPa]"]
    out = [
        "; ".join(said) + ".",
        *without_estimate(cases),
        skill_words(moduli),
        f"Width of the interval over the estimate: {relative.min():.2f} to {relative.max():.2f}, "
        f"mean {relative.mean():.2f}.",
    ]
    narrow = _narrower(records)
    if narrow:
        out.append("What would narrow it, on average: " + "; ".join(narrow) + ".")
    return out


def verdict_word(case: CaseFindings) -> str:
    """What the verdict on an estimate is, in a word; without one, whether there is an estimate."""
    if not case.is_stated:
        return NONE
    return MISSING if case.verdict is None else case.verdict.trust


def without_estimate(cases: Sequence[CaseFindings]) -> list[str]:
    """A sentence on those whose verdict is that there is no estimate, if there are any."""
    none = [case for case in cases if not case.is_stated]
    if not none:
        return []
    judged = [row.inside for case in none for row in _moduli(case.unknowns)]
    known = [inside for inside in judged if inside is not None]
    return [
        f"For {len(none)} of {len(cases)} the verdict is that there is no estimate "
        f"({', '.join(_words(case.about.name) for case in none)}); they are not counted. (Of the "
        f"{len(known)} intervals that they ended with {sum(known)} contain the truth.)"
    ]


def _narrower(records: Sequence[Record[Findings]]) -> list[str]:
    """By how much intervals would shrink if something were known, the largest share first."""
    ratios: dict[str, list[float]] = {}
    for record in records:
        for row in record.findings.case.narrow:
            what = row.what.partition(", ")[2]
            ratios.setdefault(what, []).append(1.0 - row.std_if_known / row.std_now)
    ordered = sorted(ratios.items(), key=lambda item: -np.mean(item[1]))
    return [f"{what} by {100 * np.mean(values):.0f} %" for what, values in ordered]


def distance_words(table: pd.DataFrame) -> list[str]:
    """What a table of distances (see :func:`table3`) says, in numbers."""
    out: list[str] = []
    if table.empty:
        return out
    for seen, group in table.groupby("shown to the filter", sort=False):
        closer = group["closer [%]"]
        out.append(
            f"{'Frame that the filter was shown' if seen else 'Frame that it was not shown'}: "
            f"personalised closer than generic in {int((closer > 0).sum())} of {len(group)}, by "
            f"{closer.mean():.0f} % on average; "
            f"closer than the generic valve laid rigidly on the closed frame in "
            f"{int((group['personalised mean [mm]'] < group['registered mean [mm]']).sum())}."
        )
    held = table[~table["shown to the filter"].astype(bool)]
    if len(held):
        columns = [f"{which} mean [mm]" for which in WHICH]
        mean = held.groupby("patient", sort=False)[columns].mean()
        own = mean["personalised mean [mm]"]
        patients = int((own < mean["generic mean [mm]"]).sum())
        nearer = int((own < mean["registered mean [mm]"]).sum())
        out.append(
            f"On the mean of the frames that it was not shown: closer than generic for "
            f"{patients} of {len(mean)} patients, than the rigidly laid one for {nearer}."
        )
        by_verdict = [
            f"{verdict} {int((group['closer [%]'] > 0).sum())} of {len(group)}, by "
            f"{group['closer [%]'].mean():.0f} %"
            for verdict, group in held.groupby("verdict")
        ]
        out.append(
            "Of the frames that it was not shown, closer than generic by the verdict on the "
            f"estimate: {'; '.join(by_verdict)} on average."
        )
    columns = [f"{which} to the truth [mm]" for which in WHICH]
    if table[columns].notna().all(axis=None):
        means = ", ".join(
            f"{table[c].mean():.2f} mm {w}" for c, w in zip(columns, WHICH, strict=True)
        )
        out.append(f"Mean distance to where the valve truly was, all frames: {means}.")
    return out


def figure3(fields: Mapping[str, CaseFields], failed: Collection[str] = ()) -> Figure:
    """The closed valves from the atrium, generic beside personalised, on one scale for all.

    Parameters
    ----------
    fields : mapping
        Name of each patient -> its arrays.
    failed : collection of str
        Names of those whose verdict is that there is no estimate, which is written above them.
    """
    distances = []
    for valve in fields.values():
        if valve.distance_generic is None or valve.distance_fitted is None:
            raise InputError("Figure 3 needs the distances of the generic and personalised valves")
        distances += [valve.distance_generic[valve.closed], valve.distance_fitted[valve.closed]]
    top = distance_top(*distances)
    scale = ScalarMappable(Normalize(0.0, top), DISTANCE_MAP)
    columns = len(fields)
    figure = Figure(figsize=(2.6 * columns + 0.6, 5.4), layout="constrained")
    grid = figure.subplots(2, columns, squeeze=False)
    for column, (name, valve) in enumerate(fields.items()):
        k = valve.closed
        shapes = (
            ("generic", valve.generic, valve.distance_generic),
            ("personalised", valve.fitted, valve.distance_fitted),
        )
        drawn = []
        for row, (words, positions, distance) in enumerate(shapes):
            assert positions is not None
            assert distance is not None
            axes = grid[row, column]
            colours = corner_colours(scale, distance[k], valve.triangles)
            draw_valve(axes, valve, positions[k], colours, ATRIUM, k + 1, strength=0.3)
            paint_leak(axes, valve, positions[k], k + 1)
            title = f"{_words(name)}\n" if row == 0 else "NO ESTIMATE\n" * (name in failed)
            axes.set_title(f"{title}{Spread.of(distance[k])} mm", fontsize=9)
            if column == 0:
                axes.text(
                    -0.06, 0.5, words, transform=axes.transAxes, rotation=90, va="center",
                    ha="right", fontsize=11,
                )  # fmt: skip
            drawn.append(positions[k])
        same_scale(list(grid[:, column]), drawn, ATRIUM)
    bar = figure.colorbar(scale, ax=grid, shrink=0.7, pad=0.01, extend="max")
    bar.set_label("distance from the observed closed valve [mm]")
    figure.suptitle(
        "Closed valves of virtual patients (simulated), seen from the atrium", fontsize=11
    )
    return figure


# -- words ----------------------------------------------------------------------------------------
def _moduli(rows: Sequence[UnknownRow]) -> list[UnknownRow]:
    return [row for row in rows if row.is_modulus]


def _patient(record: Record[Findings]) -> str:
    return record.findings.case.about.name


def _words(name: str) -> str:
    return name.replace("_", " ")
