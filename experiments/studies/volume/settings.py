"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.common.cases.settings import ImagedSettings, PersonalSettings, VolumeInput

__all__ = ["Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    volume: VolumeInput = None  # file of a volume over time
    imaged: ImagedSettings = field(default_factory=ImagedSettings)
    personal: PersonalSettings
