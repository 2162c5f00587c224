"""What a known error of the model does to an estimate."""

import numpy as np

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseCovariance, observation_noise
from mvest.estimation.prediction import require_finite
from mvest.typing import FloatArray

__all__ = ["shift_by_model_error"]


def shift_by_model_error(
    H: FloatArray, R: NoiseCovariance, offset: FloatArray, prior: Gaussian
) -> FloatArray:
    """By how much an estimate is off because its model is, to first order.

    Observations that lie ``offset`` beside what the model predicts at the truth move the posterior
    mode by::

        b = (Hᵀ R⁻¹ H + P⁻¹)⁻¹ Hᵀ R⁻¹ offset

    the update of Gauss-Newton with the offset for an innovation. The offset of a mesh is the
    prediction of a finer one less its own, at the estimate. Its size is some measure of what
    another mesh does, its direction is not: b bᵀ added to the posterior's covariance would leave
    the estimate as sure as before across b, diag(b²) takes each part of b for an error of its own.

    Parameters
    ----------
    H : (n, p)
        Derivative of the prediction by the filter's coordinates, at the estimate.
    R : noise covariance
        Of n observations.
    offset : (n,) in units of the observation
    prior : Gaussian
        In the filter's coordinates.

    Returns
    -------
    (p,) in the filter's coordinates

    Raises
    ------
    InputError
        If shapes do not belong together or the offset is not finite.
    """
    offset = np.asarray(offset, dtype=np.float64)
    if H.ndim != 2 or offset.shape != (len(H),) or H.shape[1] != prior.size:
        raise InputError(
            f"offset of shape {offset.shape} and H of shape {H.shape}, expected (n,) and "
            f"(n, {prior.size})"
        )
    require_finite(offset, "the error of the model")
    noise = observation_noise(R, len(offset))
    # In coordinates in which the prior is N(0, I), so that it may be singular.
    A = noise.whiten(H @ prior.factor)
    B = np.eye(prior.size) + A.T @ A
    return np.asarray(prior.factor @ np.linalg.solve(B, A.T @ noise.whiten(offset)))
