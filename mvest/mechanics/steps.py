"""Input and result of a simulation: steps, settings, frames, reasons."""

from dataclasses import dataclass
from enum import Enum

from mvest.errors import InputError
from mvest.quantities import Count, DampingRate, Halvings, Length, Tolerance
from mvest.typing import FloatArray


class StepReason(Enum):
    """Why a simulation stopped."""

    COMPLETED = "completed"
    NO_CONVERGENCE = "Newton's method did not converge at the smallest step"
    INTERSECTION = "leaflets pass through each other at the smallest step"
    SINGULAR = "the tangent could not be factorised"


@dataclass(frozen=True, slots=True)
class Damping:
    """Rayleigh damping ``C = alpha M + beta K``."""

    alpha: DampingRate = 0.1  #: 1/s, mass-proportional
    #: s, stiffness-proportional; applied to the strain rate (see :mod:`mvest.mechanics.law.biot`)
    beta: DampingRate = 0.1

    def __post_init__(self) -> None:
        if not (self.alpha >= 0 and self.beta >= 0):
            raise InputError(f"damping alpha = {self.alpha}, beta = {self.beta}, expected >= 0")


@dataclass(frozen=True, slots=True)
class NewtonSettings:
    """How each step is solved."""

    tolerance: Tolerance = 1e-9  #: norm of the residual over the norm of the largest force
    #: the same for intermediate steps if only the final equilibrium is needed
    path_tolerance: Tolerance = 1e-1
    max_iterations: Count = 60
    max_halvings: Halvings = 8  #: largest number of halvings of a failing step
    #: one exact linear solve per step, SOFA's default: linearised at the current state, without
    #: load stiffness and without a check of convergence
    single_solve: bool = False
    largest_move: Length = 4.0  #: largest move of a node in one iteration, mm
    smallest_move: Length = 1e-10  #: mm; a smaller correction is round-off and counts as converged

    def __post_init__(self) -> None:
        positive = self.tolerance > 0 and self.path_tolerance > 0
        if not positive or self.max_iterations < 1 or self.max_halvings < 0:
            raise InputError(f"inadmissible Newton settings: {self}")


@dataclass(frozen=True, slots=True)
class Step:
    """One time step: its end time (s) and whether it is static (no inertia, no damping)."""

    time: float
    static: bool = False


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Statistics of one accepted (sub)step."""

    #: s
    time: float
    dt: float
    residuals: tuple[float, ...]  #: relative residual before each iteration and after the last
    active_contacts: int  #: pairs within reach
    halvings: int  #: halvings of the step, or rests before a static step


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """Result of a forward run; a failure is a value."""

    times: FloatArray  #: (f,) s, of the completed steps, the initial state first
    #: (f, n, 3) mm and (f, p, n, 3) mm per unit of each parameter
    frames: FloatArray
    sensitivities: FloatArray
    reason: StepReason
    records: tuple[StepRecord, ...]
    solver: str = ""  #: the solver of the linear systems, and its substitutes

    @property
    def converged(self) -> bool:
        """Whether all steps were completed."""
        return self.reason is StepReason.COMPLETED

    @property
    def iterations(self) -> int:
        """Newton iterations in all."""
        return sum(len(r.residuals) - 1 for r in self.records)
