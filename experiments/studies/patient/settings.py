"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.building.virtual_patients import PatientSettings
from experiments.common.cases.settings import PersonalSettings

__all__ = ["Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    personal: PersonalSettings
