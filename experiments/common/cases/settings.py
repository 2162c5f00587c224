"""What studies that personalise a case add to the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from experiments.common.schema import InputFile, Reads, contents
from mvest.cases.from_images.settings import ImagedSettings
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation.settings import CaseChoices
from mvest.quantities import Value


def _case(value: str, _beside: Mapping[str, Any]) -> Any:
    # Where no case is read this is not either.
    from mvest.cases.schema import files_of_case

    return contents(files_of_case(Path(value))) or value


def _volume(value: str, _beside: Mapping[str, Any]) -> Any:
    from mvest.exchange.volumes import files_of_volume

    return contents(files_of_volume(Path(value))) or value


CaseInput = Annotated[str | None, Reads(_case)]
"""Type of a setting that names the folder of a case."""

VolumeInput = Annotated[str | None, Reads(_volume)]
"""Type of a setting that names the file of a volume over time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownSettings:
    """One quantity that is not known of a case: its prior, and what becomes of it."""

    mean: Value
    std: Value
    treatment: Literal["estimated", "fixed"] = "estimated"


@dataclass(frozen=True, slots=True, kw_only=True)
class PersonalSettings(CaseChoices):
    """How a case is personalised; errors are learned where a configuration says how well known."""

    unknowns: dict[str, UnknownSettings] = field(default_factory=dict)
    errors: ErrorBeliefs | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedInput(ImagedSettings):
    """From a volume to a case; what the settings name is read for the hash."""

    model: InputFile = None
    package_model: str | None = "${package_model:}"  # SHA-256 of the one for ultrasound
    landmarks: Annotated[tuple[Any, ...], Reads(contents)] = ()
    pressure_curve: InputFile = None
