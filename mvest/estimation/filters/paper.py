"""The extended Kalman filter as the method paper runs it."""

from dataclasses import dataclass

import numpy as np

from mvest.errors import require_numbers
from mvest.estimation.estimate import Estimate, Reason
from mvest.estimation.gaussian import Gaussian, as_covariance
from mvest.estimation.prediction import Prediction
from mvest.estimation.run import Filter, FilterRun
from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PaperFilter(Filter):
    """Extended Kalman filter that reuses the same frames as new observations.

    Estimation of patient-specific material properties of the mitral valve using 4D transesophageal
    echocardiography (ISBI 2013). The parameters are a random walk, and in each round all frames
    together are one observation::

        m⁻ = m,  P⁻ = P + Q                      process
        e  = y − h(m⁻),  H = dh/dm at m⁻         model
        m, P = update of m⁻, P⁻ with e, H, R     see `kalman_update`

    until two consecutive rounds agree. Each round counts the observation again, so that P is not
    the covariance of a posterior: with Q = 0 it shrinks like 1/rounds, with Q > 0 it tends to a
    value set by Q and R. For a posterior use `IteratedFilter`. No step is shortened: the run ends
    if the model fails.
    """

    #: float, (p,) or (p, p) in squared units of the parameters, covariance added in each round;
    #: transformed into filter coordinates at the prior's mean
    Q: float | FloatArray = 0.01
    #: stop when no parameter changed by more than this, relative to its size (or to its standard
    #: deviation if that is larger)
    tolerance: float = 1e-4
    max_iterations: int = 50  #: largest number of rounds

    def __post_init__(self) -> None:
        require_numbers(self, "filter", "tolerance")
        require_numbers(self, "filter", "max_iterations", least=1)

    def estimate(self, run: FilterRun) -> Estimate:
        """Run rounds until they agree."""
        step = Gaussian(run.physical_prior.mean, as_covariance(self.Q, run.prior.size, "Q"))
        Q = to_filter(run.transform, step).covariance
        m, P = run.prior.mean, run.prior.covariance
        converged, rounds = False, 0
        while True:
            prediction = run.predict(m)
            if not prediction.converged:
                now, start = (run.transform.inverse(z) for z in (m, run.prior.mean))
                left = [
                    f"{run.names[i]} = {now[i]:.3g}"
                    for i in np.flatnonzero((now <= 0.0) & (start > 0.0))
                ]
                if left:
                    prediction = Prediction.failed(
                        f"{prediction.reason}; the paper's filter does not shorten its steps, and "
                        f"this one led to {' and '.join(left)}: in logarithms "
                        f"(filter=iterated_log; IteratedFilter with Log) parameters stay positive"
                    )
                return run.fail(m, P, prediction)
            H = run.jacobian(m, prediction)
            innovation = run.y - prediction.y
            update = kalman_update(Gaussian(m, P + Q), innovation, H, run.noise)
            run.record(m, P, run.misfit(prediction), update.log_likelihood)

            # One run more than rounds, so that the reported prediction is that of the estimate.
            if converged or rounds == self.max_iterations:
                reason = Reason.CONVERGED if converged else Reason.MAX_ITERATIONS
                detail = f"{rounds} rounds, tolerance {self.tolerance:g}"
                return run.finish(
                    reason, detail, prediction, innovation, update, prior=Gaussian(m, P + Q)
                )

            change = update.posterior.mean - m
            m, P = update.posterior.mean, update.posterior.covariance
            converged = run.negligible(change, m, P, self.tolerance)
            rounds += 1
