"""Predictions of an estimated valve as tables: every number, and those that a reader asks for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.common.plain import Plain, flat
from experiments.common.record import Record as Run
from mvest.files import write_atomically
from mvest.reporting.figures import save_figure
from mvest.reporting.files import provenance_line
from mvest.reporting.markup import MISSING, markdown_rows, number

__all__ = [
    "SHOWN",
    "coverage",
    "prediction_text",
    "write_prediction",
    "write_prediction_tables",
]

Record = Mapping[str, Any]

SHOWN = {
    "gap_mm2": "regurgitant gap (mm²)",
    "coaptation_length_mm": "coaptation length (mm)",
    "coaptation_area_mm2": "coaptation area (mm²)",
    "coaptation_height_mm": "coaptation height (mm)",
    "tenting_height_mm": "tenting height (mm)",
    "ap_diameter_mm": "AP diameter of the annulus (mm)",
    "annulus_circumference_mm": "circumference of the annulus (mm)",
    "stress_p95_anterior_mpa": "stress, anterior, 95th percentile (MPa)",
    "stress_p99_anterior_mpa": "stress, anterior, 99th percentile (MPa)",
    "stress_max_anterior_mpa": "stress, anterior, largest (MPa)",
    "stress_p95_posterior_mpa": "stress, posterior, 95th percentile (MPa)",
    "stress_p99_posterior_mpa": "stress, posterior, 99th percentile (MPa)",
    "stress_max_posterior_mpa": "stress, posterior, largest (MPa)",
}
"""Measures that the tables show, and what a reader calls them."""

PRESCRIBED = ("ap_diameter_mm", "annulus_circumference_mm")
"""Measures that follow from the prescribed annulus and not from the estimate."""


# -- rows -----------------------------------------------------------------------------------------
def _predicted(record: Record) -> Iterator[tuple[int, str, str, Mapping[str, Any]]]:
    """Seed of the patient, scenario, measure and its numbers."""
    for patient in record["patients"]:
        for scenario, found in patient["scenarios"].items():
            for measure, row in found["measures"].items():
                yield patient["seed"], scenario, measure, row


INTERVALS = {
    "wide": ("wide_low", "wide_high", "truth_own_mesh", "inside_wide"),
    "own": ("low", "high", "truth_own_mesh", "inside_own_mesh"),
    "same": ("low", "high", "truth_same_mesh", "inside_same_mesh"),
}
"""Intervals with and without the mesh's error, the truth they are to hold, and whether they do."""


def coverage(record: Record, measure: str, kind: str) -> tuple[int, int]:
    """How many intervals of a kind (see `INTERVALS`) hold the truth, and of how many.

    Where all samples and the truth are one number (no gap at all) there is no uncertainty that
    could be right or wrong: such an interval is not counted.
    """
    low, high, truth, held = INTERVALS[kind]
    inside = [
        row[held]
        for _, _, name, row in _predicted(record)
        if name == measure and row[held] is not None and not row[low] == row[high] == row[truth]
    ]
    return sum(inside), len(inside)


def _frame(record: Record) -> pd.DataFrame:
    rows = [
        {"patient": seed, "scenario": scenario, "measure": measure, **row}
        for seed, scenario, measure, row in _predicted(record)
    ]
    return pd.DataFrame(rows)


# -- words ----------------------------------------------------------------------------------------
def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return MISSING
    known = row["wide_low"] is not None
    low, high, *_ = INTERVALS["wide" if known else "own"]
    interval = f" [{number(row[low])}, {number(row[high])}]" + ("" if known else "°")
    truth = f", true {number(row['truth_own_mesh'])}"
    return f"{number(row['estimate'])}{interval}{truth}"


def _scenario_table(record: Record) -> str:
    """Measures of the first patient by scenario: estimate, interval and truth."""
    found = record["patients"][0]["scenarios"]
    rows = []
    for measure, label in SHOWN.items():
        row = {"measure": label}
        for name, title in record["scenarios"].items():
            entry = found[name]["measures"].get(measure)
            if entry is not None and measure in PRESCRIBED:
                row[title] = f"{entry['estimate']:.1f}"
            else:
                row[title] = _cell(entry)
        rows.append(row)
    return markdown_rows(rows)


