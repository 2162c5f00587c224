"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.studies.models.sheet.sheet import Sheet

__all__ = ["ModelsSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelsSettings:
    """The same sheet in two finite-element codes, and as a program."""

    sheet: Sheet = field(default_factory=Sheet)
    refinements: tuple[tuple[int, ...], ...] = ()  # [along, across, layers] to compare on
    relative_step: float = 1e-3  # of the program's differences
    time_limit_s: float = 120.0  # of one run of the program
    processes: int = 1  # of its runs at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    models: ModelsSettings = field(default_factory=ModelsSettings)
