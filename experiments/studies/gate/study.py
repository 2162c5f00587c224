"""Is the closed state one? A valve closed under every variation of the gate."""

from __future__ import annotations

import sys

import numpy as np

from experiments.common.building.closure import closure_model
from experiments.common.building.gate import anatomy_digest
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.study import Job, Section, Study
from experiments.studies.gate.findings import Findings, Followed, Limits, Row
from experiments.studies.gate.report import gate_answer, gate_words, write_gate
from experiments.studies.gate.settings import Settings
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import MAX_LIMIT, MEAN_LIMIT, GateRow, run_gate
from mvest.closure.smoothness import JUMP_LIMIT, SEEN, SIDE_LIMIT, SLOPE_LIMIT, Path
from mvest.scenarios.measures import contact_reach
from mvest.scenarios.scenario import plane_of
from mvest.typing import FloatArray
from mvest.valve.measure.gap import find_gap
from mvest.valve.measure.passing_ball import largest_passing_ball

__all__ = ["STUDY", "run_gate_study"]


def run_gate_study(job: Job[Settings]) -> Outcome[Findings]:
    """Close the valve under every variation of the gate, and measure what stays open of it."""
    values = job.values
    report = run_gate(
        lambda case: closure_model(values, case),
        np.array(values["truth"]["values"], dtype=float),
        on_case=_say,
        on_path=_say_path,
    )
    rows = tuple(map(Row.of, report.rows))
    model = closure_model(values)
    gap, ball = (None, None) if report.closed is None else _open(model, report.closed)
    findings = Findings(
        anatomy=anatomy_digest(values),
        passed=report.passed,
        gap_mm2=gap,
        passing_ball_mm=ball,
        rows=rows,
        paths=tuple(map(Followed.of, report.paths)),
        limits=Limits(MEAN_LIMIT, MAX_LIMIT, JUMP_LIMIT, SEEN, SLOPE_LIMIT, SIDE_LIMIT),
    )
    reference = rows[0]
    return outcome_of(
        findings,
        model.mesh,
        len(rows) + sum(path.closures for path in report.paths),
        () if reference.passed else (reference.reason,),
    )


def _open(model: ClosureModel, vertices: FloatArray) -> tuple[float, float]:
    """The gap (mm²) of a closed valve, and the diameter (mm) of the largest ball that passes."""
    surface = model.valve.surface
    annulus = vertices[model.valve.annulus]
    seen = vertices, surface.triangles, annulus, plane_of(model.valve, annulus)
    gap = find_gap(*seen, contact_reach(model))
    return gap.area, largest_passing_ball(*seen, thickness=surface.thickness).diameter


def _say(row: GateRow) -> None:
    print(
        f"{row.case}: mean {row.mean_mm:.3g} mm, max {row.max_mm:.3g} mm, "
        f"{row.seconds:.0f} s, {row.reason}",
        file=sys.stderr,
        flush=True,
    )


def _say_path(path: Path) -> None:
    verdict = path.reason or "no jump"
    print(f"along {path.name}: {path.closures} closures, {verdict}", file=sys.stderr, flush=True)


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_gate_study,
    words=lambda record: gate_words({record.row: record}).replace("**", ""),
    write=write_gate,
    keeps_failures=True,
    sections=(Section("gate", validation=True, answer=gate_answer),),
)