def _moduli_table(record: Record) -> str:
    rows = []
    for patient in record["patients"]:
        row = {"patient": str(patient["seed"])}
        for k, name in enumerate(record["parameters"]):
            if patient["estimate"] is None:
                row[name] = f"none: {patient['reason']}"
                continue
            value, std = patient["estimate"][k], patient["std"][k]
            row[name] = f"{value:.4g} ± {std:.2g}, true {patient['truth'][k]:.4g}"
        rows.append(row)
    return markdown_rows(rows)


HEADS = {
    "wide": "truth inside",
    "own": "without the mesh's error",
    "same": "inside, same mesh",
}


def _uncertainty_table(record: Record) -> str:
    """Standard deviations by sampling and to first order, and how often the truth is inside."""
    scenarios = record["patients"][0]["scenarios"]
    rows = []
    for measure, label in SHOWN.items():
        if measure in PRESCRIBED:
            continue
        row = {"measure": label}
        for name, title in record["scenarios"].items():
            entry = scenarios[name]["measures"].get(measure)
            row[title] = (
                MISSING
                if entry is None
                else f"{number(entry['std'], 2)} / {number(entry['first_order_std'], 2)} / "
                f"{number(entry['mesh_error'], 2)}"
            )
        for kind, head in HEADS.items():
            if kind == "wide" and not record["check_mesh"]:
                continue
            inside, of = coverage(record, measure, kind)
            row[head] = f"{inside} of {of}"
        rows.append(row)
    return markdown_rows(rows)


def _mesh_table(record: Record) -> str:
    rows = []
    for entry in record["stress_meshes"]:
        row = {"cells": " × ".join(map(str, entry["cells"]))}
        if entry["reason"]:
            row |= {"gap (mm²)": f"not closed: {entry['reason']}"}
        else:
            row |= {"gap (mm²)": number(entry["gap_mm2"])}
        for region in ("anterior", "posterior"):
            for which, label in (("p95", "95 %"), ("p99", "99 %"), ("max", "largest")):
                value = entry.get(f"stress_{which}_{region}_mpa")
                row[f"{region} {label} (MPa)"] = number(value)
        rows.append(row)
    return markdown_rows(rows) if rows else "Not computed."


def _failures(record: Record) -> str:
    """Samples without a closed valve, by name; a sentence if there is none."""
    said = []
    attempted = 0
    for patient in record["patients"]:
        if not patient["scenarios"]:
            said.append(f"patient {patient['seed']}: no estimate ({patient['reason']})")
        for name, found in patient["scenarios"].items():
            attempted += found["samples"]
            title = record["scenarios"][name]
            if found["failure"]:
                said.append(f"patient {patient['seed']}, {title}: {found['failure']}")
            if found["failures"]:
                reasons = "; ".join(sorted(set(found["failures"])))
                said.append(
                    f"patient {patient['seed']}, {title}: {len(found['failures'])} of "
                    f"{found['samples']} samples ({reasons})"
                )
            if found["finer_failure"]:
                said.append(
                    f"patient {patient['seed']}, {title}, finer mesh: {found['finer_failure']}"
                )
            if found["truth_failure"]:
                said.append(
                    f"patient {patient['seed']}, {title}, true valve: {found['truth_failure']}"
                )
    if not said:
        return f"All {attempted} samples gave a closed valve."
    return f"Of {attempted} samples, not closed: " + "; ".join(said) + "."


def _totals(record: Record, kind: str) -> str:
    counts = [coverage(record, name, kind) for name in SHOWN if name not in PRESCRIBED]
    inside, of = (sum(column) for column in zip(*counts, strict=True))
    return f"{inside} of {of} ({100 * inside / of:.0f} %)" if of else "none"


