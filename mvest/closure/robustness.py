"""Is the closed valve one state? A gate that every anatomy is asked to pass.

An estimate is worth what the closed valve is worth: if a smaller time step, a finer mesh or a
slightly different modulus sends the leaflets into another pleat, the moduli fitted to that state
mean nothing. The gate closes the valve under variations that must not matter and compares the
closed surfaces, and under changed moduli, where the change must be what the exact derivative
predicts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.typing import FloatArray

__all__ = ["GATE_CASES", "REFERENCE", "GateCase", "GateReport", "GateRow", "run_gate"]

MEAN_LIMIT = 0.1
MAX_LIMIT = 0.5
"""mm, the largest accepted mean and maximal distance between closed states."""
SLOPE_LIMIT = 0.05
"""Largest accepted difference between the exact derivative and one by finite steps, relative."""


@dataclass(frozen=True, slots=True)
class GateCase:
    """One variation of the closure.

    Attributes
    ----------
    name : str
    dt : float
        Factor on the time step.
    mesh : float
        Factor on the number of cells along both directions of the leaflets.
    activation : float
        Factor on the activation distance of contact.
    sampling : float
        Factor on the density of the contact samples along both directions.
    modulus : float
        Factor on all moduli E_f; the closed state then moves, as the derivative says.
    """

    name: str
    dt: float = 1.0
    mesh: float = 1.0
    activation: float = 1.0
    sampling: float = 1.0
    modulus: float = 1.0


REFERENCE = GateCase("reference")
GATE_CASES = (
    GateCase("time step / 2", dt=0.5),
    GateCase("time step / 4", dt=0.25),
    GateCase("time step / 16", dt=0.0625),
    GateCase("activation distance - 10 %", activation=0.9),
    GateCase("contact samples x 1.33", sampling=4 / 3),
    GateCase("mesh x 1.5", mesh=1.5),
    GateCase("E_f + 20 %", modulus=1.2),
    GateCase("E_f - 20 %", modulus=0.8),
    GateCase("E_f + 5 %", modulus=1.05),
    GateCase("E_f - 5 %", modulus=0.95),
    GateCase("E_f + 1 %", modulus=1.01),
    GateCase("E_f - 1 %", modulus=0.99),
)


@dataclass(frozen=True, slots=True)
class GateRow:
    """Outcome of one case.

    Attributes
    ----------
    case : str
    mean_mm, max_mm : float
        Distance of the closed surface from the reference's, after the linear change by the exact
        derivative has been taken off where moduli differ; NaN if the closure failed.
    passed : bool
    seconds : float
    reason : str
    """

    case: str
    mean_mm: float
    max_mm: float
    passed: bool
    seconds: float
    reason: str


@dataclass(frozen=True, slots=True)
class GateReport:
    """All cases and the verdict.

    Attributes
    ----------
    rows : tuple of GateRow
    slopes : dict
        Relative difference between the exact derivative by a common factor on all moduli and the
        central difference at each step (0.01, 0.05, 0.2) that was run.
    passed : bool
    """

    rows: tuple[GateRow, ...]
    slopes: dict[float, float]
    passed: bool


def run_gate(
    build: Callable[[GateCase], ClosureModel],
    m: FloatArray,
    cases: Sequence[GateCase] = GATE_CASES,
    on_case: Callable[[GateRow], None] | None = None,
) -> GateReport:
    """Close the valve in all cases and compare.

    Parameters
    ----------
    build : callable
        Makes the model of a case; all must observe the same material points.
    m : ndarray
        ``(p,)`` parameters; those named ``E_f.*`` are multiplied by the case's factor.
    cases : sequence of GateCase
    on_case : callable, optional
        Called with each row as it is finished.
    """
    start = time.perf_counter()
    model = build(REFERENCE)
    is_modulus = np.array([name.startswith("E_f.") for name in model.names])
    reference = model(m)
    first = GateRow(
        REFERENCE.name, 0.0, 0.0, reference.converged, time.perf_counter() - start, reference.reason
    )
    if on_case is not None:
        on_case(first)
    if not reference.converged:
        return GateReport((first,), {}, False)
    rows, states = [first], {}
    slope = reference.jacobian @ np.where(is_modulus, m, 0.0)
    for case in cases:
        start = time.perf_counter()
        prediction = build(case)(np.where(is_modulus, case.modulus * m, m))
        mean = largest = float("nan")
        if prediction.converged:
            states[case.modulus, case.name] = prediction.y
            expected = reference.y + (case.modulus - 1) * slope
            distance = np.linalg.norm((prediction.y - expected).reshape(-1, 3), axis=1)
            closed = distance[len(distance) // 2 :]
            mean, largest = float(closed.mean()), float(closed.max())
        rows.append(
            GateRow(
                case.name,
                mean,
                largest,
                bool(mean <= MEAN_LIMIT and largest <= MAX_LIMIT),
                time.perf_counter() - start,
                prediction.reason,
            )
        )
        if on_case is not None:
            on_case(rows[-1])
    slopes = _slopes({factor: y for (factor, _), y in states.items() if factor != 1.0}, slope)
    passed = all(r.passed for r in rows) and all(v <= SLOPE_LIMIT for v in slopes.values())
    return GateReport(tuple(rows), slopes, passed)


def _slopes(states: dict[float, FloatArray], exact: FloatArray) -> dict[float, float]:
    """Relative difference of central differences from the exact derivative, by step."""
    out = {}
    for up in sorted(f for f in states if f > 1):
        down = next((f for f in states if np.isclose(f, 2 - up)), None)
        if down is not None:
            central = (states[up] - states[down]) / (up - down)
            step = round(up - 1, 6)
            out[step] = float(np.linalg.norm(central - exact) / np.linalg.norm(exact))
    return out
