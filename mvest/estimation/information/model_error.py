"""What a known error of the model does to an estimate."""

from dataclasses import replace

import numpy as np

from mvest.errors import InputError
from mvest.estimation.estimate import Estimate
from mvest.estimation.noise import NoiseCovariance, observation_noise
from mvest.estimation.prediction import require_finite
from mvest.estimation.transform import to_filter
from mvest.typing import FloatArray


def shift_by_model_error(found: Estimate, R: NoiseCovariance, offset: FloatArray) -> FloatArray:
    """By how much an estimate is off because its model is, to first order.

    Observations that lie ``offset`` beside what the model predicts at the truth move the posterior
    mode by::

        b = (Hᵀ R⁻¹ H + P⁻¹)⁻¹ Hᵀ R⁻¹ offset

    the update of Gauss-Newton with the offset for an innovation, with the prior's P and the
    Jacobian H at the estimate in the filter's coordinates. The offset of a mesh is the prediction
    of a finer one less its own, at the estimate.

    Parameters
    ----------
    found : Estimate
        With a prediction.
    R : noise covariance
        Of n observations.
    offset : (n,) in units of the observation

    Returns
    -------
    (p,) in the filter's coordinates

    Raises
    ------
    InputError
        If there is no prediction, or the offset does not belong to it or is not finite.
    """
    offset = np.asarray(offset, dtype=np.float64)
    if found.prediction is None:
        raise InputError("an estimate without a prediction has no derivatives")
    if offset.shape != found.prediction.y.shape:
        raise InputError(
            f"offset of shape {offset.shape}, expected that of the prediction: "
            f"{found.prediction.y.shape}"
        )
    require_finite(offset, "the error of the model")
    noise, prior = observation_noise(R, len(offset)), to_filter(found.transform, found.prior)
    H = found.prediction.jacobian * found.transform.derivative(found.transformed.mean)
    # In coordinates in which the prior is N(0, I), so that it may be singular.
    A = noise.whiten(H @ prior.factor)
    B = np.eye(prior.size) + A.T @ A
    return np.asarray(prior.factor @ np.linalg.solve(B, A.T @ noise.whiten(offset)))


def with_shift(found: Estimate, shift: FloatArray) -> Estimate:
    """The estimate with a shift of each parameter, by its model's error, as one more error of it.

    The size of a shift ``b (p,)`` is some measure of what another mesh does, its direction is not:
    b bᵀ added to the covariance would leave the estimate as sure as before across b; diag(b²)
    takes each part of b for an error of its own.
    """
    covariances = found.transformed_iterate_covariances.copy()
    covariances[-1] += np.diag(shift**2)
    return replace(found, transformed_iterate_covariances=covariances)
