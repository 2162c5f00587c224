"""Results of a personalisation and of its prediction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mvest.cases.case import Frame, ValveCase
from mvest.personalisation.calibration import FoundCalibration
from mvest.personalisation.settings import PersonaliseSettings
from mvest.problem.estimate import StudyResult
from mvest.problem.record import Row
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected precision of an estimate; without unknowns, the reason why it is unknown."""

    unknowns: Sequence[Mapping[str, Any]] = ()  #: from `mvest.problem.estimate.expected_intervals`
    shares: Sequence[Row] = ()  #: rows as in `mvest.personalisation.record`
    narrower: Sequence[Row] = ()  #: rows as in `mvest.personalisation.record`
    #: Of the generic valve, closed on a coarse mesh, or of the open frame if nothing was closed.
    physiology: Sequence[Row] = ()
    resistance: Sequence[Row] = ()  #: rows as in `mvest.personalisation.record`
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class FrameComparison:
    """An observed frame, three predictions of it, and their distances from it."""

    frame: Frame
    seen: bool  #: whether the filter received it
    #: Model -> its vertices ``(n, 3)`` mm. The models are ``generic`` (generic values of all
    #: unknowns), ``registered`` (the same, rigidly aligned with the closed frame; not aligned
    #: without correspondence) and ``personalised`` (estimated unknowns).
    positions: Mapping[str, FloatArray]
    #: Model -> distance ``(k,)`` mm of each corresponding vertex, or of each observed point from
    #: the predicted surface.
    distances: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Personalised:
    """Result of a personalisation."""

    case: ValveCase
    settings: PersonaliseSettings
    mesh: SolidMesh
    result: StudyResult
    #: ``moduli_only`` and ``paper``, see `mvest.personalisation.settings.CaseChoices`.
    alternatives: Mapping[str, StudyResult]
    #: Fitted frames first, the closed one at the front; empty without an estimate.
    frames: tuple[FrameComparison, ...] = ()
    #: Largest distance of the fitted closed valve from one closed from the open state.
    confirmed_mm: float | None = None
    #: ``geometry``, ``known``, ``data_alone``, ``narrower`` and ``shares`` as in
    #: `mvest.personalisation.record`; empty without an estimate.
    details: Mapping[str, tuple[Row, ...]] = field(default_factory=dict)
    #: Estimated position of the tissue between the linear law (0) and another (1).
    law_share: float | None = None
    error_samples: int = 0  #: number of error samples of the frames
    #: Why some errors of geometry or law are not in the intervals.
    unaccounted: tuple[str, ...] = ()
    #: Largest distance of a modulus from the last linearisation point of the geometry, in standard
    #: deviations; None if that is the measured geometry.
    moved: float | None = None
    #: Applied by `mvest.personalisation.record`; ``result`` is uncalibrated.
    calibration: FoundCalibration = field(default_factory=FoundCalibration)

    def __str__(self) -> str:
        frames = [
            f"{one.frame.name}: {np.nanmean(one.distances['generic']):.2f} mm generic, "
            f"{np.nanmean(one.distances['personalised']):.2f} mm personalised"
            + ("" if one.seen else " (held out)")
            for one in self.frames
        ]
        return "\n".join([f"case {self.case.name}", str(self.result), *frames])
