"""The gate asked of a case, whether the closed valve that its moduli are fitted to is one state."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvest.cases.case import ValveCase
from mvest.closure.robustness import GATE_CASES, GateReport, run_gate, vary
from mvest.personalisation.model import build_model
from mvest.personalisation.settings import PersonaliseSettings


def gate_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    store: Path | None = None,
) -> GateReport:
    """Ask whether the closed state of a case is one, with the prior means of its unknowns.

    Variations that need another mesh or other contact samples are left out: those of a case are as
    its surface gives them.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    store : Path, optional
        Where an unstructured mesh is kept.

    Raises
    ------
    MvestError
        If the case is not in order.
    """
    model = build_model(case, settings, store)
    means = {unknown.name: unknown.mean for unknown in settings.unknowns}
    kept = [
        each
        for each in GATE_CASES
        if not each.remeshed and (model.guide is not None or not each.guided)
    ]
    at = np.array([means[name] for name in model.names])
    return run_gate(lambda variation: vary(model, variation), at, kept)


def gate_lines(report: GateReport) -> list[str]:
    """What a gate's report comes to, in lines: the verdict, and what it fails by."""
    largest = np.nanmax([row.max_mm for row in report.rows])
    verdict = "passed" if report.passed else "NOT passed: the closed state is not one"
    lines = [
        f"  gate {verdict}; {len(report.rows) - 1} variations, {largest:.2g} mm at most, and "
        f"{len(report.paths)} ways along the moduli"
    ]
    for row in report.rows:
        if not row.passed:
            lines.append(f"  gate: {row.case}: {row.max_mm:.2g} mm off, {row.reason}")
    lines += [f"  gate: along {path.name}: {path.reason}" for path in report.paths if path.reason]
    return lines
