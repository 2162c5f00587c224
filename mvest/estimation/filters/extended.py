"""The extended Kalman filter: one update, linearised at the prior's mean."""

from __future__ import annotations

from dataclasses import dataclass

from mvest.estimation.estimate import Estimate, Reason
from mvest.estimation.run import Filter, FilterRun
from mvest.estimation.update import kalman_update


@dataclass(frozen=True, slots=True)
class ExtendedFilter(Filter):
    """One Kalman update, each observation counted once, nothing iterated.

    With the prior N(m, P) in filter coordinates (Jazwinski, Stochastic Processes and Filtering
    Theory, 1970, theorem 8.1)::

        e = y − h(m),  H = dh/dz at m
        m⁺, P⁺ = update of m, P with e, H, R      see `kalman_update`

    It is the first step of `IteratedFilter`, kept to be compared with: what it lacks is what a
    non-linear model needs.
    """

    def estimate(self, run: FilterRun) -> Estimate:
        """Update once."""
        m, P = run.prior.mean, run.prior.covariance
        prediction = run.predict(m)
        if not prediction.converged:
            return run.fail(m, P, prediction)
        H = run.jacobian(m, prediction)
        update = kalman_update(run.prior, run.y - prediction.y, H, run.noise)
        run.record(m, P, run.misfit(prediction), update.log_likelihood)
        z, P = update.posterior.mean, update.posterior.covariance
        return run.finish_with_slope(z, P, H, Reason.COMPLETED, "one update")
