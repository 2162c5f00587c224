"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.cases.settings import CaseInput, PersonalSettings

__all__ = ["Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    case: CaseInput = None  # folder of a case
    strict: bool = False  # refuse a case that is not plausible, instead of saying so
    gate: bool = False  # with check=true: ask whether the closed state is one, some minutes
    personal: PersonalSettings
