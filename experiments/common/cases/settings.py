"""What studies that personalise a case add to the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from experiments.common.schema import InputFile, Reads, contents
from mvest.cases.from_images.settings import ImagedSettings
from mvest.mechanics.settings import ExponentialTissue
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation.geometry import ConsideredGeometry
from mvest.personalisation.settings import CaseMesh, PaperSettings, PressureErrors
from mvest.quantities import Count, Logarithm, Tolerance, Value


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
class PersonalSettings:
    """How a case is personalised (see mvest.personalisation.PersonaliseSettings)."""

    unknowns: dict[str, UnknownSettings] = field(default_factory=dict)
    mesh: CaseMesh = field(default_factory=CaseMesh)
    tolerance: Tolerance = 2e-3
    max_iterations: Count = 15
    largest_change: Logarithm = 0.2  # of a parameter's logarithm from one equilibrium to the next
    paper: PaperSettings | None = None
    moduli_only: bool = False  # estimate also with all nuisances fixed
    confirm: bool = False  # close the fitted valve anew from the open one
    correspondence: bool = True  # use corresponding vertices as such, where there are any
    errors: ErrorBeliefs | None = None  # learn the errors that the case states
    considered_geometry: ConsideredGeometry | None = None  # how well it is known; null: exactly
    considered_law: dict[str, ExponentialTissue] = field(default_factory=dict)  # it may follow
    pressures: PressureErrors | None = None  # of several closed frames, beside a common factor


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedInput(ImagedSettings):
    """From a volume to a case; what the settings name is read for the hash."""

    model: InputFile = None
    package_model: str | None = "${package_model:}"  # SHA-256 of the one for ultrasound
    landmarks: Annotated[tuple[Any, ...], Reads(contents)] = ()
    pressure_curve: InputFile = None
