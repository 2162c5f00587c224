"""Findings of the study of frames and pressures."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Findings", "Left", "Tried"]


@dataclass(frozen=True, slots=True)
class Left:
    """What a design leaves of the generic guess's error, as a share, of each modulus.

    The error of the pressures is of one kind and has a size in mmHg; all unknowns of one group are
    known in ``known``, if any. Geometry is exact, or is considered.
    """

    geometry: bool
    kind: str
    mmhg: float
    frames: int
    known: str
    shares: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Tried:
    """One modulus of one patient estimated with a design.

    Shares of the prior's standard deviation (of logarithms): predicted by the design at the generic
    moduli, as reported by the estimate, and how far the estimate and the generic guess truly are
    off. None where there is no estimate.
    """

    corner: str
    modulus: str
    predicted: float
    reported: float | None
    error: float | None
    generic: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Designs of one valve, and what became of those that were tried."""

    moduli: tuple[str, ...]
    prior_std: tuple[float, ...]
    pressures_mmHg: tuple[float, ...]
    left: tuple[Left, ...]
    tried: tuple[Tried, ...]
