"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["LawSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LawSettings:
    """What the study of the material law adds: the linear law's fit, and curves to draw."""

    linear_parameters: tuple[str, ...] = ()  # E_f of each leaflet
    linear_initial: tuple[float, ...] = ()  # MPa
    linear_P0: Any = None
    excised: dict[str, tuple[float, ...]] = field(default_factory=dict)  # c0 (MPa), c1, c2


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    law_study: LawSettings = field(default_factory=LawSettings)
