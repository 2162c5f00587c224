"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.common.building.cycle_settings import CycleSettings

__all__ = ["Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    cycle: CycleSettings = field(default_factory=CycleSettings)
