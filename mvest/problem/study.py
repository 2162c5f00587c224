"""The one joint of data, model and filter: observation and case in, estimate and its errors out.

The truth of a synthetic study is kept apart. ``simulate_observation`` returns it beside the
observation; ``estimate`` takes the observation and a case and never sees it; only the finished
``StudyResult`` is compared with it (``StudyResult.against``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mvest.errors import InputError
from mvest.estimation.estimate import Estimate, Filter, OnIterate
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.identifiability import Identifiability, identifiability
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import ObservationModel, as_prediction, require_finite
from mvest.estimation.transform import Transform
from mvest.mechanics.settings import TissueSettings
from mvest.observation.errors import ObservationError, SpatialCorrelation, observe
from mvest.observation.vertices import (
    FRAMES,
    Observation,
    require_frames,
    select_frames,
)
from mvest.typing import FloatArray

__all__ = [
    "FRAMES",
    "Case",
    "Modulus",
    "Observation",
    "Observed",
    "StudyResult",
    "Truth",
    "TwinData",
    "estimate",
    "simulate_observation",
]


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What a synthetic observation was made from; no filter is given one.

    Attributes
    ----------
    parameters : tuple of str, (p,)
    values : (p,) in the units of the parameters
    positions : (f, n, 3) mm
        The observed frames before noise was added.
    """

    parameters: tuple[str, ...]
    values: FloatArray
    positions: FloatArray


