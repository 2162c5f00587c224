"""The reduced-order unscented Kalman filter: p + 1 runs of the model instead of a Jacobian."""

from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import require_numbers
from mvest.estimation.estimate import Estimate, Reason
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction
from mvest.estimation.run import Filter, FilterRun, by_filter
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray

MAX_REJECTIONS = 6
"""How often the points may be contracted in one round."""


@dataclass(frozen=True, slots=True)
class UnscentedFilter(Filter):
    """Statistical linearisation with the corners of a simplex, iterated about the posterior.

    In coordinates x in which the prior is N(0, I), and with the p + 1 corners σⱼ of a regular
    simplex, whose mean is 0 and whose covariance is I, one round about N(x, C Cᵀ) is::

        xⱼ = x + C σⱼ,   yⱼ = h(xⱼ)                  p + 1 runs of the model
        ȳ  = 1/(p+1) Σ yⱼ
        G  = 1/(p+1) Σ yⱼ σⱼᵀ                         slope of h, times C
        H  = G C⁻¹
        x⁺, P⁺ = update of 0, I with y − ȳ + H x, H, R     see `kalman_update`

    The first round, about the prior, is the reduced-order unscented Kalman filter of Moireau and
    Chapelle (2011), ESAIM: Control, Optimisation and Calculus of Variations 17:380-405, for
    constant parameters (there L = dθ/dx, U = I + Gᵀ R⁻¹ G, θ⁺ = θ + L U⁻¹ Gᵀ R⁻¹ (y − ȳ)).
    Further rounds place the points around the posterior so far, N(x⁺, P⁺), and update the prior
    again, so that each observation counts once (García-Fernández, Svensson, Morelande and
    Särkkä 2015, IEEE Trans. Signal Process. 63:5561). At the fixed point H is the mean slope over
    the posterior. The predictions of p + 1 points lie on a plane, so that there is no error of
    linearisation to be added to R.

    If a point has no prediction, its round is repeated with the points at half the distance, half
    way back to the previous mean. A step that is no smaller than the last one is halved.
    """

    #: stop when a further round changes no parameter by more than this part of its size (or of its
    #: standard deviation if that is larger)
    tolerance: float = 1e-3
    max_iterations: int = 15  #: rounds. 1 is the filter of Moireau and Chapelle.
    spread: float = 1.0  #: distance of the points from their mean; at 1 their covariance is P

    def __post_init__(self) -> None:
        require_numbers(self, "filter", "tolerance", "spread")
        require_numbers(self, "filter", "max_iterations", least=1)

    def estimate(self, run: FilterRun) -> Estimate:
        """Estimate without derivatives."""
        L = run.L
        at, before = run.unit, run.unit
        share, change = 1.0, np.inf
        for rounds in range(1, self.max_iterations + 1):
            linearised = self._linearise(run, at, before.mean)
            if isinstance(linearised, Prediction):
                return run.fail(run.z(at.mean), L @ at.covariance @ L.T, linearised)
            at, mean, H = linearised
            z, e = run.z(at.mean), run.y - mean
            update = kalman_update(run.unit, e + H @ at.mean, H, run.noise)
            white = run.noise.whiten(e)
            objective = 0.5 * float(white @ white + at.mean @ at.mean)
            run.record(z, L @ at.covariance @ L.T, objective, update.log_likelihood)

            posterior = update.posterior
            step = posterior.mean - at.mean
            size = float(np.linalg.norm(np.linalg.solve(posterior.factor, step)))
            P = L @ posterior.covariance @ L.T
            converged = run.negligible(L @ step, z, P, self.tolerance)
            if converged or rounds == self.max_iterations:
                break
            share = 0.5 * share if size >= change else share
            change = size
            before, at = at, Gaussian(at.mean + share * step, posterior.covariance)
        reason = Reason.CONVERGED if converged else Reason.MAX_ITERATIONS
        if self.max_iterations == 1:
            reason = Reason.COMPLETED
        detail = f"{rounds} rounds of {run.prior.size + 1} points, tolerance {self.tolerance:g}"
        return run.finish_with_slope(run.z(posterior.mean), P, by_filter(H, L), reason, detail)

    def _linearise(
        self, run: FilterRun, at: Gaussian, before: FloatArray
    ) -> tuple[Gaussian, FloatArray, FloatArray] | Prediction:
        """Center and spread with all predictions, their mean and the slope dh/dx (n, p)."""
        C, x, spread = at.factor, at.mean, self.spread
        for _ in range(MAX_REJECTIONS + 1):
            points = simplex_points(at.mean.size)
            predicted: list[FloatArray] = []
            for point in x + spread * points @ C.T:
                prediction = run.predict(run.z(point), derivatives=False)
                if not prediction.converged:
                    break
                predicted.append(prediction.y)
            else:
                values = np.array(predicted)
                G = values.T @ points / len(points)
                H = np.asarray(np.linalg.solve(spread * C.T, G.T).T, dtype=np.float64)
                return Gaussian(x, at.covariance), values.mean(axis=0), H
            spread *= 0.5
            x = 0.5 * (x + before)
        return prediction


def simplex_points(size: int) -> FloatArray:
    """Corners (p + 1, p) of a regular simplex with mean 0 and covariance I, divided by p + 1."""
    return np.sqrt(size + 1.0) * np.asarray(scipy.linalg.helmert(size + 1), dtype=np.float64).T
