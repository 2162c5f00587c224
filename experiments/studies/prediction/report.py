"""Predictions of an estimated valve as tables: every number, and those that a reader asks for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Literal

import pandas as pd

from experiments.common.records.record import Record
from experiments.common.records.report import write_drawn
from experiments.studies.prediction.figure import prediction_figure
from experiments.studies.prediction.findings import Findings, Predicted
from mvest.reporting.markup import MISSING, markdown_rows, number

__all__ = [
    "SHOWN",
    "coverage",
    "prediction_answer",
    "prediction_table",
    "prediction_words",
    "write_prediction",
]

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
def _predicted(findings: Findings) -> Iterator[tuple[int, str, str, Predicted]]:
    """Seed of the patient, scenario, measure and its numbers."""
    for patient in findings.patients:
        for scenario, predicted in patient.scenarios.items():
            for measure, row in predicted.measures.items():
                yield patient.seed, scenario, measure, row


Kind = Literal["wide", "own", "same"]
"""Of an interval: with the mesh's error, and without it on the truth's and on the same mesh."""


def coverage(findings: Findings, measure: str, kind: Kind) -> tuple[int, int]:
    """How many intervals of a kind hold the truth, and of how many.

    Where all samples and the truth are one number (no gap at all) there is no uncertainty that
    could be right or wrong: such an interval is not counted.
    """
    inside = []
    for _, _, name, row in _predicted(findings):
        if name != measure:
            continue
        low, high, truth, held = {
            "wide": (row.wide_low, row.wide_high, row.truth_own_mesh, row.inside_wide),
            "own": (row.low, row.high, row.truth_own_mesh, row.inside_own_mesh),
            "same": (row.low, row.high, row.truth_same_mesh, row.inside_same_mesh),
        }[kind]
        if held is not None and not low == high == truth:
            inside.append(held)
    return sum(inside), len(inside)


def prediction_table(findings: Findings) -> pd.DataFrame:
    """Every patient, condition and measure."""
    return pd.DataFrame(
        {"patient": seed, "scenario": scenario, "measure": measure, **asdict(row)}
        for seed, scenario, measure, row in _predicted(findings)
    )


# -- words ----------------------------------------------------------------------------------------
def _cell(row: Predicted | None) -> str:
    if row is None:
        return MISSING
    known = row.wide_low is not None
    low, high = (row.wide_low, row.wide_high) if known else (row.low, row.high)
    interval = f" [{number(low)}, {number(high)}]" + ("" if known else "°")
    return f"{number(row.estimate)}{interval}, true {number(row.truth_own_mesh)}"


def _scenario_table(findings: Findings) -> str:
    """Measures of the first patient by scenario: estimate, interval and truth."""
    scenarios = findings.patients[0].scenarios
    rows = []
    for measure, label in SHOWN.items():
        row = {"measure": label}
        for name, title in findings.scenarios.items():
            entry = scenarios[name].measures.get(measure)
            if entry is not None and measure in PRESCRIBED:
                row[title] = f"{entry.estimate:.1f}"
            else:
                row[title] = _cell(entry)
        rows.append(row)
    return markdown_rows(rows)


def _moduli_table(record: Record[Findings]) -> str:
    rows = []
    for patient in record.findings.patients:
        row = {"patient": str(patient.seed)}
        for k, name in enumerate(record.parameters):
            if patient.estimate is None or patient.std is None:
                row[name] = f"none: {patient.reason}"
                continue
            value, std = patient.estimate[k], patient.std[k]
            row[name] = f"{value:.4g} ± {std:.2g}, true {patient.truth[k]:.4g}"
        rows.append(row)
    return markdown_rows(rows)


HEADS: dict[Kind, str] = {
    "wide": "truth inside",
    "own": "without the mesh's error",
    "same": "inside, same mesh",
}


def _uncertainty_table(findings: Findings) -> str:
    """Standard deviations by sampling and to first order, and how often the truth is inside."""
    scenarios = findings.patients[0].scenarios
    rows = []
    for measure, label in SHOWN.items():
        if measure in PRESCRIBED:
            continue
        row = {"measure": label}
        for name, title in findings.scenarios.items():
            entry = scenarios[name].measures.get(measure)
            row[title] = (
                MISSING
                if entry is None
                else f"{number(entry.std, 2)} / {number(entry.first_order_std, 2)} / "
                f"{number(entry.mesh_error, 2)}"
            )
        for kind, head in HEADS.items():
            if kind == "wide" and not findings.check_mesh:
                continue
            inside, of = coverage(findings, measure, kind)
            row[head] = f"{inside} of {of}"
        rows.append(row)
    return markdown_rows(rows)


def _mesh_table(findings: Findings) -> str:
    rows = []
    for entry in findings.stress_meshes:
        gap = f"not closed: {entry.reason}" if entry.reason else number(entry.gap_mm2)
        row = {"cells": " × ".join(map(str, entry.cells)), "gap (mm²)": gap}
        for region in ("anterior", "posterior"):
            for which, label in (("p95", "95 %"), ("p99", "99 %"), ("max", "largest")):
                value = entry.stress.get(f"stress_{which}_{region}_mpa")
                row[f"{region} {label} (MPa)"] = number(value)
        rows.append(row)
    return markdown_rows(rows) if rows else "Not computed."


def _failures(findings: Findings) -> str:
    """Samples without a closed valve, by name; a sentence if there is none."""
    said = []
    attempted = 0
    for patient in findings.patients:
        if not patient.scenarios:
            said.append(f"patient {patient.seed}: no estimate ({patient.reason})")
        for name, scenario in patient.scenarios.items():
            attempted += scenario.samples
            where = f"patient {patient.seed}, {findings.scenarios[name]}"
            if scenario.failure:
                said.append(f"{where}: {scenario.failure}")
            if scenario.failures:
                reasons = "; ".join(sorted(set(scenario.failures)))
                count = f"{len(scenario.failures)} of {scenario.samples}"
                said.append(f"{where}: {count} samples ({reasons})")
            if scenario.finer_failure:
                said.append(f"{where}, finer mesh: {scenario.finer_failure}")
            if scenario.truth_failure:
                said.append(f"{where}, true valve: {scenario.truth_failure}")
    if not said:
        return f"All {attempted} samples gave a closed valve."
    return f"Of {attempted} samples, not closed: " + "; ".join(said) + "."


def _totals(findings: Findings, kind: Kind) -> str:
    counts = [coverage(findings, name, kind) for name in SHOWN if name not in PRESCRIBED]
    inside, of = (sum(column) for column in zip(*counts, strict=True))
    return f"{inside} of {of} ({100 * inside / of:.0f} %)" if of else "none"


def _coverage_words(findings: Findings) -> str:
    own, same = _totals(findings, "own"), _totals(findings, "same")
    if not findings.check_mesh:
        return (
            f"Over all these measures {own} of the intervals hold the truth of its own mesh and "
            f"{same} that of the same mesh; 95 % would be right. The intervals carry the "
            "uncertainty of the estimated parameters and not the error of the mesh."
        )
    cells = " × ".join(map(str, findings.check_mesh))
    truth = " × ".join(map(str, findings.observed.truth_cells))
    return (
        f"Over all these measures {_totals(findings, 'wide')} of the intervals hold the truth of "
        f"its own mesh, {own} without the mesh's error; on the same mesh {same} do. 95 % would be "
        f"right; measures depend on each other, and patients are {len(findings.patients)}. The "
        f"error of the mesh is the difference to one of {cells} cells, at the estimate, taken as a "
        f"standard deviation; the truth's mesh has {truth}."
    )


def prediction_words(record: Record[Findings]) -> str:
    """The tables for readers, and what they say."""
    findings = record.findings
    if not findings.measures:
        return f"no prediction: {record.reason}"
    seen, first = findings.observed, findings.patients[0]
    columns, rows = seen.truth_cells
    assert record.model is not None
    cells = " × ".join(map(str, record.model.cells[:2]))
    return "\n".join(
        [
            f"Simulated throughout. Each patient's closed valve ({columns} × {rows} cells) is seen "
            f"at {seen.vertices} vertices with errors of {seen.correlated_mm:g} mm that are "
            f"alike over {seen.correlation_length_mm:g} mm; the estimate ({cells} cells) knows "
            "nothing else of it.",
            "",
            _moduli_table(record),
            "",
            f"Patient {first.seed} under each condition: at the estimate [95 % interval, of the "
            "samples and of the mesh; °: of the samples alone], and the true valve, which was "
            "computed afterwards on its own mesh.",
            "",
            _scenario_table(findings),
            "",
            "Standard deviation of the samples / to first order (derivative of the closed shape) / "
            f"error of the mesh, of the same patient; and how many intervals of all "
            f"{len(findings.patients)} patients and conditions hold the truth: computed on its "
            "own mesh, by intervals with and without the mesh's error, and on the mesh of the "
            "estimate, where only the uncertainty of the parameters is left. Intervals in which "
            "all samples and the truth are the same number are not counted.",
            "",
            _uncertainty_table(findings),
            "",
            _coverage_words(findings),
            "",
            "Peak stress of the first patient as observed, with its true parameters, by mesh: the "
            "largest value belongs to insertions of chordae and to the hinge.",
            "",
            _mesh_table(findings),
            "",
            _failures(findings),
            "",
            f"The regurgitant gap is the {findings.measures['gap_mm2'].partition(': ')[2]} "
            f"(reach {findings.reach_mm:.2f} mm). A higher pressure acts on leaflets, annulus and "
            "papillary tips that stay where they are prescribed; a ventricle that dilates with it "
            "is not part of the model.",
        ]
    )


def prediction_answer(record: Record[Findings]) -> str:
    """How often predictions hold the truth."""
    findings = record.findings
    return (
        f"Of intervals predicted for an estimated valve under changed conditions "
        f"{_totals(findings, 'own')} hold the simulated truth, "
        f"{_totals(findings, 'wide')} with the mesh's error."
    )


write_prediction = write_drawn(
    lambda record: prediction_table(record.findings),
    prediction_words,
    lambda record, fields: prediction_figure(record.findings, fields),
)
"""Tables of each run, and its figure where its valves are still there."""
