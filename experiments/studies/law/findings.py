"""Findings of the study of the material law; curves are (n, 2), along and across the fibres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from experiments.common.records.findings import Rows, Vector

__all__ = ["Band", "Curves", "Distance", "Excised", "Findings", "Fit", "Parameter", "Sample",
           "Stretches"]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a fit in its unit, with the Cramér-Rao bound; None where not known."""

    name: str
    unit: str
    truth: float | None
    start: float
    estimate: float | None
    std: float | None
    bound: float | None


@dataclass(frozen=True, slots=True)
class Distance:
    """Distances of the fitted from the true closed valve, in mm."""

    mean: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """What one law makes of the observation.

    Residual (root mean square) and chi-square are per observed coordinate; None where nothing was
    fitted.
    """

    law: str
    parameters: tuple[Parameter, ...]
    distance_mm: Distance | None
    residual_rms_mm: float | None
    chi_square: float | None
    iterations: int
    forward_solves: int
    seconds: float
    reason: str
    converged: bool


@dataclass(frozen=True, slots=True)
class Sample:
    """The exponential law ``(p,)`` and its 95 % interval from an observation with other errors."""

    seed: int
    estimate: Vector
    low: Vector
    high: Vector
    converged: bool
    forward_solves: int


@dataclass(frozen=True, slots=True)
class Band:
    """Stress ``(n, 2)`` MPa of an estimated law, with its 95 % band."""

    estimate: Rows
    low: Rows
    high: Rows


@dataclass(frozen=True, slots=True)
class Curves:
    """Nominal stress ``(n, 2)`` MPa of a leaflet under equibiaxial stretch ``(n,)``."""

    stretch: Vector
    truth: Rows
    exponential: Band
    linear: Rows


@dataclass(frozen=True, slots=True)
class Stretches:
    """5th, 50th and 95th percentile ``(3,)`` of the stretches in a closed leaflet, by fibres."""

    along: Vector
    across: Vector


@dataclass(frozen=True, slots=True)
class Excised:
    """Stress ``(n, 2)`` MPa with the coefficients of an excised leaflet, and stretch ``(n,)``.

    Slopes in MPa are those along the fibres, the second at the first of the stretches that are
    ``reached (2,)`` at the stress by which leaflets are compared; None if it is not.
    """

    stretch: Vector
    stress: Rows
    slope_at_rest: float
    slope: float | None
    reached: tuple[float | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What both laws make of one closed valve of the exponential law with p parameters.

    Attributes
    ----------
    truth : (p,)
    noise_mm : float
        Standard deviation of an observed coordinate.
    excised, curves, stretches : mapping
        Leaflet -> its own; without curves unless both fits have an estimate.
    fits : tuple of Fit
        Exponential and linear; none if the valve did not close, as all that follows.
    samples : tuple of Sample
    chi_square_band : (2,) or None
        Where chi-square per coordinate of a right model lies in 95 % of cases.
    """

    truth: Vector
    noise_mm: float
    excised: Mapping[str, Excised]
    fits: tuple[Fit, ...] = ()
    samples: tuple[Sample, ...] = ()
    curves: Mapping[str, Curves] = field(default_factory=dict)
    stretches: Mapping[str, Stretches] = field(default_factory=dict)
    chi_square_band: tuple[float, float] | None = None
