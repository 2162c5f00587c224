"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["DonorSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DonorSettings:
    """What a study of the recorded donor valve adds."""

    vertices: int = 430  # of the midsurface that is meshed and observed
    contact_vertices: int = 3000  # of the midsurface on which contact is sampled
    starts: tuple[Any, ...] = ()  # MPa, moduli from which each fit starts
    largest_change: float = 0.15  # of a modulus' logarithm from one closed state to the next


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    donor: DonorSettings = field(default_factory=DonorSettings)
