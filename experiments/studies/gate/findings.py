"""Findings of the gate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mvest.closure.robustness import GateRow

__all__ = ["Findings", "Limits", "Row"]


@dataclass(frozen=True, slots=True)
class Row:
    """One variation: distance of the closed surface from the reference's.

    Where moduli differ, less what the exact derivative predicts; None if the closure failed.
    """

    case: str
    mean_mm: float | None
    max_mm: float | None
    passed: bool
    seconds: float
    reason: str

    @classmethod
    def of(cls, row: GateRow) -> Row:
        """A row of the library's, without NaN, which JSON lacks."""
        mean, largest = (v if math.isfinite(v) else None for v in (row.mean_mm, row.max_mm))
        return cls(row.case, mean, largest, row.passed, row.seconds, row.reason)


@dataclass(frozen=True, slots=True)
class Limits:
    """Up to which distances and relative difference of slopes the gate is passed."""

    mean_mm: float
    max_mm: float
    slope: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Whether the closed state is one: the reference, and every variation that was run.

    Slopes are, by the relative step of the moduli, the relative difference between the exact
    derivative and central differences.
    """

    passed: bool
    rows: tuple[Row, ...]
    slopes: Mapping[str, float]
    limits: Limits
