"""Findings on the valve of a reference heart; moduli in MPa."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.records.estimates import Data
from experiments.common.records.findings import Vector
from mvest.closure.measures import StepMeasures

__all__ = ["Asked", "Closed", "Findings", "Measure", "MeshRow", "TwinRow"]


@dataclass(frozen=True, slots=True)
class Measure:
    """One size of the open valve."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True, slots=True)
class MeshRow:
    """A mesh of the leaflets; the volume is that of its elements."""

    name: str
    element: str
    nodes: int
    elements: int
    volume_mm3: float


@dataclass(frozen=True, slots=True)
class Closed:
    """One closure with generic moduli: its assumptions, and the valve before and after."""

    name: str
    annulus_contraction: float
    closed_depth: float
    opened: StepMeasures
    closed: StepMeasures
    reason: str


@dataclass(frozen=True, slots=True)
class Asked:
    """One variation of the gate, or one way along the moduli (then without distances)."""

    name: str
    mean_mm: float | None
    max_mm: float | None
    passed: bool
    reason: str


@dataclass(frozen=True, slots=True)
class TwinRow:
    """Moduli estimated from one simulated closure, ``distance_mm`` of the fit from it."""

    truth: str
    values: Vector
    estimate: Vector | None
    std: Vector | None
    error_percent: Vector | None
    distance_mm: float | None
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What the shape is, how it closes with generic moduli, and what twins on it give.

    ``derived`` are the sentences of the case, ``anatomy`` is the digest by which the gate's verdict
    is known again, and ``left_out`` the variations of the gate that were not asked. Gate and twins
    are of the first closure.
    """

    data: Data
    anatomy: str
    passed: bool
    claim: str
    derived: tuple[str, ...]
    measures: tuple[Measure, ...]
    meshes: tuple[MeshRow, ...]
    closures: tuple[Closed, ...]
    gate: tuple[Asked, ...]
    left_out: tuple[str, ...]
    twins: tuple[TwinRow, ...]
