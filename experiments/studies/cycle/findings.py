"""Findings about the frames of a cycle; standard deviations are parts of the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.findings import Rows, Vector
from experiments.common.whole_cycle import Bound

__all__ = ["Along", "Band", "Curve", "Drift", "Findings", "Frame", "Steps"]

Rows = Rows


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame by itself.

    Attributes
    ----------
    time : float
        s.
    pressure_mmHg, displacement_mm : float
        The latter is the mean from the open frame.
    std_alone : (p,)
        Smallest possible of each parameter if the others were known; None if the frame says
        nothing of it.
    """

    time: float
    pressure_mmHg: float
    displacement_mm: float
    std_alone: tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class Curve:
    """The pressure over the cycle.

    Attributes
    ----------
    time : (n,)
        s.
    pressure_mmHg : (n,)
    """

    time: Vector
    pressure_mmHg: Vector


@dataclass(frozen=True, slots=True)
class Along:
    """How the frames follow the parameters along a path with one time step.

    Attributes
    ----------
    rms_mm : tuple of float
        Change of all frames from one place of the path to the next.
    reason : str
        Why the path could not be followed to its end; empty if it could.
    """

    rms_mm: Vector
    reason: str


@dataclass(frozen=True, slots=True)
class Steps:
    """What depends on the time step.

    Attributes
    ----------
    dt : (s,)
        s, each half of the one before.
    rms_mm : (s - 1,)
        Change of all frames from one time step to the next.
    order : (s - 2,)
        Binary logarithm of the ratio of two such changes.
    path : (n, p)
        Parameters along which frames are looked at.
    along : (s,)
    runs : int
        Of the model.
    """

    dt: Vector
    rms_mm: tuple[float | None, ...]
    order: tuple[float | None, ...]
    path: Rows
    along: tuple[Along, ...]
    runs: int


@dataclass(frozen=True, slots=True)
class Band:
    """Estimates of q parameters over b beats, by their logarithms.

    Attributes
    ----------
    mean, low, high : (b, q)
        Median and bounds of 95 %.
    rms_error, mean_std : (q,)
        Of the logarithm, over the beats.
    coverage : (q,)
        Share of the beats in which the truth lies within the band.
    """

    mean: Rows
    low: Rows
    high: Rows
    rms_error: Vector
    mean_std: Vector
    coverage: Vector


@dataclass(frozen=True, slots=True)
class Drift:
    """A modulus that drifts from beat to beat.

    Attributes
    ----------
    runs : int
        Of the model.
    parameters : (q,)
    times : tuple of float
        s, of the frames of each beat.
    truth : (b, q)
    assumed_std : float
        Of the change of a logarithm from one beat to the next.
    filter, smoother : Band
        From the beats so far, and from all.
    """

    runs: int
    parameters: tuple[str, ...]
    times: Vector
    truth: Rows
    assumed_std: float
    filter: Band
    smoother: Band


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p parameters.

    Attributes
    ----------
    truth : (p,)
    noise_mm : float
        Standard deviation of a coordinate.
    vertices : int
    frames : tuple of Frame
    curve : Curve
    sets, phases : tuple of Bound
        Of ever more frames, and of the parts of the cycle.
    steps : Steps
    drift : Drift or str
        Why it was not followed, if it was not.
    measures : mapping
        What runs are compared by.
    """

    truth: Vector
    noise_mm: float
    vertices: int
    frames: tuple[Frame, ...]
    curve: Curve
    sets: tuple[Bound, ...]
    phases: tuple[Bound, ...]
    steps: Steps
    drift: Drift | str
    measures: Mapping[str, float]
