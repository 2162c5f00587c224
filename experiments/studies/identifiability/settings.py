"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["DesignsSettings", "Followed", "Settings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """Observations of the closed valve from which profile likelihoods are followed."""

    vertices: str  # a set of experiments.studies.identifiability.observed_sets
    pressures_mmHg: tuple[float, ...]
    label: str


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignsSettings:
    """Which observations are compared before any is made, and how far valleys are followed."""

    pressures_mmHg: tuple[float, ...] = (60.0,)  # of one closed frame more
    cycle_times: tuple[float, ...] = ()  # s, observed in a whole cycle
    cycle_dt: float = 0.003125  # s
    noise_mm: tuple[float, ...] = (0.1, 0.25, 0.5, 1.0)
    typical_mm: float = 0.5  # noise of profiles and of what tables say at one noise
    correlation_length_mm: float = 5.0
    target: float = 0.05  # relative standard deviation that is wanted of a modulus
    # Relative standard deviations of the nuisances, by what is assumed to be known of them: 0
    # for what is known, and nothing is known of what is not named.
    knowledge: dict[str, dict[str, float]] = field(default_factory=dict)
    believed: str = ""  # which of these holds where it is asked how well pressure must be known
    followed: tuple[Followed, ...] = ()
    known: tuple[str, ...] = ()  # parameters that profiles hold
    reach: dict[str, float] = field(default_factory=dict)  # largest change of each logarithm
    points: int = 8  # of a profile, on each side


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    designs: DesignsSettings
