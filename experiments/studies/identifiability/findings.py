"""Findings of the study of designs: what each observation would tell, and what it would need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from experiments.common.findings import Rows, Vector
from experiments.studies.identifiability.settings import DesignsSettings

__all__ = ["Design", "Expected", "Findings", "Joint", "Profile"]


@dataclass(frozen=True, slots=True)
class Expected:
    """What a design tells of one modulus, with one knowledge of the nuisances.

    Attributes
    ----------
    knowledge : str
        One of ``settings.knowledge``.
    parameter : str
    std : mapping
        Noise in mm, as text -> relative standard deviation; None where it is unbounded.
    needed_noise_mm : float or None
        With which the modulus is known to the target; None if any will do.
    needed_repeats : float or None
        Observations with the typical noise that are needed for that; None if no number will do.
    """

    knowledge: str
    parameter: str
    std: Mapping[str, float | None]
    needed_noise_mm: float | None
    needed_repeats: float | None


@dataclass(frozen=True, slots=True)
class Joint:
    """What a design tells of q parameters together, those that profiles hold being known.

    Attributes
    ----------
    names : tuple of str, (q,)
    covariance : (q, q)
        Relative, with the typical noise; None where it is unbounded.
    confounded : tuple of mapping
        See :func:`mvest.reporting.expectation.confounded_record`.
    condition_number : float or None
    """

    names: tuple[str, ...]
    covariance: tuple[tuple[float | None, ...], ...]
    confounded: tuple[Mapping[str, Any], ...]
    condition_number: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """One observation, before it is made.

    Attributes
    ----------
    frames : str
        In words.
    frame_count : int
    vertices, vertices_words : str
        Name of the set of vertices, and what a reader calls it.
    points : int
        Number of these vertices.
    errors : str
        How they are correlated.
    moduli : tuple of Expected
    joint : Joint or None
        Of designs with all vertices.
    pressure : mapping
        Modulus -> relative standard deviation of the pressure beforehand with which it is known to
        the target; None if the pressure need not be known.
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
    """A profile likelihood of one of q parameters, at k points.

    Attributes
    ----------
    label, vertices : str
        Of the observation that was followed.
    parameter : str
    parameters : tuple of str, (q,)
    path : (k, q)
        Parameters with the least misfit where this one is held.
    deviance : (k,)
    threshold : float
        Of the deviance, for 95 %.
    low, high : float or None
        Ends of the interval; None where the profile does not reach the threshold.
    ends : (2,)
        Why the profile was not followed farther, below and above.
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
    """What follows for p parameters; no designs of a valve that does not close.

    Attributes
    ----------
    assumed : (p,)
        Values at which everything is computed.
    settings : DesignsSettings
    designs : tuple of Design
    profiles : tuple of Profile
    """

    assumed: Vector
    settings: DesignsSettings
    designs: tuple[Design, ...] = ()
    profiles: tuple[Profile, ...] = ()
