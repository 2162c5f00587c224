"""What is found out about a case, and what its estimate expects of geometry and law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mvest.cases.case import ValveCase
from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.personalisation.estimation import CaseEstimate, CaseProblem, joint, slopes
from mvest.personalisation.geometry import displacement
from mvest.personalisation.known import DataAlone, Narrower, Quantity, VarianceShare
from mvest.personalisation.settings import PersonaliseSettings
from mvest.personalisation.sources import LAW
from mvest.problem.estimate import StudyResult
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

_UNITS = {
    "shape": ("mm", 1.0),
    "annulus": ("mm", 1.0),
    "tips": ("mm", 1.0),
    "insertions": ("mm", 1.0),
    "rest_lengths": ("%", 100.0),
    "thickness": ("%", 100.0),
    "fibres": ("degrees", 180.0 / np.pi),
}
"""Part of a geometry -> unit of its errors, and how many of them one is."""


@dataclass(frozen=True, slots=True)
class GeometryShift:
    """By how much one kind of a geometry is expected to differ from what was seen.

    Attributes
    ----------
    name : str
    unit : str
    size : float
        Root of the mean square over points, chords or leaflets; of a point it is a distance.
    stretch : float
        Of the mode that is moved most, in standard deviations as they were learned.
    """

    name: str
    unit: str
    size: float
    stretch: float


def geometry_shifts(problem: CaseProblem, estimate: CaseEstimate) -> tuple[GeometryShift, ...]:
    """What the estimate expects of each kind of the geometry, to first order about it.

    Empty where nothing of the geometry is in doubt, or samples of its errors say what it is.
    """
    errors, result = estimate.errors, estimate.result
    posterior, filtered = joint(problem, result, errors), result.filtered
    if posterior is None or errors.samples is not None:
        return ()
    assert filtered is not None
    assert filtered.prediction is not None
    assert result.observation is not None
    expected = posterior.expected(result.observation.y - filtered.prediction.y)
    scales = errors.geometry_sizes(filtered.learned)
    shifts = []
    for source, modes, scale in zip(errors.geometry, expected, scales, strict=True):
        assert source.modes is not None
        # What else follows, as rest lengths do where tips are elsewhere, is not told.
        part = next(iter(source.modes.parts))
        moved = displacement((source.modes,), (modes,))[part]
        unit, factor = _UNITS[part]
        square = np.sum(moved**2, axis=-1) if moved.ndim > 1 else moved**2
        size = factor * float(np.sqrt(np.mean(square)))
        shifts.append(GeometryShift(source.name, unit, size, float(np.max(np.abs(modes)) / scale)))
    return tuple(shifts)


def law_share(estimate: CaseEstimate) -> float | None:
    """How far all tissue is on its way from the linear law to the other that may be right.

    Where what was seen is most probable, to first order about the estimate. It rests on the same
    errors and priors as the estimate. None where no other law was given, or there is no estimate.
    """
    errors, result = estimate.errors, estimate.result
    filtered = result.filtered
    rows = [source.rows for source in errors.sources if source.name == LAW]
    if not rows or filtered is None or filtered.prediction is None:
        return None
    assert result.observation is not None
    way, samples = rows[0].sum(axis=1), errors.samples
    beside = None if samples is None else samples.columns
    noise = errors.noise(filtered.learned, without=(LAW,), beside=beside)
    prior, z = to_filter(filtered.transform, filtered.prior), filtered.transformed.mean
    H = slopes(filtered)
    innovation = result.observation.y - filtered.prediction.y + H @ (z - prior.mean)

    def misfit(e: FloatArray) -> float:
        return kalman_update(prior, e, H, noise).nis

    whole = misfit(way)
    # A parabola through its values with either law.
    return 0.5 + 0.5 * (misfit(innovation) - misfit(innovation - way)) / whole if whole else None


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What an estimate knows beside its unknowns, and what limits it; empty without an estimate.

    Attributes
    ----------
    quantities : tuple of Quantity
        Ratio of the moduli, moduli for the stated pressure, strains.
    data_alone : tuple of DataAlone
        Moduli without their priors.
    shares : tuple of VarianceShare
        Where the variance of each modulus comes from.
    narrower : tuple of Narrower
        What may be measured besides, and what it gains.
    geometry : tuple of GeometryShift
        By how much the geometry is expected to differ from what was seen.
    law_share : float or None
        How far the tissue is expected to be on its way from the linear law to another.
    """

    quantities: tuple[Quantity, ...] = ()
    data_alone: tuple[DataAlone, ...] = ()
    shares: tuple[VarianceShare, ...] = ()
    narrower: tuple[Narrower, ...] = ()
    geometry: tuple[GeometryShift, ...] = ()
    law_share: float | None = None


@dataclass(frozen=True, slots=True)
class Expected:
    """What can be expected of an estimate; without unknowns the reason why that is not known.

    Attributes
    ----------
    unknowns : sequence of mapping
        As `mvest.problem.estimate.expected_intervals` returns them.
    shares, narrower
        As in `Known`.
    reason : str
    """

    unknowns: Sequence[Mapping[str, Any]] = ()
    shares: tuple[VarianceShare, ...] = ()
    narrower: tuple[Narrower, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class FrameDistance:
    """How far a frame as seen is from the closed valve of the model.

    Attributes
    ----------
    frame : str
    seen : bool
        Whether the filter was shown it.
    generic, registered, personalised : (k,) mm
        With generic values of all unknowns; the same, displaced rigidly to lie closest to the
        closed frame (as it is where vertices do not correspond); and with the estimated unknowns.
        Of each corresponding vertex, or of each point as seen from the predicted surface.
    """

    frame: str
    seen: bool
    generic: FloatArray
    registered: FloatArray
    personalised: FloatArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Personalised:
    """All that is found out about a case.

    Attributes
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    mesh : SolidMesh
    result : StudyResult
    moduli_only : StudyResult or None
        With all nuisances fixed.
    paper : StudyResult or None
        As the paper does it.
    distances : tuple of FrameDistance
        Empty if there is no estimate.
    generic, registered, fitted : mapping of str to (n, 3) mm
        Frame -> predicted vertices; fitted as they are seen.
    confirmed_mm : float or None
        Largest distance of the fitted closed valve from the one closed anew.
    seconds : mapping of str to float
        Wall-clock time of each part.
    known : Known
        What follows from the estimate, and what limits it.
    error_samples : int
        How many error samples of the frames entered.
    unaccounted : tuple of str
        Why some errors of geometry or law are not in the intervals.
    moved : float or None
        Standard deviations of a modulus, at most, by which the estimate is away from where geometry
        and moduli were linearised anew for the last time; None where they were not.
    """

    case: ValveCase
    settings: PersonaliseSettings
    mesh: SolidMesh
    result: StudyResult
    moduli_only: StudyResult | None
    paper: StudyResult | None
    distances: tuple[FrameDistance, ...]
    generic: Mapping[str, FloatArray]
    registered: Mapping[str, FloatArray]
    fitted: Mapping[str, FloatArray]
    confirmed_mm: float | None
    seconds: Mapping[str, float]
    known: Known = field(default_factory=Known)
    error_samples: int = 0
    unaccounted: tuple[str, ...] = ()
    moved: float | None = None

    def __str__(self) -> str:
        distances = [
            f"{one.frame}: {np.nanmean(one.generic):.2f} mm generic, "
            f"{np.nanmean(one.personalised):.2f} mm personalised"
            + ("" if one.seen else " (held out)")
            for one in self.distances
        ]
        return "\n".join([f"case {self.case.name}", str(self.result), *distances])
