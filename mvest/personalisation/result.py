"""What is found out about a case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvest.cases.case import ValveCase
from mvest.estimation.gaussian import Gaussian
from mvest.personalisation.error_budget import BudgetRow
from mvest.personalisation.expected import GeometryShift
from mvest.personalisation.geometry_errors import GeometryErrors
from mvest.personalisation.settings import PersonaliseSettings
from mvest.problem.estimate import StudyResult
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh


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
