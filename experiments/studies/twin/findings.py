"""Findings of a synthetic study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from experiments.common.records.estimates import (
    Identified,
    Innovation,
    Paper,
    SeedRun,
    Spread,
)
from experiments.common.records.findings import Vector
from mvest.problem.estimate import Modulus
from mvest.valve.measure.measurements import ClosureMeasurements

__all__ = ["Findings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p parameters; what is not of all seeds is of the first.

    Attributes
    ----------
    paper : Paper or None
    truth, initial : (p,)
        In units of the parameters.
    repeats : tuple of SeedRun
        The estimate from each seed.
    moduli : tuple of Modulus
    moduli_error_percent : Spread or None
        Without sign, of all moduli.
    closure : mapping or None
        Fitted frame -> its measurements, or why they could not be taken.
    innovation : Innovation or None
    identifiability : Identified or None
    confirmed_mm : float or None
        Largest distance of the fitted closed valve from one closed anew from the open state.
    seconds_computing : float
        Of simulating and estimating, all seeds.
    truth_store : {"hit", "miss"}
        Whether the simulated truth was in the store.
    truth_band_percent : (p,) or None
        By how much the estimate follows what carries a truth on to cells of no size, in percent of
        the truth: what is not known of it. None where the truth has a mesh.
    """

    paper: Paper | None
    truth: Vector
    initial: Vector
    repeats: tuple[SeedRun, ...]
    moduli: tuple[Modulus, ...]
    moduli_error_percent: Spread | None
    closure: Mapping[str, ClosureMeasurements | str] | None
    innovation: Innovation | None
    identifiability: Identified | None
    confirmed_mm: float | None
    seconds_computing: float
    truth_store: Literal["hit", "miss"]
    truth_band_percent: Vector | None = None

    @property
    def first(self) -> SeedRun:
        """The estimate that tables and figures are of."""
        return self.repeats[0]
