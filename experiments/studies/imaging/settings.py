"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mvest.imaging.detection.tracking import TrackingSettings
from mvest.imaging.learning.training import TrainingSettings
from mvest.simulation.motion.population import PopulationSettings
from mvest.valve.anatomy.dimensions import TemplateParameters

__all__ = ["DrawnValves", "HeldOutSettings", "ImagingSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnValves:
    """A population of simulated valves."""

    count: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutSettings:
    """What detectors are tested on: numbers of simulated volumes of valves that no training saw."""

    volumes: int  # of one frame, drawn as those of training are
    shifted: int  # of one frame, outside the ranges of training
    curve_volumes: int  # of each of these two, for detectors trained on fewer volumes
    sequences: int  # of all frames of a valve, drawn as those of training are
    shifted_sequences: int
    wide_calibration: int  # of valves to calibrate with, each setting within or outside
    without_valve: int  # of each kind of volume in which there is none
    wrong_mm: float = 5.0  # mean distance of a valve's points from which on it is not the valve


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagingSettings:
    """Detectors for valves in volumes: their training, and how well they do."""

    bases: dict[str, TemplateParameters] = field(default_factory=dict)
    population: PopulationSettings = field(default_factory=PopulationSettings)
    train: DrawnValves
    calibration: DrawnValves  # for the errors that detectors state
    test: DrawnValves
    training: TrainingSettings = field(default_factory=TrainingSettings)
    curve: tuple[int, ...] = ()  # volumes of further, smaller trainings
    detection: TrackingSettings = field(default_factory=TrackingSettings)
    evaluate: bool = True
    held_out: HeldOutSettings
    targets: dict[str, Any] = field(default_factory=dict)  # setting -> column of the table -> limit
    processes: int = 1
    model: str | None = None  # file, or "package": detectors to be tested, none being trained
    publish_model: bool = False  # make the model the one that comes with the package


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    imaging: ImagingSettings
