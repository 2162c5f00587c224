"""Findings of a virtual patient in a simulated volume."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.estimates import Data, SeedRun
from mvest.reporting.case.findings import FrameDistances, ImageErrors, UnknownRow

__all__ = ["KNOWN", "Findings", "KnownGeometry", "Row"]

KNOWN = "known"
"""Folder of the estimation from the known geometry, in that of the run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A modulus of a leaflet, MPa: as it is, as is said without an estimation, and as estimated.

    From the volume with its 95 % interval, and from the known geometry; None without an estimate.
    """

    patient: str
    modulus: str
    truth: float
    generic: float
    estimate: float | None = None
    low: float | None = None
    high: float | None = None
    known_geometry: float | None = None

    @property
    def inside(self) -> bool | None:
        """Whether the interval contains the truth; None without one."""
        if self.low is None or self.high is None:
            return None
        return self.low <= self.truth <= self.high


@dataclass(frozen=True, slots=True)
class KnownGeometry:
    """The estimation from where the valve truly was; without unknowns if it left nothing."""

    converged: bool
    reason: str
    unknowns: tuple[UnknownRow, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows from a volume, beside the truth and what follows from the known geometry.

    What is of the volume is empty or None if its estimation left nothing. ``repeats`` are the
    moduli, by which runs are compared; anatomies were drawn until one closed as a valve does.
    """

    rows: tuple[Row, ...]
    unknowns: tuple[UnknownRow, ...]
    known_geometry: KnownGeometry
    image_errors: ImageErrors | None = None
    distances: tuple[FrameDistances, ...] = ()
    repeats: tuple[SeedRun, ...] = ()
    data: Data | None = None
    anatomies_drawn: int | None = None
