"""The one joint of data, model and filter: observation and case in, estimate and its errors out.

The truth of a synthetic study is kept apart. ``simulate_observation`` returns it beside the
observation; ``estimate`` takes the observation and a case and never sees it; only the finished
``StudyResult`` is compared with it (``StudyResult.against``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

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
from mvest.estimation.noise import NoiseCovariance, stacked_noise
from mvest.estimation.prediction import require_finite
from mvest.model import ClosedState, TissueSettings
from mvest.observation_errors import ObservationError, SpatialCorrelation, observe
from mvest.typing import BoolArray, FloatArray

__all__ = [
    "FRAMES",
    "Case",
    "Modulus",
    "Observation",
    "ObservedFrames",
    "SharedStart",
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
        Positions of the vertices in each frame; NaN where a vertex is not seen, so that nobody can
        read what was not observed.
    variance : (f,) mm²
        Variance of each coordinate in each frame that the filter is to assume.
    correlation : SpatialCorrelation or None
        Correlation between vertices that the filter is to assume; None for independent errors.
    """

    frames: tuple[str, ...]
    positions: FloatArray
    variance: FloatArray
    correlation: SpatialCorrelation | None = None

    def __post_init__(self) -> None:
        require_frames(self.frames)
        positions = np.array(self.positions, dtype=np.float64)
        if positions.ndim != 3 or positions.shape[0] != len(self.frames) or positions.shape[2] != 3:
            raise InputError(
                f"observed positions have shape {positions.shape}, expected "
                f"({len(self.frames)}, n, 3): one row for each of {', '.join(self.frames)}"
            )
        unseen: BoolArray = np.all(np.isnan(positions), axis=2)
        require_finite(np.where(unseen[..., None], 0.0, positions), "the observed positions")
        if np.all(unseen):
            raise InputError("no observed position is finite: no vertex is seen")
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
        told = self.correlation
        if told is not None and len(told.points) != positions.shape[1]:
            raise InputError(
                f"R is correlated between {len(told.points)} vertices, but {positions.shape[1]} "
                f"are observed"
            )
        for name, values in (("positions", positions), ("variance", variance)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def seen(self) -> BoolArray:
        """Which vertices are seen in each frame ``(f, n)``."""
        return np.isfinite(self.positions[:, :, 0])

    @property
    def y(self) -> FloatArray:
        """Stacked coordinates ``(3 k,)`` mm of the k vertices that are seen, frame by frame."""
        return self.positions[self.seen].ravel()

    @property
    def R(self) -> NoiseCovariance:
        """Covariance in mm² of ``y``: its variances ``(3 k,)``, or factorised if correlated."""
        counts = 3 * self.seen.sum(axis=1)
        if self.correlation is None:
            return np.repeat(self.variance, counts)
        blocks = [
            self.correlation.of(seen).noise(float(variance), 3)
            for seen, variance in zip(self.seen, self.variance, strict=True)
            if seen.any()
        ]
        return stacked_noise(blocks)


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

    Attributes
    ----------
    model : ObservationModel
    frames : tuple of str, (f,)
    seen : (f, n) or None
        Vertices that are predicted in each frame; None for all.
    """

    model: ObservationModel
    frames: tuple[str, ...]
    seen: BoolArray | None = None
    _whole: dict[bytes, FloatArray] = field(default_factory=dict, init=False, repr=False)

    def whole(self, m: FloatArray) -> FloatArray | None:
        """Positions ``(f, n, 3)`` of all vertices where the model was run with ``m (p,)``."""
        return self._whole.get(np.asarray(m, dtype=np.float64).tobytes())

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict the observed frames of parameters ``m (p,)``."""
        try:
            prediction = self.model(m)
        except MaterialError as error:
            return Prediction.failed(str(error))
        if not prediction.converged:
            return prediction
        y, jacobian = (_selected(a, self.frames) for a in (prediction.y, prediction.jacobian))
        whole = y.reshape(len(self.frames), -1, 3)
        self._whole[np.asarray(m, dtype=np.float64).tobytes()] = whole
        if self.seen is not None:
            rows = np.repeat(self.seen, 3)
            y, jacobian = y[rows], jacobian[rows]
        return Prediction(y, jacobian, reason=prediction.reason)


class Restartable(Protocol):
    """A model whose next prediction may start from where an earlier one ended."""

    @property
    def closed(self) -> ClosedState | None:
        """Where the next prediction would start from."""
        ...

    def restart(self, closed: ClosedState | None) -> None:
        """Forget everything but where to start from."""
        ...

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an ``ObservationModel`` does."""
        ...


class SharedStart:
    """A model for many estimations that all begin with one and the same prediction.

    The prediction at the common start is computed once, and whenever it is asked for the model goes
    on from there as if nothing else had been computed before. So an estimation gives the same
    numbers, to the last bit, by itself and after any others.

    Parameters
    ----------
    model : Restartable
        Nobody else may use it meanwhile.
    start : (p,)
        Parameters at which every estimation begins.
    """

    def __init__(self, model: Restartable, start: FloatArray) -> None:
        self._model = model
        self._start = np.array(start, dtype=np.float64)
        self._first: tuple[Prediction, ClosedState | None] | None = None

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an ``ObservationModel`` does."""
        if not np.array_equal(m, self._start):
            return self._model(m)
        if self._first is None:
            self._model.restart(None)
            prediction = self._model(m)
            self._first = prediction, self._model.closed
        prediction, closed = self._first
        self._model.restart(closed)
        return prediction


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
    fitted : (f, n, 3) mm or None
        Observed frames as predicted at the estimate, unseen vertices included.
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

        NaN where a vertex is not seen.
        """
        if self.fitted is None or self.observation is None:
            return None
        return np.linalg.norm(self.fitted[-1] - self.observation.positions[-1], axis=1)

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
    prediction = model(values)
    if not prediction.converged:
        return TwinData(None, None, f"no synthetic observation: {prediction.reason}")
    positions = _selected(prediction.y, frames).reshape(len(frames), -1, 3)
    seen = observe(positions, errors, rng)
    observation = Observation(tuple(frames), seen, np.asarray(variance), correlation)
    return TwinData(observation, Truth(tuple(parameters), values, positions), prediction.reason)


def estimate(
    case: Case, observation: Observation, *, on_iterate: OnIterate | None = None
) -> StudyResult:
    """Estimate the parameters of a case from an observation.

    Numerical failure is a result with its reason; only inadmissible input raises.
    """
    started = time.perf_counter()
    predicted = ObservedFrames(case.model, observation.frames, observation.seen)
    R = observation.R
    filtered = case.filter(
        predicted,
        case.prior,
        observation.y,
        R,
        names=case.parameters,
        transform=case.transform,
        on_iterate=on_iterate,
    )
    bound = None
    if filtered.prediction is not None:
        bound = identifiability(
            filtered.prediction.jacobian,
            R,
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
        fitted=None if filtered.prediction is None else predicted.whole(filtered.mean),
    )
