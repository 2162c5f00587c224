"""Synthetic observations made from a known truth. Filters never receive the truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.estimation.prediction import ObservationModel, as_prediction, require_finite
from mvest.observation.errors import ObservationError, SpatialCorrelation, observe
from mvest.observation.vertices import FRAMES, Observation, require_frames, select_frames
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The origin of a synthetic observation."""

    parameters: tuple[str, ...]  #: (p,)
    values: FloatArray  #: (p,) in the units of the parameters
    positions: FloatArray  #: (f, n, 3) mm, the observed frames without noise


@dataclass(frozen=True, slots=True, eq=False)
class TwinData:
    """A synthetic observation and its truth, or the reason for their absence."""

    observation: Observation | None
    truth: Truth | None
    reason: str


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
    """Make a synthetic observation; without one, and with the model's reason, if the model fails.

    InputError on inadmissible errors, frames or values.

    Parameters
    ----------
    model : ObservationModel
        Of the truth. Use another model than the estimator's to avoid the inverse crime.
    parameters : names, (p,)
    values : (p,)
        True parameters.
    frames : sequence of str
        Observed frames, some of ``FRAMES``.
    variance : float or (f,) mm²
        Of the errors, as the filter assumes it.
    correlation : SpatialCorrelation, optional
        Of the errors, as the filter assumes it; None for independent errors.
    errors : sequence of ObservationError
        Applied to the truth in this order.
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
