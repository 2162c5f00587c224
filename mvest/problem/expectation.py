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
from mvest.estimation.prediction import predict
from mvest.estimation.transform import to_filter
from mvest.problem.problem import Observed, Problem
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """What can be expected of an estimation, or why that is not known.

    Attributes
    ----------
    problem : Problem
    frames : tuple of str
        To be observed.
    observations : int
        How many numbers are observed.
    data : Identifiability or None
        What the data alone will say, at the mean of the prior.
    informed : Identifiability or None
        What data and prior will say together; None also where a parameter is held by a prior
        without width.
    reason : str
        Why the model has no prediction at the assumed parameters, if it has none.
    """

    problem: Problem
    frames: tuple[str, ...] = ()
    observations: int = 0
    data: Identifiability | None = None
    informed: Identifiability | None = None
    reason: str = ""

    @property
    def assumed(self) -> FloatArray:
        """Where the model is linearised, ``(p,)`` in the units of the parameters."""
        return self.problem.start

    def interval(self, level: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Expected interval of each parameter with the prior, (p,) and (p,).

        Raises
        ------
        ValueError
            If nothing is known (see ``informed``).
        """
        if self.informed is None:
            raise ValueError("nothing is known of the parameters with the prior")
        transform = self.problem.transform
        z = transform.forward(self.assumed)
        reach = ndtri(0.5 + 0.5 * level) * self.informed.std / transform.derivative(z)
        return transform.inverse(z - reach), transform.inverse(z + reach)


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
    prior, transform, names = problem.prior, problem.transform, problem.parameters
    assumed, R = problem.start, observation.R
    predicted = predict(observation.of(problem.model), assumed, derivatives=True)
    if not predicted.converged:
        return Expectation(problem, observation.frames, reason=predicted.reason)
    scale = np.where(assumed != 0.0, np.abs(assumed), prior.std)
    data = identifiability(predicted.jacobian, R, scale, names=names)
    informed = None
    if np.all(prior.std > 0.0):
        D = transform.derivative(transform.forward(assumed))
        known = Gaussian(assumed, to_filter(transform, prior).covariance * np.outer(D, D))
        informed = identifiability(predicted.jacobian, R, scale, prior=known, names=names)
    return Expectation(problem, observation.frames, len(predicted.y), data, informed)
