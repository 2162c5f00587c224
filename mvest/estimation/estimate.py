"""What a filter returns: the estimate, its history, and why the filter stopped."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.check import ApproximationCheck
from mvest.estimation.evidence import LearnedNoise
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction
from mvest.estimation.transform import Transform, covariance_to_physical
from mvest.typing import FloatArray

NOT_THE_POSTERIOR = ", but the posterior is not what the filter assumes"
"""Joins the reason and the sentence of a check that fails."""

OnIterate: TypeAlias = Callable[[int, FloatArray, float], None]
"""Called after each iterate with its number, the parameters (p,) and the objective."""


class Reason(Enum):
    """Why a filter stopped; the value is the text for a reader."""

    CONVERGED = "converged: the change of every parameter is below the tolerance"
    MAX_ITERATIONS = "not converged: the largest permitted number of iterations is reached"
    NO_DECREASE = "not converged: no step along the search direction lowers the objective"
    COMPLETED = "completed: every planned update is done"
    NOT_SAMPLED = "not converged: the draws from the posterior do not yet agree with each other"
    MODEL_FAILED = "not converged: the model gives no prediction where the filter needs one"

    @property
    def converged(self) -> bool:
        """Whether the estimate may be used."""
        return self in (Reason.CONVERGED, Reason.COMPLETED)


@dataclass(frozen=True, slots=True)
class InnovationSummary:
    """The innovation of the prior, and how well its covariance S explains it.

    The innovation e = y − h(z) + H (z − m) is linearised at the estimate z. For a linear model it
    is y less the prediction at the prior's mean m. The paper's filter uses the same y in each
    round, so that its `nis` is smaller than a chi-square number.
    """

    size: int  #: number n of observations
    #: in units of the observation, root mean square and largest absolute value of e
    rms: float
    max_abs: float
    #: eᵀ S⁻¹ e, chi-square with n degrees of freedom if the model and its covariances are right
    nis: float
    #: band that holds such a number with 95 % probability
    nis_band: tuple[float, float]
    #: in units of the observation, root mean square of the residual y − h(z) of the estimate
    residual_rms: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Estimate of p parameters after k iterates, from the start to the estimate.

    Filter coordinates are z = T(m) of the transform. Covariances are transformed to first order.
    """

    names: tuple[str, ...]  #: tuple of str, (p,)
    prior: Gaussian  #: prior of the parameters themselves
    transform: Transform
    transformed_iterates: FloatArray  #: (k, p), filter coordinates
    #: (k, p, p), filter coordinates, paper's filter: covariance after round k, with the prior's in
    #: row 0. Iterated filter: covariance of the posterior linearised at iterate k. Others: see each
    #: filter.
    transformed_iterate_covariances: FloatArray
    #: (k,), paper's filter: ½ (y − h)ᵀ R⁻¹ (y − h). Others: the same plus the prior's term; for
    #: filters that run the model around an iterate, h is the mean of these predictions. NaN in the
    #: last row if the model failed there.
    objective: FloatArray
    #: (k,), log N(e; 0, S) of the innovation at each iterate; NaN as in `objective`, and if a
    #: filter does not compute it
    log_likelihood: FloatArray
    #: at the estimate; None if the model failed there. If the model has no derivatives, its
    #: Jacobian is the slope between the filter's points.
    prediction: Prediction | None
    innovation: InnovationSummary | None  #: at the last iterate; None if the model failed there
    reason: Reason
    detail: str  #: numbers that belong to the reason, or the failed model's reason
    forward_solves: int  #: runs of the model, failed ones included
    #: (n,) or None, S^(-1/2) e of that innovation; white if the model and its covariances are right
    standardised: FloatArray | None = None
    #: (s, p), filter coordinates, or None, draws from the posterior, if the filter makes them;
    #: intervals are then their quantiles
    transformed_samples: FloatArray | None = None
    learned: LearnedNoise | None = None  #: the noise, if it was learned
    #: the worst check of the posterior; None if nothing was compared
    check: ApproximationCheck | None = None
    #: (p, p), filter coordinates, or None, second derivatives of the objective that its
    #: linearisation leaves out, ``−Σ (R⁻¹ (y − h))ᵢ ∂²hᵢ/∂z²``, if the filter computed them
    curvature: FloatArray | None = None

    def __str__(self) -> str:
        return self.summary()

    def summary(self, units: Sequence[str] = ()) -> str:
        """Each parameter ± one standard deviation and its unit, and why the filter stopped."""
        width = max(map(len, self.names))
        rows = [
            f"{name:<{width}}  {mean:.4g} ± {std:.2g} {unit}".rstrip()
            for name, mean, std, unit in zip(
                self.names, self.mean, self.std, units or ("",) * len(self.names), strict=True
            )
        ]
        counts = f"{self.iterations} iterations, {self.forward_solves} forward solves"
        detail = "" if self.converged or not self.detail else f" ({self.detail})"
        return "\n".join([*rows, f"{self.why}{detail}; {counts}"])

    @property
    def converged(self) -> bool:
        """Whether the iterations converged."""
        return self.reason.converged

    @property
    def trusted(self) -> bool:
        """Whether the filter converged and no check of its posterior fails."""
        return self.converged and (self.check is None or self.check.holds)

    @property
    def why(self) -> str:
        """Why the filter stopped, and which check of its posterior fails."""
        if self.check is None or self.check.holds:
            return self.reason.value
        return f"{self.reason.value}{NOT_THE_POSTERIOR}: {self.check.sentence}"

    @property
    def iterations(self) -> int:
        """Number of updates."""
        return len(self.transformed_iterates) - 1

    @property
    def iterates(self) -> FloatArray:
        """Parameters at each iterate (k, p)."""
        return np.array([self.transform.inverse(z) for z in self.transformed_iterates])

    @property
    def iterate_covariances(self) -> FloatArray:
        """Covariance of the parameters at each iterate (k, p, p)."""
        pairs = zip(self.transformed_iterates, self.transformed_iterate_covariances, strict=True)
        return np.array([covariance_to_physical(self.transform, z, P) for z, P in pairs])

    @property
    def iterate_std(self) -> FloatArray:
        """Standard deviations of the parameters at each iterate (k, p)."""
        return _std(self.iterate_covariances)

    @property
    def mean(self) -> FloatArray:
        """Estimated parameters (p,)."""
        return self.transform.inverse(self.transformed_iterates[-1])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the estimated parameters (p, p)."""
        return self.iterate_covariances[-1]

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the estimated parameters (p,)."""
        return _std(self.covariance)

    @property
    def transformed(self) -> Gaussian:
        """The estimate in filter coordinates."""
        return Gaussian(self.transformed_iterates[-1], self.transformed_iterate_covariances[-1])

    def interval(self, level: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Lower and upper ends (p,) of each parameter's central credible interval.

        It is symmetric in filter coordinates, so that a parameter estimated by its logarithm stays
        positive. With `transformed_samples` its ends are their quantiles.
        """
        if not 0.0 < level < 1.0:
            raise InputError(f"an interval's level must lie between 0 and 1; got {level:g}")
        if self.transformed_samples is not None:
            tails = (0.5 - 0.5 * level, 0.5 + 0.5 * level)
            low, high = np.quantile(self.transformed_samples, tails, axis=0)
        else:
            z = self.transformed
            half_width = float(scipy.special.ndtri(0.5 + 0.5 * level)) * z.std
            low, high = z.mean - half_width, z.mean + half_width
        return self.transform.inverse(low), self.transform.inverse(high)


def _std(covariances: FloatArray) -> FloatArray:
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
