"""Findings about the frames of a cycle; standard deviations are parts of the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.building.whole_cycle import Bound
from experiments.common.records.findings import Rows, Vector

__all__ = ["Along", "Band", "Curve", "Drift", "Findings", "Frame", "Steps"]


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame by itself, with its mean displacement from the open one.

    ``std_alone (p,)`` is the smallest possible of each parameter if the others were known, None if
    the frame says nothing of it.
    """

    time: float
    pressure_mmHg: float
    displacement_mm: float
    std_alone: tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class Curve:
    """The pressure ``(n,)`` over the times ``(n,)`` s of a cycle."""

    time: Vector
    pressure_mmHg: Vector


@dataclass(frozen=True, slots=True)
class Along:
    """Change of all frames from one place of a path of parameters to the next, one time step.

    The reason says why the path could not be followed to its end; empty if it could.
    """

    rms_mm: Vector
    reason: str


@dataclass(frozen=True, slots=True)
class Steps:
    """What depends on the time step: ``dt (s,)`` s, each half of the one before.

    ``rms_mm (s - 1,)`` is the change of all frames from one to the next, ``order (s - 2,)`` the
    binary logarithm of the ratio of two such changes, ``path (n, p)`` the parameters along which
    frames are looked at, and ``runs`` are of the model.
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

    Median and bounds of 95 % are ``(b, q)``; errors, deviations and the share of the beats in which
    the truth lies within the band ``(q,)``.
    """

    mean: Rows
    low: Rows
    high: Rows
    rms_error: Vector
    mean_std: Vector
    coverage: Vector


@dataclass(frozen=True, slots=True)
class Drift:
    """A modulus that drifts from beat to beat, from the beats so far (filter) and from all.

    ``times`` in s are those of the frames of each beat, ``truth (b, q)``, and ``assumed_std`` is of
    the change of a logarithm from one beat to the next.
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
    """What follows for parameters ``(p,)`` from ever more frames, and from parts of the cycle.

    ``drift`` says why it was not followed, if it was not; runs are compared by ``measures``.
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
