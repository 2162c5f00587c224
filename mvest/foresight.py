"""What an estimation will be able to tell, found out before any data are taken.

The Fisher information needs a model, where it is believed to be, and what is to be observed how
well; it needs no observed value. So one run of the model says which intervals to expect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from mvest.estimation import Gaussian, Identifiability, Transform, identifiability
from mvest.estimation.transform import to_filter
from mvest.study import Case, Observed
from mvest.typing import FloatArray

__all__ = ["Foresight", "foresee"]


@dataclass(frozen=True, slots=True, eq=False)
class Foresight:
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
        reach = norm.ppf(0.5 + 0.5 * level) * self.informed.std / self.transform.derivative(z)
        return self.transform.inverse(z - reach), self.transform.inverse(z + reach)


def foresee(case: Case, observation: Observed) -> Foresight:
    """Expected intervals of an estimation that is not run.

    Parameters
    ----------
    case : Case
        The model is run once, at the mean of the prior.
    observation : Observed
        Which points are seen, and how well; the values that were seen play no part where points
        correspond.
    """
    # As filters start, whose first prediction may be shared.
    assumed = case.transform.inverse(case.transform.forward(case.prior.mean))
    predicted = observation.of(case.model)(assumed)
    data = informed = None
    if predicted.converged:
        scale = np.where(assumed != 0.0, np.abs(assumed), case.prior.std)
        H, R = predicted.jacobian, observation.R
        data = identifiability(H, R, scale, names=case.parameters)
        if np.all(case.prior.std > 0.0):
            D = case.transform.derivative(case.transform.forward(assumed))
            inner = to_filter(case.transform, case.prior).covariance
            prior = Gaussian(assumed, inner * np.outer(D, D))
            informed = identifiability(H, R, scale, prior=prior, names=case.parameters)
    return Foresight(
        case.parameters,
        assumed,
        case.prior,
        case.transform,
        observation.frames,
        len(observation.y),
        data,
        informed,
        "" if predicted.converged else predicted.reason,
    )
