"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.building.virtual_patients import PatientSettings
from experiments.common.cases.settings import PersonalSettings

__all__ = ["DoorSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DoorSettings:
    """How the geometry of a virtual patient arrives."""

    kind: str  # vertices, surfaces, slicerheart or labels
    label: str  # what tables call it
    seen_with_errors: bool = False  # the closed surface has the errors of the patient's case
    voxel_mm: float | None = None  # of a label map
    closed: bool = False  # the closed frame is a label map as well
    std_mm: float = 0.6  # of the closed surface, where the case itself does not say it


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    personal: PersonalSettings
    door: DoorSettings
