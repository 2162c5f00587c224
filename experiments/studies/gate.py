"""Closes a valve and tests whether its closed state is unique.

The gate closes an anatomy under variations that must not matter, and follows it along its moduli
(`mvest.closure.robustness`). With ``gate.every_step`` it measures one closure step by step instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.common.building.closure import closure_model
from experiments.common.building.gate import (
    anatomy_digest,
    close_valve,
    closed_tables,
    draw_closing,
    gate_of,
    gate_report,
    gate_rows,
    truth_of,
)
from experiments.common.records.record import Mesh
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.reporting.tables import Column, Table, joined, table
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class GateSettings:
    """Selects the test."""

    every_step: bool = False  # measure one closure step by step, without the gate


def run(job: Job[GateSettings]) -> Result:
    """Measure one closure, or run the gate."""
    return _closing(job) if job.settings.every_step else _gate(job)


def _gate(job: Job[GateSettings]) -> Result:
    values = job.values
    report = gate_report(values)
    model, truth = closure_model(values), truth_of(values)
    reference, closures = report.rows[0], report.closures
    closed = closed_tables(model, model.close(truth, sensitivities=False), truth)
    verdict = {"passed": report.passed, "closures": closures}
    return Result(
        tables={"": table([verdict], passed=""), "variations": gate_rows(report), **closed},
        # Other studies find the verdict by these.
        numbers={"anatomy": anatomy_digest(values), "passed": report.passed},
        status="converged" if reference.passed else "failed",
        reason="completed" if reference.passed else reference.reason,
        mesh=Mesh.of(model.mesh),
        forward_solves=closures,
    )


def _closing(job: Job[GateSettings]) -> Result:
    closing = close_valve(job.values)
    simulation = closing.result.simulation
    return Result(
        tables={
            "": closing.steps(),
            **closed_tables(closing.model, closing.result, truth_of(job.values)),
        },
        numbers={
            "contact_distance_mm": closing.contact_distance_mm,
            "ends_at_rest": closing.model.settings.protocol.equilibrium and simulation.converged,
        },
        arrays=closing.arrays(),
        status="converged" if simulation.converged else "failed",
        reason="completed" if simulation.converged else simulation.reason.value,
        mesh=Mesh.of(closing.model.mesh),
        forward_solves=1,
        gate=gate_of(job.values),
    )


def summary(results: Results) -> dict[str, Table]:
    """Verdicts and largest distance of each variation by anatomy, or the steps; closed valves."""

    def by_anatomy(name: str) -> dict[str, Table]:
        records = results.records.values()
        return {one.row: one.table_of(name) for one in records if name in one.tables}

    parts, known = by_anatomy(""), [name for name in CLOSED if name in results.table_names]
    if "variations" not in results.table_names:
        return {"": results.table(), **{name: results.table(name) for name in known}}
    distances: dict[str, dict[str, Any]] = {}
    for record in results.records.values():
        for row in record.table_of("variations").rows[1:]:
            mine = distances.setdefault(row["variation"], {"variation": row["variation"]})
            mine[record.row] = row["max"]
    columns = {name: Column("mm", ".2g", label=name) for name in parts}
    shown = table(distances.values(), variation=Column(), **columns)
    closed = {name: joined(by_anatomy(name), "anatomy") for name in known}
    return {"": joined(parts, "anatomy"), "largest_distance": shown, **closed}


CLOSED = ("physiology", "resistance")
"""Tables of a closed valve, see `closed_tables`."""


MOMENTS = (0.75, 0.1)
"""Fractions of the open orifice at which a closing valve is drawn, plus first and last step."""

CURVES = {
    "orifice": "orifice (mm²)",
    "coaptation": "coaptation in the middle (mm)",
    "chord strain": "largest strain of a chord (%)",
}


def figure(results: Results) -> Figures:
    """Four moments of a closing valve from the atrium, the side and in section; its measures."""
    if results.first_arrays is None:
        return None
    from matplotlib.figure import Figure

    record = results.first
    values = record.table_of().values
    at_rest = bool(record.numbers["ends_at_rest"])
    moments = _moments(np.array(values["orifice"], dtype=float))
    titles = {
        k: ("at rest" if at_rest and k == len(values["time"]) - 1 else f"{values['time'][k]:.2f} s")
        + f", {values['pressure'][k]:.0f} mmHg"
        for k in moments
    }
    drawn = Figure(figsize=(11, 10.4), layout="constrained")
    parts: Any = drawn.subfigures(2, 1, height_ratios=[3.0, 1.0])
    draw_closing(parts[0], results.first_arrays, titles)
    _draw_curves(parts[1], values, moments, at_rest)
    drawn.suptitle(
        "A simulated valve closing, from the atrium, from the posterior side and in the middle"
        " section (dots: the moments shown)",
        fontsize=11,
    )
    return drawn


def _moments(orifice: FloatArray) -> list[int]:
    """First, half-open, nearly closed and last step; the last step if a fraction is not reached."""
    share, last = orifice / max(float(orifice[0]), 1e-9), len(orifice) - 1
    reached = [int(np.append(np.flatnonzero(share < level), last)[0]) for level in MOMENTS]
    return [0, *reached, last]


def _draw_curves(part: Any, values: Mapping[str, Any], moments: list[int], at_rest: bool) -> None:
    """Measures over time with the drawn moments; the timeless equilibrium is drawn separately."""
    from mvest.reporting.figures import COLOURS, plain_axes

    time = np.array(values["time"], dtype=float)
    moving = len(time) - at_rest
    end = time[moving - 1]
    place = np.append(time[:moving], 1.13 * end)[: len(time)]
    for axes, (name, label) in zip(part.subplots(1, len(CURVES)), CURVES.items(), strict=True):
        plain_axes(axes)
        y = (100.0 if label.endswith("(%)") else 1.0) * np.array(values[name], dtype=float)
        axes.plot(place[:moving], y[:moving], ".-", color="black", lw=1, ms=4)
        axes.plot(place[moments], y[moments], "o", color=COLOURS[1], ms=5.5)
        axes.set_xlabel("time (s)")
        axes.set_ylim(bottom=min(0.0, 1.1 * y.min()))
        axes.set_title(label, fontsize=9, loc="left")
        if at_rest:
            axes.axvline(1.065 * end, color="0.8", lw=0.8)
            ticks = [t for t in axes.get_xticks() if 0 <= t <= 0.9 * end]
            axes.set_xticks([*ticks, place[-1]], [*(f"{t:g}" for t in ticks), "at rest"])
            axes.set_xlim(-0.03 * end, 1.22 * end)


STUDY = Study(
    settings=GateSettings,
    part="gate",
    run=run,
    summary=summary,
    figure=figure,
    captions={"": "A valve closing. Simulated."},
    keeps_failures=True,
    golden=("twin",),
)
