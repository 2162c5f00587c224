"""What an estimate expects of that which was considered beside its unknowns: geometry and law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.personalisation.considered_geometry import displacement
from mvest.personalisation.considered_law import LAW
from mvest.personalisation.estimation import CaseEstimation
from mvest.problem.estimate import StudyResult
from mvest.typing import FloatArray

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


def geometry_shifts(estimation: CaseEstimation, result: StudyResult) -> tuple[GeometryShift, ...]:
    """What the estimate expects of each kind of the geometry, to first order about it.

    Empty where nothing of the geometry was considered, or samples of its errors say what it is.
    """
    posterior, filtered = estimation.joint(result, estimation.errors), result.filtered
    if posterior is None or estimation.errors.samples is not None:
        return ()
    assert filtered is not None
    assert filtered.prediction is not None
    assert result.observation is not None
    assert posterior.errors.known is not None
    expected = posterior.expected(result.observation.y - filtered.prediction.y)
    scales = posterior.errors.sizes(filtered.learned)
    shifts = []
    for own, modes, scale in zip(posterior.errors.known.modes, expected, scales, strict=True):
        # What else follows, as rest lengths do where tips are elsewhere, is not told.
        part = next(iter(own.parts))
        moved = displacement((own,), (modes,))[part]
        unit, factor = _UNITS[part]
        square = np.sum(moved**2, axis=-1) if moved.ndim > 1 else moved**2
        size = factor * float(np.sqrt(np.mean(square)))
        shifts.append(GeometryShift(own.name, unit, size, float(np.max(np.abs(modes)) / scale)))
    return tuple(shifts)


def law_share(estimation: CaseEstimation, result: StudyResult) -> float | None:
    """How far all tissue is on its way from the linear law to the other that is considered.

    Where what was seen is most probable, to first order about the estimate. It rests on the same
    errors and priors as the estimate. None where no law was considered, or there is no estimate.
    """
    errors, filtered = estimation.errors, result.filtered
    columns = [own.columns for own in errors.considered if own.name == LAW]
    if not columns or filtered is None or filtered.prediction is None:
        return None
    assert result.observation is not None
    way, samples = columns[0].sum(axis=1), errors.samples
    beside = None if samples is None else samples.columns
    noise = errors.noise(filtered.learned, without=(LAW,), beside=beside)
    prior, z = to_filter(filtered.transform, filtered.prior), filtered.transformed.mean
    H = filtered.prediction.jacobian * filtered.transform.derivative(z)
    innovation = result.observation.y - filtered.prediction.y + H @ (z - prior.mean)

    def misfit(e: FloatArray) -> float:
        return kalman_update(prior, e, H, noise).nis

    whole = misfit(way)
    # A parabola through its values with either law.
    return 0.5 + 0.5 * (misfit(innovation) - misfit(innovation - way)) / whole if whole else None
