"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.common.building.cycle_settings import CycleSettings

__all__ = ["PatchSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchSettings:
    """A stiff patch of the simulated truth, in material coordinates of the template."""

    region: str = "anterior"
    angle_deg: float = 90.0
    share: float = 0.5  # of the way from the annulus to the free edge
    radius_mm: float = 7.0
    factor: float = 2.0
    compared: bool = False  # with a valve that has no patch: takes twice as long


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    cycle: CycleSettings = field(default_factory=CycleSettings)
    patch: PatchSettings = field(default_factory=PatchSettings)
