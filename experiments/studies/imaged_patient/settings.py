"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.common.building.virtual_patients import EchoSettings, PatientSettings
from experiments.common.cases.settings import ImagedSettings, PersonalSettings

__all__ = ["Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    echo: EchoSettings = field(default_factory=EchoSettings)
    volume: str | None = None  # written by the study
    imaged: ImagedSettings = field(default_factory=ImagedSettings)
    personal: PersonalSettings
