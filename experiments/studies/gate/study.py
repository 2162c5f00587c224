"""Is the closed state one? The valve closed under every variation of the gate."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import closure_model
from experiments.common.forward import forward_record, without_nan
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.study import Section, Study
from experiments.studies.gate.report import gate_text, write_gate_tables
from experiments.studies.gate.settings import Settings
from mvest.closure.robustness import MAX_LIMIT, MEAN_LIMIT, SLOPE_LIMIT, GateRow, run_gate

__all__ = ["STUDY", "run_gate_study"]

Values = Mapping[str, Any]
Outcome = tuple[dict[str, Any], list[Path]]


def run_gate_study(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Close the valve under every variation of the gate."""

    def tell(row: GateRow) -> None:
        print(
            f"{row.case}: mean {row.mean_mm:.3g} mm, max {row.max_mm:.3g} mm, "
            f"{row.seconds:.0f} s, {row.reason}",
            file=sys.stderr,
            flush=True,
        )

    values = np.array(config["truth"]["values"], dtype=float)
    reference = closure_model(config)
    report = run_gate(lambda case: closure_model(config, case), values, on_case=tell)
    rows = [without_nan(asdict(row)) for row in report.rows]
    record = forward_record(config, config_hash, reference, values, started, len(rows))
    record |= {
        "passed": report.passed,
        "rows": rows,
        "slopes": {str(step): value for step, value in report.slopes.items()},
        "limits": {"mean_mm": MEAN_LIMIT, "max_mm": MAX_LIMIT, "slope": SLOPE_LIMIT},
    }
    if not rows[0]["passed"]:
        record |= {"status": "failed", "reason": rows[0]["reason"]}
    return record, []


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_gate_study),
    words=lambda record: gate_text(flat(record)),
    write=each(write_gate_tables),
    sections=(Section("gate", validation=True),),
)
