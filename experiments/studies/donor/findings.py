"""Findings of the fit of a recorded valve; moduli and their standard deviations in MPa."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.estimates import Data, EstimatedModulus, Identified, Innovation, Spread
from experiments.common.findings import Rows, Vector
from experiments.common.record import Status

__all__ = [
    "Distances",
    "Findings",
    "Row",
    "Summary",
]


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances from the recording, in mm.

    Attributes
    ----------
    mean, median, rms, max : float
        Of the vertices from where they were recorded.
    surface : float
        Mean of the whole closed surface from the recorded one, both ways, whatever its points are.
    leaflets : mapping
        Leaflet -> mean of its vertices.
    """

    mean: float
    median: float
    rms: float
    max: float
    surface: float
    leaflets: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Row:
    """One closure: with generic moduli, or fitted from one start.

    Attributes
    ----------
    closure : str
    status : {"converged", "failed"}
    reason : str
    start : (p,)
    estimate, std : (p,) or None
    distance_mm : Distances or None
    iterations, forward_solves : int
    equilibria : int
        Closed states that it went through.
    seconds : float
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
class Summary:
    """What the run is for, in numbers; None where a closure is missing.

    Attributes
    ----------
    starts : int
    largest_difference_between_starts : float or None
        Of a modulus, relative.
    recorded_motion_mm : float
        Mean, from the open to the recorded closed frame.
    generic_mean_mm, fitted_mean_mm, generic_surface_mm, fitted_surface_mm : float or None
    closer_percent : float or None
        By how much the mean distance of the fitted closure is less than that of the generic one.
    closer_than_generic : bool or None
    """

    starts: int
    largest_difference_between_starts: float | None
    recorded_motion_mm: float
    generic_mean_mm: float | None
    fitted_mean_mm: float | None
    closer_percent: float | None
    generic_surface_mm: float | None
    fitted_surface_mm: float | None
    closer_than_generic: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p moduli; the estimate is that from the first start.

    Attributes
    ----------
    estimate, std : (p,) or None
    iterates, iterate_std : (i, p) or None
    moduli : tuple of EstimatedModulus
    distance_mm : Spread or None
        Of the vertices of the first fit from the recording.
    innovation : Innovation or None
        In standard deviations.
    identifiability : Identified or None
    iterations : int
    seconds : float
        Of all closures.
    memory_mb : float
        Largest, of the process.
    claim : str
        What is shown, and what is not.
    data : Data
    regions : tuple of str
    rows : tuple of Row
    summary : Summary
    """

    estimate: Vector | None
    std: Vector | None
    iterates: Rows | None
    iterate_std: Rows | None
    moduli: tuple[EstimatedModulus, ...]
    distance_mm: Spread | None
    innovation: Innovation | None
    identifiability: Identified | None
    iterations: int
    seconds: float
    memory_mb: float
    claim: str
    data: Data
    regions: tuple[str, ...]
    rows: tuple[Row, ...]
    summary: Summary
