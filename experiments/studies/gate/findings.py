"""Findings of the gate."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mvest.closure.robustness import GateRow
from mvest.closure.smoothness import Path

__all__ = ["Findings", "Followed", "Limits", "Row"]


@dataclass(frozen=True, slots=True)
class Row:
    """One variation: distance of the closed surface from the reference's.

    None if the closure failed; seconds are of the processor.
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
class Followed:
    """The closed surface followed along a factor on moduli.

    Unexplained is what the exact derivatives do not say of the way between two states, at its
    largest anywhere, and in all as a share of the whole way; None where a closure failed. The
    curvature is by how much a central difference over the widest step differs from the derivative,
    relative.
    """

    along: str
    unexplained_mm: float | None
    share: float | None
    curvature: float | None
    closures: int
    passed: bool
    reason: str

    @classmethod
    def of(cls, path: Path) -> Followed:
        """What a path comes to."""
        pieces = path.pieces
        return cls(
            path.name,
            max((piece.unexplained_mm for piece in pieces), default=None),
            path.share if math.isfinite(path.share) else None,
            path.curvature if math.isfinite(path.curvature) else None,
            path.closures,
            path.passed,
            path.reason,
        )


@dataclass(frozen=True, slots=True)
class Limits:
    """Up to which distances, jumps, and unexplained shares of a way the gate is passed.

    Shares below ``seen_mm`` are not judged, ``side`` is that on both sides of one state.
    """

    mean_mm: float
    max_mm: float
    jump_mm: float
    seen_mm: float
    share: float
    side: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Whether the closed state of an anatomy is one: reference, variations, paths of the moduli.

    ``anatomy`` is its digest, by which others look the verdict up. The gap is what stays open of
    the reference, by the measure that predictions use, and beside it the largest ball that passes;
    None where the reference did not close.
    """

    anatomy: str
    passed: bool
    gap_mm2: float | None
    passing_ball_mm: float | None
    rows: tuple[Row, ...]
    paths: tuple[Followed, ...]
    limits: Limits

    @property
    def failures(self) -> tuple[str, ...]:
        """What it fails by, one after another."""
        rows = [
            f"{row.case}: " + (row.reason if row.mean_mm is None else f"{row.max_mm:.2g} mm off")
            for row in self.rows
            if not row.passed
        ]
        return (*rows, *(f"{p.along}: {p.reason}" for p in self.paths if not p.passed))
