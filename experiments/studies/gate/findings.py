"""Findings of the gate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mvest.closure.robustness import GateRow

__all__ = ["Findings", "Limits", "Row"]


@dataclass(frozen=True, slots=True)
class Row:
    """One variation.

    Attributes
    ----------
    case : str
    mean_mm, max_mm : float or None
        Distance of the closed surface from the reference's, less what the exact derivative predicts
        where moduli differ; None if the closure failed.
    passed : bool
    seconds : float
    reason : str
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
    """Up to which distances and difference of slopes the gate is passed.

    Attributes
    ----------
    mean_mm, max_mm : float
    slope : float
        Relative.
    """

    mean_mm: float
    max_mm: float
    slope: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Whether the closed state is one.

    Attributes
    ----------
    passed : bool
    rows : tuple of Row
        The reference, and every variation of it that was run.
    slopes : mapping
        Relative step of the moduli -> relative difference between the exact derivative and central
        differences.
    limits : Limits
    """

    passed: bool
    rows: tuple[Row, ...]
    slopes: Mapping[str, float]
    limits: Limits
