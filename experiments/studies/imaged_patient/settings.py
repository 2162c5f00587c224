"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.common.cases.settings import ImagedSettings, PatientSettings, PersonalSettings

__all__ = ["EchoSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EchoSettings:
    """How a virtual patient who is to be imaged moves, and how the volume is simulated."""

    spread: str = "training"  # of acquisitions; shifted: what no detector was trained on
    tip_motion_mm: tuple[float, ...] = (1.0, 3.0)  # of papillary tips


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    echo: EchoSettings = field(default_factory=EchoSettings)
    volume: str | None = None  # written by the study
    imaged: ImagedSettings = field(default_factory=ImagedSettings)
    personal: PersonalSettings
