"""Findings of the fit of a recorded valve; moduli and their standard deviations in MPa."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from experiments.common.records.estimates import Data, Identified, Innovation, Spread
from experiments.common.records.findings import Rows, Vector
from experiments.common.records.record import Status
from mvest.problem.estimate import Modulus

__all__ = ["Distances", "Findings", "Row"]


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances from the recording, in mm.

    Of the vertices from where they were recorded, by leaflet too; ``surface`` is the mean of the
    whole closed surface from the recorded one, both ways, whatever its points are.
    """

    mean: float
    median: float
    rms: float
    max: float
    surface: float
    leaflets: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Row:
    """One closure: with generic moduli, or fitted from a start ``(p,)``.

    ``equilibria`` are the closed states that it went through, seconds those of the processor.
    """

    closure: str
    status: Status
    reason: str
    start: Vector
    estimate: Vector | None
    std: Vector | None
    distance_mm: Distances | None
    iterations: int
    forward_solves: int
    equilibria: int
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p moduli; the estimate is that from the first start.

    ``distance_mm`` is of the vertices of the first fit from the recording, the innovation in
    standard deviations, seconds those of the processor for all closures, and memory the largest of
    the process. The claim says what is shown, and what is not. Rows are the generic closure and the
    fit from each start, and the recorded motion is the mean from the open to the recorded closed
    frame. ``recording`` is its folder, and the tips' motion the largest, prescribed there.
    """

    estimate: Vector | None
    std: Vector | None
    iterates: Rows | None
    iterate_std: Rows | None
    moduli: tuple[Modulus, ...]
    distance_mm: Spread | None
    innovation: Innovation | None
    identifiability: Identified | None
    iterations: int
    seconds: float
    memory_mb: float
    claim: str
    data: Data
    recording: str
    pressure_mmHg: float
    tip_motion_mm: float
    regions: tuple[str, ...]
    rows: tuple[Row, ...]
    recorded_motion_mm: float

    @property
    def starts_differ(self) -> float | None:
        """Largest relative difference of a modulus between starts; None where a fit is missing."""
        estimates = [row.estimate for row in self.rows[1:] if row.estimate is not None]
        if not len(estimates) == len(self.rows) - 1 > 1:
            return None
        return float(np.max(np.ptp(np.array(estimates), axis=0) / np.mean(estimates, axis=0)))
