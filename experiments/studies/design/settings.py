"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.building.virtual_patients import PatientSettings
from experiments.common.cases.settings import PersonalSettings
from mvest.personalisation.considered_geometry import ConsideredGeometry

__all__ = ["Corner", "FramesSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Corner:
    """A design with which a patient is estimated: errors as stated, and as drawn."""

    fitted_pressure_mmHg: tuple[float, ...] = ()  # beside the closed frame's
    factor: float = 0.1  # relative, on all pressures
    offset_mmHg: float = 0.0
    each_mmHg: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesSettings:
    """What is designed, and which designs are also tried."""

    geometry: ConsideredGeometry | None = None  # how well it is known where it is not exactly
    corners: dict[str, Corner] | None = None  # name -> design


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    personal: PersonalSettings
    frames: FramesSettings
