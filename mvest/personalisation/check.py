"""What an estimate of a case could tell, found out before anything is estimated.

The information of an observation needs a model, where it is believed to be, and what is seen how
well; it needs no observed value. So one closure of the generic valve on the coarse mesh of the
guide, with its derivatives, says which intervals to expect, what they rest on and what would narrow
them (`mvest.personalisation.known`).
"""

from __future__ import annotations

import numpy as np

from mvest.cases.case import ValveCase
from mvest.closure.model import ClosureModel
from mvest.estimation.prediction import predict
from mvest.estimation.transform import to_filter
from mvest.personalisation.estimation import CaseProblem, linearised, sampled
from mvest.personalisation.known import LinearModel, narrower, variance_shares
from mvest.personalisation.model import build_coarse
from mvest.personalisation.result import Expected
from mvest.personalisation.settings import PersonaliseSettings
from mvest.problem.estimate import expected_intervals


def expect_case(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel | None = None
) -> Expected:
    """What an estimate of a case could tell, to first order about the generic valve.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    model : ClosureModel, optional
        The closure of the case; by default on the mesh of the guide.
    """
    model = build_coarse(case, settings) if model is None else model
    problem = CaseProblem.of(case, settings, model=model)
    place = problem.generic()
    if not place.prediction.converged:
        return Expected(reason=place.prediction.reason)
    place = linearised(place, problem)
    if case.error_samples is not None:
        place = sampled(place)
    seen = predict(
        place.errors.observation().of(lambda _: place.prediction), place.m, derivatives=True
    )
    transform, prior = problem.transform, to_filter(problem.transform, problem.prior)
    H = seen.jacobian * transform.derivative(transform.forward(place.m))
    linear = LinearModel(problem.names, prior.covariance, H, place.errors)
    after = np.sqrt(linear.variances())
    unknowns = expected_intervals(problem.names, transform, place.m, prior.std, after)
    return Expected(unknowns, variance_shares(linear), narrower(problem, linear))
