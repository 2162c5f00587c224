"""Is the closed state one? The valve closed under every variation of the gate."""

from __future__ import annotations

import sys

import numpy as np

from experiments.common.build import closure_model
from experiments.common.forward import outcome_of
from experiments.common.record import Outcome
from experiments.common.report import answer_of_main, write_each
from experiments.common.study import Job, Section, Study
from experiments.studies.gate.findings import Findings, Limits, Row
from experiments.studies.gate.report import gate_answer, gate_table, gate_words
from experiments.studies.gate.settings import Settings
from mvest.closure.robustness import MAX_LIMIT, MEAN_LIMIT, SLOPE_LIMIT, GateRow, run_gate

__all__ = ["STUDY", "run_gate_study"]


def run_gate_study(job: Job[Settings]) -> Outcome[Findings]:
    """Close the valve under every variation of the gate."""
    values = job.values
    report = run_gate(
        lambda case: closure_model(values, case),
        np.array(values["truth"]["values"], dtype=float),
        on_case=_say,
    )
    rows = tuple(Row.of(row) for row in report.rows)
    findings = Findings(
        passed=report.passed,
        rows=rows,
        slopes={str(step): difference for step, difference in report.slopes.items()},
        limits=Limits(MEAN_LIMIT, MAX_LIMIT, SLOPE_LIMIT),
    )
    reference = rows[0]
    return outcome_of(
        findings,
        closure_model(values).mesh,
        len(rows),
        () if reference.passed else (reference.reason,),
    )


def _say(row: GateRow) -> None:
    print(
        f"{row.case}: mean {row.mean_mm:.3g} mm, max {row.max_mm:.3g} mm, "
        f"{row.seconds:.0f} s, {row.reason}",
        file=sys.stderr,
        flush=True,
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_gate_study,
    words=lambda record: gate_words(record).replace("**", ""),
    write=write_each(gate_table, gate_words),
    sections=(Section("gate", validation=True, answer=answer_of_main(gate_answer)),),
)
