"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mvest.scenarios.scenario import Scenario

__all__ = ["PredictionSettings", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionSettings:
    """What is predicted of estimated valves, and how well their truth is hit."""

    scenarios: dict[str, Scenario] = field(default_factory=dict)
    samples: int = 32  # of the first patient's posterior; a power of two
    patients: int = 1  # simulated, with the seeds seed, seed + 1, ...
    further_samples: int = 8  # of the posterior of every other patient
    spread: tuple[float, ...] = ()  # SD of the logarithms of true parameters
    # Cells [around, annulus to edge] of further meshes on which peak stress is computed.
    stress_meshes: tuple[Any, ...] = ()
    # Cells of the finer mesh on which each estimate is predicted once, to tell the mesh's error;
    # empty: intervals know nothing of it.
    check_mesh: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    prediction: PredictionSettings = field(default_factory=PredictionSettings)
