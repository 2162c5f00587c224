"""Findings of a virtual patient in a simulated volume."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from experiments.common.records.estimates import Data, SeedRun
from mvest.problem.verdict import NONE
from mvest.reporting.case.findings import Cost, FrameDistances, ImageErrors, UnknownRow

__all__ = ["KNOWN", "SEGMENTED", "Findings", "KnownGeometry", "Row"]

KNOWN = "known"
"""Folder of the estimation from the known geometry, in that of the run."""

SEGMENTED = "segmented"
"""That of the one from a perfect segmentation of the same volume."""


@dataclass(frozen=True, slots=True)
class Row:
    """A modulus as it was estimated from the volume, and as it was from better ones, MPa.

    These are the known geometry and a perfect segmentation. The truth was revealed. None has an
    estimate where that did not converge. The verdict is on the estimate from the volume.
    """

    patient: str
    modulus: UnknownRow
    known_geometry: float | None
    segmented: float | None = None
    verdict: str = ""

    @property
    def as_stated(self) -> UnknownRow:
        """The modulus, without an estimate where the verdict is that there is none."""
        if self.verdict != NONE:
            return self.modulus
        return replace(self.modulus, estimate=None, std=None, low=None, high=None)


@dataclass(frozen=True, slots=True)
class KnownGeometry:
    """An estimation from where the valve truly was; without unknowns if it left nothing."""

    converged: bool
    reason: str
    unknowns: tuple[UnknownRow, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows from a volume, beside the truth and what follows from the known geometry.

    What is of the volume is empty or None if its estimation left nothing. ``repeats`` are the
    moduli, by which runs are compared; anatomies were drawn until one closed as a valve does.
    Of each family of chordae the true rest lengths over the distance of their ends in the closed
    valve are revealed, too: estimators lay chordae out by a typical one.
    """

    rows: tuple[Row, ...]
    unknowns: tuple[UnknownRow, ...]
    known_geometry: KnownGeometry
    segmented: KnownGeometry | None = None
    image_errors: ImageErrors | None = None
    budget: tuple[Cost, ...] = ()
    distances: tuple[FrameDistances, ...] = ()
    repeats: tuple[SeedRun, ...] = ()
    data: Data | None = None
    anatomies_drawn: int | None = None
    chord_ratios: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
