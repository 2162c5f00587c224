"""The gate of an anatomy (`mvest.closure.robustness`): what to ask, rows of it, kept verdicts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.closure import closure_model
from experiments.common.places import GATE_RECORDS
from experiments.common.progress import say
from experiments.common.records.record import FAILED_GATE, NOT_GATED, PASSED_GATE
from experiments.common.schema import Values, build
from mvest.closure.anchors import content_digest
from mvest.closure.robustness import GATE_CASES, GateReport, run_gate
from mvest.reporting.tables import Table, table
from mvest.valve.anatomy.dimensions import TemplateParameters


def ask_gate(values: Values) -> GateReport:
    """Close the configured anatomy with its true moduli under variations that must not matter.

    Each result is printed to standard error as soon as it is known.
    """
    return run_gate(
        lambda case: closure_model(values, case),
        np.array(values["truth"]["values"], dtype=float),
        GATE_CASES,
        on_case=lambda row: say(f"{row.case}: max {row.max_mm:.3g} mm, {row.reason}"),
        on_path=lambda path: say(f"along {path.name}: {path.reason or 'no jump'}"),
    )


def closures_of(report: GateReport) -> int:
    """How many closures a report took."""
    return len(report.rows) + sum(path.closures for path in report.paths)


def gate_rows(report: GateReport) -> Table:
    """A row for each variation, and for each path along moduli (``along E_f``).

    The largest distance of a path is what the derivatives do not explain at any one vertex; of it
    there is also the share of the whole way.
    """
    rows = [
        {"variation": r.case, "mean": r.mean_mm, "max": r.max_mm, "passed": r.passed}
        | {"reason": r.reason}
        for r in report.rows
    ]
    paths = [
        {
            "variation": f"along {path.name}",
            "max": max((piece.unexplained_mm for piece in path.pieces), default=None),
            "share": path.share if path.pieces else None,
            "passed": path.passed,
            "reason": path.reason,
        }
        for path in report.paths
    ]
    return table([*rows, *paths], **{"variation": "", "mean": "mm:.2g", "max": "mm:.2g"})


def anatomy_digest(values: Mapping[str, Any]) -> str:
    """SHA-256 of the configured anatomy, whatever its file is called."""
    given = values["valve"]
    if given.get("folder") is not None:
        return content_digest(given["folder_sha256"] or "", given["annulus_contraction"])
    return content_digest(build(TemplateParameters, values["valve"]))


def gate_of(values: Mapping[str, Any], records: Path = GATE_RECORDS) -> str:
    """The verdict on the configured anatomy and the mesh it was reached on, or `NOT_GATED`.

    Parameters
    ----------
    values : mapping
        The resolved configuration.
    records : Path
        The gate's kept records, one a line.
    """
    return _verdicts(records).get(anatomy_digest(values), NOT_GATED)


@cache
def _verdicts(records: Path) -> dict[str, str]:
    """Digest of an anatomy -> the gate's verdict; a damaged record has none."""
    found: dict[str, str] = {}
    for line in records.read_bytes().splitlines() if records.is_file() else ():
        try:
            record = json.loads(line)["record"]
            cells, element = record["model"]["cells"], record["model"]["element"]
            passed = PASSED_GATE if record["numbers"]["passed"] is True else FAILED_GATE
            found[str(record["numbers"]["anatomy"])] = (
                f"{passed} on {cells[0]} x {cells[1]} {element}"
            )
        except (ValueError, KeyError, TypeError, IndexError):
            continue
    return found