class Observed(Protocol):
    """What an estimation needs of an observation, whatever its kind."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames, the closed one last."""
        ...

    @property
    def y(self) -> FloatArray:
        """The observation ``(k,)``."""
        ...

    @property
    def R(self) -> NoiseCovariance:
        """Covariance of ``y``."""
        ...

    def of(self, model: ObservationModel, /) -> ObservationModel:
        """What a model that predicts all of ``FRAMES``, stacked, predicts of this observation.

        Its predictions have for ``aux`` the observed frames ``(f, n, 3)`` mm with all vertices.
        """
        ...

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Distances (mm) of what was seen in the last frame to fitted ``(f, n, 3)``."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class TwinData:
    """A synthetic observation with the truth behind it, or the reason why there is none."""

    observation: Observation | None
    truth: Truth | None
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Everything an estimation needs besides the observation.

    Attributes
    ----------
    parameters : tuple of str, (p,)
        Names of the unknowns, for example ``E_f.anterior``.
    model : ObservationModel
        Predicts all of ``FRAMES``, stacked.
    prior : Gaussian
        Of the parameters themselves.
    filter : Filter
    transform : Transform
    tissue : mapping
        Region -> the fixed ratios from which its other moduli follow.
    """

    parameters: tuple[str, ...]
    model: ObservationModel
    prior: Gaussian
    filter: Filter
    transform: Transform
    tissue: Mapping[str, TissueSettings]

    def __post_init__(self) -> None:
        if self.prior.size != len(self.parameters):
            raise InputError(
                f"the prior has {self.prior.size} parameters, the case names "
                f"{len(self.parameters)}: {', '.join(self.parameters)}"
            )


@dataclass(frozen=True, slots=True)
class Modulus:
    """One elastic modulus of one region; MPa, and the error as a signed part of the truth."""

    region: str
    name: str
    estimate: float
    std: float
    truth: float | None = None

    @property
    def relative_error(self) -> float | None:
        """(estimate - truth) / truth."""
        return None if self.truth is None else (self.estimate - self.truth) / self.truth


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """An estimate from an observation, or the reason why there is none.

    Attributes
    ----------
    parameters : tuple of str, (p,)
    tissue : mapping
        Region -> fixed ratios.
    observation : Observed or None
        None if it could not be simulated.
    filtered : Estimate or None
        What the filter returned; None if it was never run.
    identifiability : Identifiability or None
        Cramér-Rao bound and flat directions of the data alone, at the estimate.
    reason, detail : str
    converged : bool
    seconds : float
        Wall-clock time of the estimation.
    fitted : (f, n, 3) mm or None
        Observed frames as predicted at the estimate, unseen vertices included.
    truth : Truth or None
        Added by ``against``, after the estimation.
    """

    parameters: tuple[str, ...]
    tissue: Mapping[str, TissueSettings]
    observation: Observed | None
    filtered: Estimate | None
    identifiability: Identifiability | None
    reason: str
    detail: str
    converged: bool
    seconds: float
    fitted: FloatArray | None = None
    truth: Truth | None = None

    @classmethod
    def failed(cls, case: Case, reason: str, seconds: float) -> StudyResult:
        """The result of a study that had nothing to estimate from."""
        return cls(case.parameters, case.tissue, None, None, None, reason, "", False, seconds)

    def against(self, truth: Truth | None) -> StudyResult:
        """The same result, compared with the truth."""
        if truth is not None and truth.parameters != self.parameters:
            raise InputError(f"the truth is of {truth.parameters}, not of {self.parameters}")
        return replace(self, truth=truth)

    @property
    def estimate(self) -> FloatArray | None:
        """Estimated parameters ``(p,)``; None where the model gave no prediction there."""
        known = self.filtered is not None and self.filtered.prediction is not None
        return self.filtered.mean if known and self.filtered is not None else None

    @property
    def std(self) -> FloatArray | None:
        """Standard deviations ``(p,)`` of the estimate according to the filter."""
        if self.estimate is None or self.filtered is None:
            return None
        return self.filtered.std

    @property
    def relative_error(self) -> FloatArray | None:
        """(estimate - truth) / truth, ``(p,)``."""
        if self.truth is None or self.estimate is None:
            return None
        return (self.estimate - self.truth.values) / self.truth.values

    @property
    def distance(self) -> FloatArray | None:
        """Distance ``(n,)`` mm of each vertex, fitted to observed, in the last observed frame.

        NaN where a vertex is not seen. Of seen points ``(q,)`` where no vertex is known again.
        """
        if self.fitted is None or self.observation is None:
            return None
        return self.observation.distance(self.fitted)

    @property
    def distance_to_truth(self) -> FloatArray | None:
        """As ``distance``, to the positions without errors; also of vertices that are not seen."""
        if self.fitted is None or self.truth is None:
            return None
        return np.linalg.norm(self.fitted[-1] - self.truth.positions[-1], axis=1)

    @property
    def moduli(self) -> tuple[Modulus, ...]:
        """All moduli that follow from the estimated E_f through the fixed ratios."""
        if self.estimate is None or self.std is None:
            return ()
        truth = None if self.truth is None else self.truth.values
        found = []
        for k, parameter in enumerate(self.parameters):
            kind, _, region = parameter.partition(".")
            if kind != "E_f":
                continue
            unit = self.tissue[region].material(1.0)
            for name, factor in (("E_f", 1.0), ("E_perp", unit.E_p), ("G", unit.G)):
                true = None if truth is None else factor * float(truth[k])
                found.append(
                    Modulus(
                        region,
                        name,
                        factor * float(self.estimate[k]),
                        factor * float(self.std[k]),
                        true,
                    )
                )
        return tuple(found)


def simulate_observation(
    model: ObservationModel,
    parameters: Sequence[str],
    values: FloatArray,
    *,
    frames: Sequence[str] = FRAMES,
    variance: float | FloatArray,
    correlation: SpatialCorrelation | None = None,
    errors: Sequence[ObservationError] = (),
    rng: np.random.Generator,
) -> TwinData:
    """Make a synthetic observation.

    Parameters
    ----------
    model : ObservationModel
        The truth's own model; for a study without the inverse crime not the estimator's.
    parameters : names, (p,)
    values : (p,)
        True parameters.
    frames : sequence of str
        Which of ``FRAMES`` are observed.
    variance : float or (f,) mm²
        What the filter is told about the errors.
    correlation : SpatialCorrelation, optional
        What the filter is told about their correlation; None for independent errors.
    errors : sequence of ObservationError
        What makes the observation differ from the truth, in this order.
    rng : numpy.random.Generator

    Returns
    -------
    TwinData
        Without an observation, and with the model's reason, if the model failed.

    Raises
    ------
    InputError
        On inadmissible errors, frames or values.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.shape != (len(parameters),):
        raise InputError(
            f"{values.size} true values for the {len(parameters)} parameters "
            f"{', '.join(parameters)}"
        )
    require_finite(values, "the true values")
    require_frames(frames)
    prediction = as_prediction(model(values), values.size)
    if not prediction.converged:
        return TwinData(None, None, f"no synthetic observation: {prediction.reason}")
    positions = select_frames(prediction.y, frames).reshape(len(frames), -1, 3)
    seen = observe(positions, errors, rng)
    observation = Observation(tuple(frames), seen, np.asarray(variance), correlation)
    return TwinData(observation, Truth(tuple(parameters), values, positions), prediction.reason)


def estimate(
    case: Case, observation: Observed, *, on_iterate: OnIterate | None = None
) -> StudyResult:
    """Estimate the parameters of a case from an observation.

    Numerical failure is a result with its reason; only inadmissible input raises.
    """
    started = time.perf_counter()
    R = observation.R
    filtered = case.filter(
        observation.of(case.model),
        case.prior,
        observation.y,
        R,
        names=case.parameters,
        transform=case.transform,
        on_iterate=on_iterate,
    )
    bound = fitted = None
    if filtered.prediction is not None:
        aux = filtered.prediction.aux
        fitted = aux if isinstance(aux, np.ndarray) else None
        # What is estimated near zero has its prior for a size.
        bound = identifiability(
            filtered.prediction.jacobian,
            R,
            np.maximum(np.abs(filtered.mean), case.prior.std),
            names=case.parameters,
        )
    return StudyResult(
        parameters=case.parameters,
        tissue=case.tissue,
        observation=observation,
        filtered=filtered,
        identifiability=bound,
        reason=filtered.reason.value,
        detail=filtered.detail,
        converged=filtered.converged,
        seconds=time.perf_counter() - started,
        fitted=fitted,
    )
