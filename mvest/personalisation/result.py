"""What is found out about a case, and what its estimate says of the marginalised parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvest.cases.case import ValveCase
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.personalisation.considered_geometry import displacement
from mvest.personalisation.considered_law import LAW
from mvest.personalisation.error_budget import BudgetRow
from mvest.personalisation.estimation import CaseEstimation
from mvest.personalisation.geometry_errors import GeometryErrors
from mvest.personalisation.settings import PersonaliseSettings
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


@dataclass(frozen=True, slots=True, eq=False)
class Personalised:
    """All that is found out about a case.

    Attributes
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    mesh : SolidMesh
    names : tuple of str, (p,)
        Unknowns that are estimated.
    prior : Gaussian
        Of these.
    result : StudyResult
    moduli_only : StudyResult or None
        With all nuisances fixed.
    paper : StudyResult or None
        As the paper does it.
    distances : tuple of FrameDistance
        Empty if there is no estimate.
    generic, registered, fitted : mapping of str to (n, 3) mm
        Frame -> predicted vertices; fitted as they are seen.
    narrower : mapping of str to (q,)
        What if something were known: standard deviation of the logarithm of each modulus, under
        ``now``, ``pressure measured to ±2.4 mmHg``, ``4 beats averaged`` and so on.
    confirmed_mm : float or None
        Largest distance of the fitted closed valve from the one closed anew.
    seconds : mapping of str to float
        Wall-clock time of each part.
    geometry : GeometryErrors or None
        What the case's error samples do to the prediction; None if it has none.
    image_share : (q,) or None
        Share of the variance of the logarithm of each modulus that these account for; None where
        they did not enter.
    unconsidered : tuple of str
        Why what is to be considered of geometry and law was not.
    budget : tuple of BudgetRow
        What each part of what is not known costs the moduli, where error samples are given.
    moved : float or None
        Standard deviations of a modulus, at most, by which the estimate is away from where geometry
        and moduli were linearised anew for the last time; None where they were not.
    expected_geometry : tuple of GeometryShift
        By how much the geometry is expected to differ from what was seen.
    law_share : float or None
        How far the tissue is expected to be on its way from the linear law to another.
    """

    case: ValveCase
    settings: PersonaliseSettings
    mesh: SolidMesh
    names: tuple[str, ...]
    prior: Gaussian
    result: StudyResult
    moduli_only: StudyResult | None
    paper: StudyResult | None
    distances: tuple[FrameDistance, ...]
    generic: Mapping[str, FloatArray]
    registered: Mapping[str, FloatArray]
    fitted: Mapping[str, FloatArray]
    narrower: Mapping[str, FloatArray]
    confirmed_mm: float | None
    seconds: Mapping[str, float]
    geometry: GeometryErrors | None = None
    image_share: FloatArray | None = None
    unconsidered: tuple[str, ...] = ()
    budget: tuple[BudgetRow, ...] = ()
    moved: float | None = None
    expected_geometry: tuple[GeometryShift, ...] = ()
    law_share: float | None = None

    def __str__(self) -> str:
        distances = [
            f"{one.frame}: {np.nanmean(one.generic):.2f} mm generic, "
            f"{np.nanmean(one.personalised):.2f} mm personalised"
            + ("" if one.seen else " (held out)")
            for one in self.distances
        ]
        return "\n".join([f"case {self.case.name}", str(self.result), *distances])
