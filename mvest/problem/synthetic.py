"""Observations that are made from a known truth, and that truth, which no filter is given."""

from __future__ import annotations

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
        What the filter is to assume of the errors.
    correlation : SpatialCorrelation, optional
        What the filter is to assume of their correlation; None for independent errors.
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
