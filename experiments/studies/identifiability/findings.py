"""Findings of the study of designs: what each observation would tell, and what it would need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.records.findings import Rows, Vector
from experiments.studies.identifiability.settings import DesignsSettings
from mvest.reporting.findings import Alike

__all__ = ["Design", "Expected", "Findings", "Joint", "Profile"]


@dataclass(frozen=True, slots=True)
class Expected:
    """What a design tells of one modulus, with one of ``settings.knowledge`` of the nuisances.

    ``std`` is relative, by the noise in mm as text, None where it is unbounded. With
    ``needed_noise_mm`` the modulus is known to the target, None if any will do; that takes
    ``needed_repeats`` observations with the typical noise, None if no number will do.
    """

    knowledge: str
    parameter: str
    std: Mapping[str, float | None]
    needed_noise_mm: float | None
    needed_repeats: float | None


@dataclass(frozen=True, slots=True)
class Joint:
    """What a design tells of q parameters together, those that profiles hold being known.

    ``covariance (q, q)`` is relative, with the typical noise, None where it is unbounded.
    """

    names: tuple[str, ...]
    covariance: tuple[tuple[float | None, ...], ...]
    confounded: tuple[Alike, ...]
    condition_number: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """One observation, before it is made: ``points`` vertices in frames and with errors in words.

    ``joint`` is of designs with all vertices only. ``pressure`` says for each modulus how well, as
    a relative standard deviation, the pressure must be known beforehand for the modulus to be known
    to the target; None if it need not be known.
    """

    frames: str
    frame_count: int
    vertices: str
    vertices_words: str
    points: int
    errors: str
    moduli: tuple[Expected, ...]
    joint: Joint | None
    pressure: Mapping[str, float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """A profile likelihood of one of q parameters from one observation, at k points.

    ``path (k, q)`` are the parameters with the smallest misfit where this one is held, ``deviance
    (k,)`` is to be compared with ``threshold`` for 95 %, ``low`` and ``high`` are None where that
    is not reached, and ``ends`` says why the profile was not followed farther, below and above.
    """

    label: str
    vertices: str
    parameter: str
    parameters: tuple[str, ...]
    path: Rows
    deviance: Vector
    threshold: float
    low: float | None
    high: float | None
    ends: tuple[str, str]

    @property
    def at(self) -> int:
        """Where the parameter is among those of the path."""
        return self.parameters.index(self.parameter)


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows at the assumed values ``(p,)``; no designs of a valve that does not close."""

    assumed: Vector
    settings: DesignsSettings
    designs: tuple[Design, ...] = ()
    profiles: tuple[Profile, ...] = ()
