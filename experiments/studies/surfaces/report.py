"""Moduli by how the geometry arrived: table, words and figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from experiments.common.cases.report import interval_words
from experiments.common.cases.skill import GENERIC, PRIOR, baselines, median_errors, prior_alone
from experiments.common.records.record import Record
from experiments.common.records.report import cautions, provenance_of
from experiments.common.records.tables import write_table
from experiments.studies.surfaces.findings import Findings
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, Ground, Trust
from mvest.reporting.case.findings import UnknownRow
from mvest.reporting.figures import save_figure_with
from mvest.reporting.markup import MISSING, number

__all__ = ["surfaces_answer", "surfaces_frame", "surfaces_words", "write_surfaces"]

KINDS = ("vertices", "surfaces", "slicerheart", "labels")
"""Of doors, in the order of tables."""
NOTE = (
    "Simulated. Errors of surfaces are root mean squares of distances from and to the true "
    "midsurface, those of the thickness mean and root mean square. An interval that does not hold "
    "the truth has a cross; a modulus whose verdict is *none* is in brackets and is not counted."
)
COLOURS = {TRUSTWORTHY: "#2b6ca3", DOUBTFUL: "#d08a2e", NONE: "#a9a9a9"}


def surfaces_frame(records: Sequence[Record[Findings]]) -> pd.DataFrame:
    """One row for each patient, door and modulus."""
    rows = []
    for record in _in_order(records):
        found = record.findings
        for row in found.moduli:
            before = prior_alone(row)
            rows.append(
                {
                    "patient": found.patient,
                    "geometry": found.door,
                    "open surface, there [mm]": found.opened.there_mm,
                    "open surface, back [mm]": found.opened.back_mm,
                    "open surface, largest [mm]": found.opened.largest_mm,
                    "closed surface, there [mm]": found.closed.there_mm,
                    "closed surface, back [mm]": found.closed.back_mm,
                    "closed surface, largest [mm]": found.closed.largest_mm,
                    "thickness, mean error [mm]": found.thickness.mean_mm,
                    "thickness, rms error [mm]": found.thickness.rms_mm,
                    "modulus": row.name,
                    "truth [MPa]": row.truth,
                    "estimate [MPa]": row.estimate,
                    "95 % low [MPa]": row.low,
                    "95 % high [MPa]": row.high,
                    "inside": row.inside,
                    f"{GENERIC} [MPa]": row.prior_mean,
                    f"{PRIOR} 95 % low [MPa]": before.low,
                    f"{PRIOR} 95 % high [MPa]": before.high,
                    f"inside, {PRIOR}": before.inside,
                    "check of the posterior": found.posterior and found.posterior.value,
                    "its limit": found.posterior and found.posterior.limit,
                    "verdict": _trust(found),
                    "grounds": "; ".join(f"{g.check}: {g.text}" for g in _grounds(found)),
                    "ended": found.reason,
                    "CPU [s]": found.cpu_s,
                }
            )
    return pd.DataFrame(rows)


def write_surfaces(
    folder: Path, records: Mapping[str, Record[Findings]], _arrays: Mapping[str, Path]
) -> list[Path]:
    """``surfaces.*`` from all runs that there are."""
    kept = _in_order(list(records.values()))
    base = folder / "surfaces"
    notes = [*cautions(kept), NOTE, *_door_words(kept), *_ground_words(kept)]
    table = surfaces_frame(kept)
    written = write_table(base, table, _readable(kept), provenance_of(kept), notes)
    return [*written, *save_figure_with(base, surfaces_figure(kept), kept[0].line)]


def surfaces_words(record: Record[Findings]) -> str:
    """What one run found, for the terminal."""
    found = record.findings
    lines = [
        f"{found.patient}, {found.door}: {_trust(found)} ({found.reason})",
        f"  surfaces off by {_surface_words(found)} mm (open, closed), thickness by "
        f"{_thickness_words(found)} mm",
        *(f"  {row.label}: {interval_words(row)} (truth {number(row.truth)})"
          for row in found.moduli),
        *(f"  {ground.check}: {ground.text}" for ground in _grounds(found)),
    ]  # fmt: skip
    return "\n".join(lines)


def surfaces_answer(records: Mapping[str, Record[Findings]]) -> str:
    """What became of the moduli by each door, in one line."""
    kept = _in_order(list(records.values()))
    patients = len({record.findings.patient for record in kept})
    return f"{patients} simulated patients. " + " ".join(_door_words(kept))


def surfaces_figure(records: Sequence[Record[Findings]]) -> Figure:
    """Estimates over their truths with intervals, one panel a leaflet, coloured by verdict."""
    kept = _in_order(records)
    doors = list(dict.fromkeys(record.findings.door for record in kept))
    patients = sorted({record.findings.patient for record in kept})
    names = list(dict.fromkeys(row.name for record in kept for row in record.findings.moduli))
    size = (4.4 * len(names) + 1.6, 0.6 * len(doors) + 1.6)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, names, strict=True):
        for record in kept:
            found = record.findings
            (row,) = [one for one in found.moduli if one.name == name]
            share = (patients.index(found.patient) + 0.5) / len(patients) - 0.5
            at = doors.index(found.door) + 0.7 * share
            assert row.truth is not None
            axes.plot(row.prior_mean / row.truth, at, "|", color="0.5", ms=8, zorder=1)
            if row.estimate is None or row.low is None or row.high is None:
                axes.text(1.0, at, "no estimate", fontsize=7, ha="center", va="center")
                continue
            colour = COLOURS[_trust(found)]
            axes.plot([row.low / row.truth, row.high / row.truth], [at, at], color=colour, lw=1.3)
            fill = "white" if _trust(found) == NONE else colour
            axes.plot(row.estimate / row.truth, at, "o", color=colour, mfc=fill, ms=4)
        axes.axvline(1.0, color="0.3", lw=0.8, zorder=0)
        axes.set_xscale("log")
        axes.set_xticks([0.5, 0.7, 1.0, 1.5, 2.0], labels=["0.5", "0.7", "1", "1.5", "2"])
        axes.minorticks_off()
        axes.set_xlabel(f"{name.replace('E_f.', 'E_f ')}, estimate / truth")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_yticks(range(len(doors)), labels=doors)
    panels[0].invert_yaxis()
    for word, colour in COLOURS.items():
        panels[-1].plot([], [], "o-", color=colour, ms=4, lw=1.3, label=word)
    panels[-1].plot([], [], "|", color="0.5", ms=8, label=GENERIC)
    panels[-1].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return figure


def _readable(records: Sequence[Record[Findings]]) -> list[dict[str, str]]:
    rows = []
    for record in records:
        found = record.findings
        row = {
            "patient (simulated)": found.patient.replace("_", " "),
            "geometry": found.door,
            "open / closed off (mm)": _surface_words(found),
            "thickness off (mm)": _thickness_words(found),
        }
        for one in found.moduli:
            short = "E_AL" if one.leaflet == "anterior" else "E_PL"
            words = interval_words(one)
            row[f"{short} truth"] = number(one.truth)
            row[f"{short} estimate, 95 %"] = f"({words})" if _trust(found) == NONE else words
            row[f"{short} error"] = _error_words(one)
        check = found.posterior
        row["check of the posterior (limit)"] = (
            MISSING if check is None else f"{number(check.value, 2)} ({check.limit:g})"
        )
        row["verdict"] = _trust(found)
        row["CPU (s)"] = f"{found.cpu_s:.0f}"
        rows.append(row)
    like = rows[0]
    for what in (GENERIC, PRIOR):
        row = dict.fromkeys(like, MISSING) | {"patient (simulated)": what}
        for guess in baselines(_one_of_each_patient(records)):
            if guess.what == what:
                short = "E_AL" if guess.row.leaflet == "anterior" else "E_PL"
                row[f"{short} estimate, 95 %"] = guess.words
        rows.append(row)
    return rows


def _door_words(records: Sequence[Record[Findings]]) -> list[str]:
    """A sentence on each door."""
    out = []
    for door in dict.fromkeys(record.findings.door for record in records):
        runs = [record.findings for record in records if record.findings.door == door]
        stated = [row for found in runs if _trust(found) != NONE for row in found.moduli]
        counts = ", ".join(
            f"{n} {trust}"
            for trust in (TRUSTWORTHY, DOUBTFUL, NONE)
            if (n := sum(_trust(found) == trust for found in runs))
        )
        text = f"{door[0].upper()}{door[1:]}: {counts}"
        errors = median_errors(stated)
        if errors:
            inside = sum(row.inside is True for row in stated)
            text += (
                f"; {inside} of {len(stated)} moduli inside, median error {100 * errors[0]:.0f} % "
                f"({GENERIC} {100 * errors[1]:.0f} %)"
            )
        out.append(f"{text}.")
    return out


def _ground_words(records: Sequence[Record[Findings]]) -> list[str]:
    """Why estimates are not trusted, one sentence for each of them."""
    return [
        f"{record.findings.patient.replace('_', ' ')}, {record.findings.door}: "
        f"{_trust(record.findings)}, since "
        + "; ".join(ground.text for ground in _grounds(record.findings))
        + "."
        for record in records
        if _grounds(record.findings)
    ]


def _one_of_each_patient(records: Sequence[Record[Findings]]) -> list[UnknownRow]:
    first = {record.findings.patient: record.findings.moduli for record in reversed(records)}
    return [row for moduli in first.values() for row in moduli]


def _in_order(records: Sequence[Record[Findings]]) -> list[Record[Findings]]:
    def place(record: Record[Findings]) -> tuple[str, int, str]:
        found = record.findings
        return found.patient, KINDS.index(found.kind), found.door

    return sorted(records, key=place)


def _trust(found: Findings) -> Trust:
    return NONE if found.verdict is None else found.verdict.trust


def _grounds(found: Findings) -> tuple[Ground, ...]:
    return () if found.verdict is None else found.verdict.grounds


def _surface_words(found: Findings) -> str:
    return " / ".join(
        f"{(0.5 * (one.there_mm**2 + one.back_mm**2)) ** 0.5:.2f}"
        for one in (found.opened, found.closed)
    )


def _thickness_words(found: Findings) -> str:
    return f"{found.thickness.mean_mm:+.2f} ({found.thickness.rms_mm:.2f})"


def _error_words(row: UnknownRow) -> str:
    if row.estimate is None or row.truth is None:
        return MISSING
    return f"{100 * (row.estimate / row.truth - 1):+.0f} %"
