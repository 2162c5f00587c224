"""The extended Kalman filter: one update, linearised at the prior's mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mvest.estimation.estimate import Estimate, OnIterate, Reason
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import ObservationModel
from mvest.estimation.run import FilterRun
from mvest.estimation.transform import Transform
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True)
class ExtendedFilter:
    """One Kalman update, each observation counted once, nothing iterated.

    With the prior N(m, P) in filter coordinates (Jazwinski, Stochastic Processes and Filtering
    Theory, 1970, theorem 8.1)::

        e = y − h(m),  H = dh/dz at m
        m⁺, P⁺ = update of m, P with e, H, R      see `kalman_update`

    It is the first step of `IteratedFilter`, kept to be compared with: what it lacks is what a
    non-linear model needs.

    Attributes
    ----------
    check_runs : int
        Further runs of the model at the end, at ± 1 posterior standard deviation along the widest
        axes, for `Estimate.check`; without them it rests on the runs that were made anyway.

    Raises
    ------
    InputError
        If a shape or a covariance is not admissible; never for a failing model.
    """

    check_runs: int = 0

    def __call__(
        self,
        model: ObservationModel,
        prior: Gaussian,
        y: FloatArray,
        R: NoiseCovariance,
        *,
        names: Sequence[str] | None = None,
        transform: Transform | None = None,
        on_iterate: OnIterate | None = None,
    ) -> Estimate:
        """Update once; see `Filter` for the arguments."""
        run = FilterRun(model, prior, y, R, names, transform, on_iterate, self.check_runs)
        m, P = run.prior.mean, run.prior.covariance
        prediction = run.predict(m)
        if not prediction.converged:
            return run.fail(m, P, prediction)
        H = run.jacobian(m, prediction)
        update = kalman_update(run.prior, run.y - prediction.y, H, run.noise)
        run.record(m, P, run.misfit(prediction), update.log_likelihood)
        posterior = update.posterior
        detail = "one update"
        return run.finish_with_slope(
            posterior.mean, posterior.covariance, H, Reason.COMPLETED, detail
        )
