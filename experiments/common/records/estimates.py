"""What records say of an estimate of p parameters; errors are signed parts of the truth."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.records.findings import Rows, Vector
from experiments.common.records.record import Status
from mvest.reporting.findings import Identified, Innovation, Spread

__all__ = ["Data", "Identified", "Innovation", "Paper", "SeedRun", "Spread"]


@dataclass(frozen=True, slots=True)
class Data:
    """A recording, and the SHA-256 of its file."""

    citation: str | None
    sha256: str


@dataclass(frozen=True, slots=True)
class Paper:
    """What the paper reports of the same experiment: ``(p,)`` MPa and %, mean and SD of the others.

    Errors of all moduli are in %, distances of all vertices in mm; None where it says nothing.
    """

    table: str
    estimate: Vector | None = None
    error_percent: Vector | None = None
    moduli_error_percent: Vector | None = None
    distance_mm: Vector | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SeedRun:
    """The estimate from the observation of one seed; None where a run did not get so far.

    Attributes
    ----------
    seed : int or None
        None where a job was lost that does not say which seeds it had.
    status, reason, detail : str
    estimate, std, relative_error, bound : (p,) or None
        The bound is the Cramér-Rao standard deviation.
    distance_mm, distance_to_truth_mm : Spread or None
        Of the fitted vertices from the observed ones, and from the true ones.
    nis, nis_band : float and (2,), or None
        Normalised innovation squared, and where 95 % of such values lie.
    iterations, forward_solves : int or None
    iterates, iterate_std : (i, p) or None
    seconds : float or None
    """

    seed: int | None
    status: Status
    reason: str
    detail: str = ""
    estimate: Vector | None = None
    std: Vector | None = None
    relative_error: Vector | None = None
    bound: tuple[float | None, ...] | None = None
    distance_mm: Spread | None = None
    distance_to_truth_mm: Spread | None = None
    nis: float | None = None
    nis_band: tuple[float, float] | None = None
    iterations: int | None = None
    forward_solves: int | None = None
    iterates: Rows | None = None
    iterate_std: Rows | None = None
    seconds: float | None = None

    @property
    def converged(self) -> bool:
        """Whether it has an estimate."""
        return self.status == "converged"
