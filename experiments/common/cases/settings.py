"""What studies that personalise a case add to the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from experiments.common.schema import InputFile, Reads, contents
from mvest.imaging.valve_sequence import MIN_CONFIDENCE
from mvest.mechanics.settings import ExponentialTissue
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation.considered_geometry import ConsideredGeometry
from mvest.personalisation.settings import CaseMesh, PaperSettings, PressureErrors

__all__ = ["CaseInput", "ImagedSettings", "PersonalSettings", "UnknownSettings", "VolumeInput"]


def _case(value: str, _beside: Mapping[str, Any]) -> Any:
    # Where no case is read this is not either.
    from mvest.cases.paths import files_of_case

    return contents(files_of_case(Path(value))) or value


def _volume(value: str, _beside: Mapping[str, Any]) -> Any:
    from mvest.imaging.reading.data import files_of_volume

    return contents(files_of_volume(Path(value))) or value


CaseInput = Annotated[str | None, Reads(_case)]
"""Type of a setting that names the folder of a case."""

VolumeInput = Annotated[str | None, Reads(_volume)]
"""Type of a setting that names the file of a volume over time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownSettings:
    """One quantity that is not known of a case: its prior, and what becomes of it."""

    mean: float
    std: float
    treatment: str = "estimated"  # or considered, or fixed


@dataclass(frozen=True, slots=True, kw_only=True)
class PersonalSettings:
    """How a case is personalised (see mvest.personalisation.PersonaliseSettings)."""

    unknowns: dict[str, UnknownSettings] = field(default_factory=dict)
    mesh: CaseMesh = field(default_factory=CaseMesh)
    tolerance: float = 2e-3
    max_iterations: int = 15
    largest_change: float = 0.2  # of a parameter's logarithm from one equilibrium to the next
    paper: PaperSettings | None = None
    moduli_only: bool = False  # estimate also with all nuisances fixed
    confirm: bool = False  # close the fitted valve anew from the open one
    correspondence: bool = True  # use corresponding vertices as such, where there are any
    errors: ErrorBeliefs | None = None  # learn the errors that the case states
    considered_geometry: ConsideredGeometry | None = None  # how well it is known; null: exactly
    considered_law: dict[str, ExponentialTissue] = field(default_factory=dict)  # it may follow
    pressures: PressureErrors | None = None  # of several closed frames, beside a common factor


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedSettings:
    """From a volume over time to a case: what the file does not say."""

    model: InputFile = None  # file of the detection model; null: the one for ultrasound
    package_model: str | None = "${package_model:}"  # SHA-256 of that one
    modality: str | None = None  # ultrasound, ct or mr, where the file does not say
    frame_interval_s: float | None = None  # where the file states no times
    time_unit: str | None = None  # s or ms, where the file states times without a unit
    # [frame, .mrk.json] with landmarks placed by hand, where the automatic ones fail.
    landmarks: Annotated[tuple[Any, ...], Reads(contents)] = ()
    open_frame: int | None = None  # null: the one with the largest orifice
    closed_frame: int | None = None  # null: the one whose leaflets touch most
    pressure_mmHg: float | None = None  # transmitral, in the closed frame
    pressure_curve: InputFile = None  # .csv time,pressure (s, mmHg, the times of the volume)
    held_out: tuple[Any, ...] = ()  # [frame, mmHg]: closed frames not shown
    thickness_mm: tuple[float, ...] = ()  # anterior, posterior; empty: generic
    # Of the best frame, below which there is no valve, and of the frames that are chosen.
    min_confidence: float = MIN_CONFIDENCE
    error_samples: int = 200  # at most, of held-out volumes, each also as seen in a mirror
    name: str | None = None  # null: the name of the file
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = False  # does the volume come from a simulation
