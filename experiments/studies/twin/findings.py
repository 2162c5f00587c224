"""Findings of a synthetic study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from experiments.common.estimates import (
    EstimatedModulus,
    Identified,
    Innovation,
    Paper,
    SeedRun,
    Spread,
)
from experiments.common.findings import Rows, Vector
from mvest.valve.measure.measurements import ClosureMeasurements

__all__ = ["Findings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p parameters; the estimate is that of the first seed.

    Attributes
    ----------
    paper : Paper or None
    truth, initial : (p,)
        In units of the parameters.
    estimate, std, relative_error : (p,) or None
    moduli : tuple of EstimatedModulus
    moduli_error_percent : Spread or None
        Without sign, of all moduli.
    distance_mm, distance_to_truth_mm : Spread or None
        Of the fitted vertices from the observed ones, and from the true ones.
    closure : mapping or None
        Fitted frame -> its measurements, or why they could not be taken.
    iterations : int
    seconds : float
        Of the estimation.
    iterates, iterate_std : (i, p) or None
    innovation : Innovation or None
    identifiability : Identified or None
    repeats : tuple of SeedRun
        Of all seeds.
    confirmed_mm : float or None
        Largest distance of the fitted closed valve from one closed anew from the open state.
    seconds_computing : float
        Of simulating and estimating, all seeds.
    truth_store : {"hit", "miss"}
        Whether the simulated truth was in the store.
    """

    paper: Paper | None
    truth: Vector
    initial: Vector
    estimate: Vector | None
    std: Vector | None
    relative_error: Vector | None
    moduli: tuple[EstimatedModulus, ...]
    moduli_error_percent: Spread | None
    distance_mm: Spread | None
    distance_to_truth_mm: Spread | None
    closure: Mapping[str, ClosureMeasurements | str] | None
    iterations: int
    seconds: float
    iterates: Rows | None
    iterate_std: Rows | None
    innovation: Innovation | None
    identifiability: Identified | None
    repeats: tuple[SeedRun, ...]
    confirmed_mm: float | None
    seconds_computing: float
    truth_store: Literal["hit", "miss"]
