"""Findings on moduli from surfaces as they arrive; lengths in mm, moduli in MPa."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.cases.case import Frame, ValveCase
from mvest.problem.verdict import Verdict
from mvest.reporting.case.findings import PosteriorCheck, UnknownRow
from mvest.typing import FloatArray
from mvest.valve.geometry.proximity import closest_points

__all__ = ["Findings", "SurfaceError", "ThicknessError", "thickness_error"]


@dataclass(frozen=True, slots=True)
class SurfaceError:
    """Distances of a midsurface from the true one: root mean square and largest.

    ``there`` from its vertices, ``back`` from those of the true one to it.
    """

    there_mm: float
    back_mm: float
    largest_mm: float

    @classmethod
    def of(cls, found: Frame, true: Frame) -> SurfaceError:
        """The error of a frame."""
        there, back = (
            closest_points(a.vertices, b.vertices, b.triangles).distance
            for a, b in ((found, true), (true, found))
        )
        return cls(_rms(there), _rms(back), float(max(there.max(), back.max())))


@dataclass(frozen=True, slots=True)
class ThicknessError:
    """Thickness of the open midsurface less the true one at the nearest point."""

    mean_mm: float
    rms_mm: float


def thickness_error(case: ValveCase, true: Frame, thickness_mm: FloatArray) -> ThicknessError:
    """The error of a case, where the thickness ``(n,)`` mm of the true vertices is known."""
    nearest = closest_points(case.surface.vertices, true.vertices, true.triangles)
    off = case.surface.thickness - nearest.interpolate(thickness_mm, true.triangles)
    return ThicknessError(float(off.mean()), _rms(off))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """How a geometry arrived, and the moduli that came of it.

    Attributes
    ----------
    patient, kind, door : str
        Kind of the door, and what tables call it.
    opened, closed : SurfaceError
        Of the frames of the case.
    thickness : ThicknessError
    derived : tuple of str
        Sentences of the case on what was not given.
    moduli, nuisances : tuple of UnknownRow
        Of the moduli the truth is known. Estimates are None where there are none.
    posterior : PosteriorCheck or None
    verdict : Verdict or None
        None where the estimation left nothing.
    reason : str
        Why it ended.
    cpu_s : float
        Of the process that estimated.
    """

    patient: str
    kind: str
    door: str
    opened: SurfaceError
    closed: SurfaceError
    thickness: ThicknessError
    derived: tuple[str, ...]
    moduli: tuple[UnknownRow, ...]
    nuisances: tuple[UnknownRow, ...] = ()
    posterior: PosteriorCheck | None = None
    verdict: Verdict | None = None
    reason: str
    cpu_s: float
