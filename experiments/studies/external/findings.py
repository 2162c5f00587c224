"""Findings of an estimate with a program as the model."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.estimates import Innovation, Matrix, Spread, Vector

__all__ = ["Findings", "Program"]


@dataclass(frozen=True, slots=True)
class Program:
    """How the program was used.

    Attributes
    ----------
    command : tuple of str
    points : int
        That it predicts.
    runs, reused : int
        Started, and finished ones that served again.
    seconds : float
        Of all its runs.
    own_jacobian : bool
        Whether it gives derivatives.
    """

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
    iterates: Matrix
    iterate_std: Matrix
    distance_mm: Spread | None
    innovation: Innovation | None
    iterations: int
    seconds: float
    program: Program
