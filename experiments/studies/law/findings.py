"""Findings of the study of the material law; curves are (n, 2), along and across the fibres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from experiments.common.estimates import Matrix, Vector

__all__ = ["Band", "Curves", "Distance", "Excised", "Findings", "Fit", "Parameter", "Sample",
           "Stretches"]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a fit, in its unit; None where it is not known.

    Attributes
    ----------
    name, unit : str
    truth : float or None
    start : float
    estimate, std : float or None
    bound : float or None
        Cramér-Rao standard deviation.
    """

    name: str
    unit: str
    truth: float | None
    start: float
    estimate: float | None
    std: float | None
    bound: float | None


@dataclass(frozen=True, slots=True)
class Distance:
    """Distances of the fitted from the true closed valve, in mm.

    Attributes
    ----------
    mean, max : float
    """

    mean: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """What one law makes of the observation.

    Attributes
    ----------
    law : str
    parameters : tuple of Parameter
    distance_mm : Distance or None
        None where nothing was fitted, as what follows.
    residual_rms_mm, chi_square : float or None
        Of observed and fitted coordinates; chi-square per coordinate.
    iterations, forward_solves : int
    seconds : float
    reason : str
    converged : bool
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
    """The exponential law from an observation with other errors.

    Attributes
    ----------
    seed : int
        Of the errors.
    estimate, low, high : (p,)
        With its 95 % interval.
    converged : bool
    forward_solves : int
    """

    seed: int
    estimate: Vector
    low: Vector
    high: Vector
    converged: bool
    forward_solves: int


@dataclass(frozen=True, slots=True)
class Band:
    """Stress of an estimated law in MPa, with its 95 % band.

    Attributes
    ----------
    estimate, low, high : (n, 2)
    """

    estimate: Matrix
    low: Matrix
    high: Matrix


@dataclass(frozen=True, slots=True)
class Curves:
    """Nominal stress of a leaflet in MPa under equibiaxial stretch.

    Attributes
    ----------
    stretch : (n,)
    truth, linear : (n, 2)
    exponential : Band
    """

    stretch: Vector
    truth: Matrix
    exponential: Band
    linear: Matrix


@dataclass(frozen=True, slots=True)
class Stretches:
    """Stretches in a closed leaflet: 5th, 50th and 95th percentile.

    Attributes
    ----------
    along, across : (3,)
        The fibres.
    """

    along: Vector
    across: Vector


@dataclass(frozen=True, slots=True)
class Excised:
    """The law with the coefficients of an excised leaflet, under equibiaxial stretch.

    Attributes
    ----------
    stretch : (n,)
    stress : (n, 2)
        MPa.
    slope_at_rest, slope : float
        MPa, along the fibres, the second where `reached` begins; None if it is not.
    reached : (2,)
        Stretches at which the stress by which leaflets are compared is reached, or None.
    """

    stretch: Vector
    stress: Matrix
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
    excised : mapping
        Leaflet -> Excised.
    fits : tuple of Fit
        Exponential and linear; none if the valve did not close, as all that follows.
    samples : tuple of Sample
    curves : mapping
        Leaflet -> Curves; empty unless both fits have an estimate.
    stretches : mapping
        Leaflet -> Stretches.
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
