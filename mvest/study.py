"""The one joint of data, model and filter: observation and case in, estimate and its errors out.

The truth of a synthetic study is kept apart. ``simulate_observation`` returns it beside the
observation; ``estimate`` takes the observation and a case and never sees it; only the finished
``StudyResult`` is compared with it (``StudyResult.against``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvest.errors import InputError, MaterialError
from mvest.estimation import (
    Estimate,
    Filter,
    Gaussian,
    Identifiability,
    ObservationModel,
    Prediction,
    Transform,
    identifiability,
)
from mvest.estimation.estimate import OnIterate
from mvest.estimation.prediction import require_finite
from mvest.model import TissueSettings
from mvest.typing import FloatArray

__all__ = [
    "FRAMES",
    "Case",
    "Modulus",
    "Observation",
    "ObservedFrames",
    "StudyResult",
    "Truth",
    "TwinData",
    "estimate",
    "simulate_observation",
]

FRAMES = ("open", "closed")
"""Frames that a valve model predicts, in the order in which it stacks them."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What was seen, and how well.

    Attributes
    ----------
    frames : tuple of str, (f,)
        Observed frames, the closed one last.
    positions : (f, n, 3) mm
        Positions of the observed vertices in each frame.
    variance : (f,) mm²
        Variance of each coordinate in each frame that the filter is to assume.
    """

    frames: tuple[str, ...]
    positions: FloatArray
    variance: FloatArray

    def __post_init__(self) -> None:
        require_frames(self.frames)
        positions = np.array(self.positions, dtype=np.float64)
        if positions.ndim != 3 or positions.shape[0] != len(self.frames) or positions.shape[2] != 3:
            raise InputError(
                f"observed positions have shape {positions.shape}, expected "
                f"({len(self.frames)}, n, 3): one row for each of {', '.join(self.frames)}"
            )
        require_finite(positions, "the observed positions")
        try:
            variance = np.broadcast_to(np.asarray(self.variance, float), (len(self.frames),)).copy()
        except ValueError:
            raise InputError(
                f"R has shape {np.shape(self.variance)}; expected one variance, or one for each of "
                f"the {len(self.frames)} observed frames"
            ) from None
        require_finite(variance, "R")
        if np.any(variance <= 0.0):
            raise InputError(f"R = {variance.min():g} mm^2, expected > 0")
        for name, values in (("positions", positions), ("variance", variance)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def R(self) -> FloatArray:
        """Variances ``(3 f n,)`` in mm² of the stacked coordinates."""
        return np.repeat(self.variance, self.positions[0].size)


def require_frames(frames: Sequence[str]) -> None:
    """Raise InputError unless ``frames`` are different frames that a model predicts."""
    if not frames or not set(frames) <= set(FRAMES) or len(set(frames)) != len(frames):
        raise InputError(f"observed frames {list(frames)}, expected some of {list(FRAMES)}")


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


@dataclass(frozen=True, slots=True, eq=False)
class TwinData:
    """A synthetic observation with the truth behind it, or the reason why there is none."""

    observation: Observation | None
    truth: Truth | None
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class ObservedFrames:
    """The observed frames of a model that predicts all of ``FRAMES``.

    Parameters that no tissue can have, as a filter may try, give a failed prediction.
    """

    model: ObservationModel
    frames: tuple[str, ...]

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict the observed frames of parameters ``m (p,)``."""
        try:
            prediction = self.model(m)
        except MaterialError as error:
            return Prediction.failed(str(error))
        if not prediction.converged:
            return prediction
        return Prediction(
            _selected(prediction.y, self.frames),
            _selected(prediction.jacobian, self.frames),
            reason=prediction.reason,
        )


def _selected(stacked: FloatArray, frames: Sequence[str]) -> FloatArray:
    """Rows of the named frames out of all ``FRAMES``."""
    size = len(stacked) // len(FRAMES)
    starts = [size * FRAMES.index(frame) for frame in frames]
    return np.concatenate([stacked[start : start + size] for start in starts])


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
    observation : Observation or None
        None if it could not be simulated.
    filtered : Estimate or None
        What the filter returned; None if it was never run.
    identifiability : Identifiability or None
        Cramér-Rao bound and flat directions of the data alone, at the estimate.
    reason, detail : str
    converged : bool
    seconds : float
        Wall-clock time of the estimation.
    truth : Truth or None
        Added by ``against``, after the estimation.
    """

    parameters: tuple[str, ...]
    tissue: Mapping[str, TissueSettings]
    observation: Observation | None
    filtered: Estimate | None
    identifiability: Identifiability | None
    reason: str
    detail: str
    converged: bool
    seconds: float
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
    def fitted(self) -> FloatArray | None:
        """Observed frames as predicted at the estimate, ``(f, n, 3)`` mm."""
        if self.filtered is None or self.filtered.prediction is None or self.observation is None:
            return None
        return self.filtered.prediction.y.reshape(self.observation.positions.shape)

    @property
    def distance(self) -> FloatArray | None:
        """Distance ``(n,)`` mm of each vertex, fitted to observed, in the last observed frame."""
        if self.fitted is None or self.observation is None:
            return None
        return np.linalg.norm(self.fitted[-1] - self.observation.positions[-1], axis=1)

    @property
    def distance_to_truth(self) -> FloatArray | None:
        """As ``distance``, to the positions before noise was added."""
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
    noise_mm: float = 0.0,
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
        What the filter is told about the noise.
    noise_mm : float
        Standard deviation of the independent normal noise of each coordinate, mm.
    rng : numpy.random.Generator

    Returns
    -------
    TwinData
        Without an observation, and with the model's reason, if the model failed.

    Raises
    ------
    InputError
        On inadmissible noise, frames or values.
    """
    if not (np.isfinite(noise_mm) and noise_mm >= 0.0):
        raise InputError(f"noise of {noise_mm} mm, expected >= 0")
    values = np.asarray(values, dtype=np.float64)
    if values.shape != (len(parameters),):
        raise InputError(
            f"{values.size} true values for the {len(parameters)} parameters "
            f"{', '.join(parameters)}"
        )
    require_finite(values, "the true values")
    require_frames(frames)
    prediction = model(values)
    if not prediction.converged:
        return TwinData(None, None, f"no synthetic observation: {prediction.reason}")
    positions = _selected(prediction.y, frames).reshape(len(frames), -1, 3)
    noise = noise_mm * rng.standard_normal(positions.shape) if noise_mm else 0.0
    observation = Observation(tuple(frames), positions + noise, np.asarray(variance))
    return TwinData(observation, Truth(tuple(parameters), values, positions), prediction.reason)


def estimate(
    case: Case, observation: Observation, *, on_iterate: OnIterate | None = None
) -> StudyResult:
    """Estimate the parameters of a case from an observation.

    Numerical failure is a result with its reason; only inadmissible input raises.
    """
    started = time.perf_counter()
    filtered = case.filter(
        ObservedFrames(case.model, observation.frames),
        case.prior,
        observation.positions.ravel(),
        observation.R,
        names=case.parameters,
        transform=case.transform,
        on_iterate=on_iterate,
    )
    bound = None
    if filtered.prediction is not None:
        bound = identifiability(
            filtered.prediction.jacobian,
            observation.R,
            np.abs(filtered.mean),
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
    )