def _coverage_words(record: Record) -> str:
    own, same = _totals(record, "own"), _totals(record, "same")
    if not record["check_mesh"]:
        return (
            f"Over all these measures {own} of the intervals hold the truth of its own mesh and "
            f"{same} that of the same mesh; 95 % would be right. The intervals carry the "
            "uncertainty of the estimated parameters and not the error of the mesh."
        )
    cells = " × ".join(map(str, record["check_mesh"]))
    truth = " × ".join(map(str, record["observed"]["truth_cells"]))
    return (
        f"Over all these measures {_totals(record, 'wide')} of the intervals hold the truth of its "
        f"own mesh, {own} without the mesh's error; on the same mesh {same} do. 95 % would be "
        f"right; measures depend on each other, and patients are {len(record['patients'])}. The "
        f"error of the mesh is the difference to one of {cells} cells, at the estimate, taken as a "
        f"standard deviation; the truth's mesh has {truth}."
    )


def _readable(record: Record) -> str:
    seen = record["observed"]
    columns, rows = seen["truth_cells"]
    cells = " × ".join(map(str, record["model"]["cells"][:2]))
    first = record["patients"][0]
    return "\n".join(
        [
            f"Simulated throughout. Each patient's closed valve ({columns} × {rows} cells) is seen "
            f"at {seen['vertices']} vertices with errors of {seen['correlated_mm']:g} mm that are "
            f"alike over {seen['correlation_length_mm']:g} mm; the estimate ({cells} cells) knows "
            "nothing else of it.",
            "",
            _moduli_table(record),
            "",
            f"Patient {first['seed']} under each condition: at the estimate [95 % interval, of the "
            "samples and of the mesh; °: of the samples alone], and the true valve, which was "
            "computed afterwards on its own mesh.",
            "",
            _scenario_table(record),
            "",
            "Standard deviation of the samples / to first order (derivative of the closed shape) / "
            f"error of the mesh, of the same patient; and how many intervals of all "
            f"{len(record['patients'])} patients and conditions hold the truth: computed on its "
            "own mesh, by intervals with and without the mesh's error, and on the mesh of the "
            "estimate, where only the uncertainty of the parameters is left. Intervals in which "
            "all samples and the truth are the same number are not counted.",
            "",
            _uncertainty_table(record),
            "",
            _coverage_words(record),
            "",
            "Peak stress of the first patient as observed, with its true parameters, by mesh: the "
            "largest value belongs to insertions of chordae and to the hinge.",
            "",
            _mesh_table(record),
            "",
            _failures(record),
            "",
            f"The regurgitant gap is the {record['measures']['gap_mm2'].partition(': ')[2]} "
            f"(reach {record['reach_mm']:.2f} mm). A higher pressure acts on leaflets, annulus and "
            "papillary tips that stay where they are prescribed; a ventricle that dilates with it "
            "is not part of the model.",
        ]
    )


def prediction_text(record: Record) -> str:
    """The tables for the terminal."""
    return _readable(record) if record["measures"] else f"no prediction: {record['reason']}"


# -- files ----------------------------------------------------------------------------------------
def write_prediction_tables(folder: Path, record: Record) -> list[Path]:
    """``prediction.csv`` (every patient, condition and measure) and ``prediction.md``.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    line = provenance_line(record)
    table = _frame(record).to_csv(index=False, float_format="%.6g")
    text = f"# {record['title']}\n\n{prediction_text(record)}\n\n<sub>{line}</sub>\n"
    return [
        write_atomically(folder / "prediction.csv", table),
        write_atomically(folder / "prediction.md", text),
    ]


def write_prediction(
    folder: Path, records: Mapping[str, Run[Plain]], arrays: Mapping[str, Path]
) -> list[Path]:
    """Tables of each run, and its figure where its valves are still there."""
    from experiments.studies.prediction.figure import prediction_figure

    written = []
    for name, run in records.items():
        record = flat(run)
        written += write_prediction_tables(folder, record)
        if name in arrays:
            figure = prediction_figure(record, arrays[name])
            written += save_figure(folder / "prediction", figure, record)
    return written
