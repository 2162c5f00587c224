"""Findings of an estimate with a program as the model."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.records.estimates import Innovation, Spread
from experiments.common.records.findings import Rows, Vector

__all__ = ["Findings", "Program"]


@dataclass(frozen=True, slots=True)
class Program:
    """How a program that predicts so many points was used: runs started, and served again."""

    command: tuple[str, ...]
    points: int
    runs: int
    reused: int
    seconds: float
    own_jacobian: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p parameters; None where there is no estimate.

    Attributes
    ----------
    units : tuple of str, (p,)
    initial, prior_std : (p,)
    estimate, std : (p,) or None
    iterates, iterate_std : (i, p)
    distance_mm : Spread or None
        Of the predicted points from where they were observed.
    innovation : Innovation or None
    iterations : int
    seconds : float
        Of the estimation.
    program : Program
    """

    units: tuple[str, ...]
    initial: Vector
    prior_std: Vector
    estimate: Vector | None
    std: Vector | None
    iterates: Rows
    iterate_std: Rows
    distance_mm: Spread | None
    innovation: Innovation | None
    iterations: int
    seconds: float
    program: Program
