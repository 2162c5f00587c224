"""What an estimation will be able to tell, found out before any data are taken.

The Fisher information needs a model, where it is believed to be, and what is to be observed how
well; it needs no observed value. So one run of the model says which intervals to expect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.identifiability import Identifiability, identifiability
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import ObservationModel, predict
from mvest.estimation.transform import Transform, to_filter
from mvest.problem.problem import Observed, Problem
from mvest.typing import FloatArray

__all__ = ["Expectation", "expect", "expect_of_model"]


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """What can be expected of an estimation, or why that is not known.

    Attributes
    ----------
    parameters : tuple of str, (p,)
    assumed : (p,) in the units of the parameters
        The prior's mean, where the model is linearised.
    prior : Gaussian
        Of the parameters.
    transform : Transform
        Coordinates in which intervals are symmetric.
    frames : tuple of str
    observations : int
        How many numbers are observed.
    data : Identifiability or None
        What the data alone will say.
    informed : Identifiability or None
        What data and prior will say together; None also where a parameter is held by a prior
        without width.
    reason : str
        Why the model has no prediction at the assumed parameters, if it has none.
    """

    parameters: tuple[str, ...]
    assumed: FloatArray
    prior: Gaussian
    transform: Transform
    frames: tuple[str, ...]
    observations: int
    data: Identifiability | None
    informed: Identifiability | None
    reason: str

    def interval(self, level: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Expected interval of each parameter with the prior, (p,) and (p,).

        Raises
        ------
        ValueError
            If nothing is known (see ``informed``).
        """
        if self.informed is None:
            raise ValueError("nothing is known of the parameters with the prior")
        z = self.transform.forward(self.assumed)
        reach = ndtri(0.5 + 0.5 * level) * self.informed.std / self.transform.derivative(z)
        return self.transform.inverse(z - reach), self.transform.inverse(z + reach)


def expect(problem: Problem, observation: Observed) -> Expectation:
    """Expected intervals of an estimation that is not run.

    Parameters
    ----------
    problem : Problem
        The model is run once, at the mean of the prior.
    observation : Observed
        Which points are seen, and how well; the values that were seen play no part where points
        correspond.
    """
    return expect_of_model(
        observation.of(problem.model),
        problem.prior,
        observation.R,
        parameters=problem.parameters,
        transform=problem.transform,
        frames=observation.frames,
    )


def expect_of_model(
    model: ObservationModel,
    prior: Gaussian,
    R: NoiseCovariance,
    *,
    parameters: tuple[str, ...],
    transform: Transform,
    frames: tuple[str, ...],
) -> Expectation:
    """Expected intervals of an estimation of any model that is not run.

    Parameters
    ----------
    model : ObservationModel
        Predicts what is to be observed. It is run once, at the mean of the prior.
    prior : Gaussian
        Of the parameters themselves.
    R : noise covariance
        Of the observation.
    parameters, transform, frames
        See `Expectation`.
    """
    # As filters start, whose first prediction may be shared.
    assumed = transform.inverse(transform.forward(prior.mean))
    predicted = predict(model, assumed, derivatives=True)
    data = informed = None
    if predicted.converged:
        scale = np.where(assumed != 0.0, np.abs(assumed), prior.std)
        data = identifiability(predicted.jacobian, R, scale, names=parameters)
        if np.all(prior.std > 0.0):
            D = transform.derivative(transform.forward(assumed))
            inner = to_filter(transform, prior).covariance
            known = Gaussian(assumed, inner * np.outer(D, D))
            informed = identifiability(predicted.jacobian, R, scale, prior=known, names=parameters)
    return Expectation(
        parameters,
        assumed,
        prior,
        transform,
        frames,
        len(predicted.y),
        data,
        informed,
        "" if predicted.converged else predicted.reason,
    )
