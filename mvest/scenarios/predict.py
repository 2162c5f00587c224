"""Predicts one scenario at the estimate and at samples of its posterior."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from mvest.closure.model import ClosureModel
from mvest.errors import InputError, MaterialError
from mvest.estimation.estimate import Estimate
from mvest.scenarios.measures import NEVER_NEGATIVE, Measured, measure_closed
from mvest.typing import FloatArray


def posterior_samples(estimate: Estimate, count: int, seed: int) -> FloatArray:
    """Draw samples ``(count, p)`` from the parameters' posterior.

    Uses a scrambled Sobol sequence (Owen 1998, J. Complexity 14:466), transformed to the normal
    distribution in filter coordinates.

    InputError if the estimate has not converged or the count is not a power of two.

    Parameters
    ----------
    estimate : Estimate
        Converged.
    count : int
        A power of two balances the sequence.
    seed : int
    """
    if not estimate.converged:
        raise InputError(f"no samples: the estimate has not converged: {estimate.reason.value}")
    if count < 2 or count & (count - 1):
        raise InputError(f"samples = {count}, expected a power of two > 1")
    posterior = estimate.transformed
    points = scipy.stats.qmc.Sobol(posterior.size, scramble=True, seed=seed).random(count)
    z = posterior.mean + scipy.special.ndtri(points) @ posterior.factor.T
    return np.array([estimate.transform.inverse(row) for row in z])


NORMAL_95 = 1.959963984540054
"""Half-width of a 95 % interval in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Measures of one closed valve; empty, with a reason, if the valve does not close."""

    measures: Measured
    reason: str = ""

    def get(self, name: str) -> float:
        """A measure; NaN if unknown."""
        return self.measures.get(name, float("nan"))


@dataclass(frozen=True, slots=True, eq=False)
class PredictedScenario:
    """Prediction of a valve under one scenario."""

    at_estimate: Sample
    shape: FloatArray | None  #: ``(n, 3)`` mm, observed vertices at the estimate
    samples: tuple[Sample, ...]  #: from the posterior, including failed ones
    finer: Sample | None = None  #: the same valve at the estimate on a finer mesh, if computed

    @property
    def failures(self) -> tuple[str, ...]:
        """Reasons of the failed samples."""
        return tuple(sample.reason for sample in self.samples if not sample.measures)

    def spread(self, name: str) -> dict[str, float]:
        """Statistics of a measure over the samples that did not fail.

        Returns a dict: ``mean`` and ``std``; ``low`` and ``high``, the 2.5 and 97.5 % quantiles
        (Hyndman and Fan 1996, Am. Stat. 50:361, type 8), close to the extremes with fewer than 40
        samples; and the number of finite ``samples``. NaN if these are too few.
        """
        known = np.array([v for v in (one.get(name) for one in self.samples) if np.isfinite(v)])
        mean = float(known.mean()) if len(known) else float("nan")
        std = low = high = float("nan")
        if len(known) > 1:
            std = float(known.std(ddof=1))
            low, high = map(float, np.quantile(known, [0.025, 0.975], method="median_unbiased"))
        return {"mean": mean, "std": std, "low": low, "high": high, "samples": len(known)}

    def mesh_error(self, name: str) -> float:
        """Difference between a measure and its value on the finer mesh; NaN without one.

        The difference is used as the standard deviation of the mesh error [choice]. Roache's grid
        convergence index for two meshes (1994, J. Fluids Eng. 116:405) is stricter: with its safety
        factor of 3, a refinement ratio of 1.65 and second order it gives 4.7 differences, where
        `interval` uses 1.96.
        """
        finer = float("nan") if self.finer is None else self.finer.get(name)
        return abs(finer - self.at_estimate.get(name))

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a measure including the mesh error; NaN if that error is unknown.

        On each side of the estimate, the distance to the samples' quantile and 1.96 mesh errors are
        combined as independent errors. Measures in `NEVER_NEGATIVE` stay non-negative.
        """
        spread, error = self.spread(name), NORMAL_95 * self.mesh_error(name)
        centre = self.at_estimate.get(name)
        low = centre - np.hypot(max(centre - spread["low"], 0.0), error)
        high = centre + np.hypot(max(spread["high"] - centre, 0.0), error)
        if name.startswith(NEVER_NEGATIVE) and low < 0.0:
            low = 0.0
        return float(low), float(high)

    def against(self, own: Sample, same: Sample) -> dict[str, dict[str, float | bool | None]]:
        """Compare every measure with that of the true valve.

        Returns a dict: measure -> its ``estimate``, `spread`, ``mesh_error``, the ``wide_``
        `interval` with it, both truths, and whether the intervals contain them; None if unknown.

        ``own, same``: the true parameters' valve on its own mesh, and on the estimator's mesh,
        where only the parameters are uncertain.
        """

        def inside(interval: tuple[float, float], true: float | None) -> bool | None:
            low, high = interval
            return (
                None if true is None or not np.isfinite(high - low) else bool(low <= true <= high)
            )

        rows: dict[str, dict[str, float | bool | None]] = {}
        for name, value in self.at_estimate.measures.items():
            spread, wide = self.spread(name), self.interval(name)
            narrow = spread["low"], spread["high"]
            on_own, on_same = own.measures.get(name), same.measures.get(name)
            rows[name] = {
                "estimate": value,
                **spread,
                "mesh_error": self.mesh_error(name),
                "wide_low": wide[0],
                "wide_high": wide[1],
                "truth_own_mesh": on_own,
                "inside_own_mesh": inside(narrow, on_own),
                "truth_same_mesh": on_same,
                "inside_same_mesh": inside(narrow, on_same),
                "inside_wide": inside(wide, on_own),
            }
        return rows


def closed_valve(
    model: ClosureModel, m: FloatArray, *, sensitivities: bool = False
) -> tuple[Sample, FloatArray | None]:
    """Measures of a closed valve, and its observed vertices ``(n, 3)`` mm, or None on failure."""
    try:
        result = model.close(m, sensitivities=sensitivities)
    except MaterialError as error:
        return Sample({}, str(error)), None
    if not result.simulation.converged:
        return Sample({}, result.simulation.reason.value), None
    x = result.simulation.frames[-1]
    return Sample(measure_closed(model, result.system, x)), model.observed(x)


def predict_scenario(
    model: ClosureModel,
    estimate: Estimate,
    samples: FloatArray,
    on_sample: Callable[[int], None] | None = None,
    *,
    finer: ClosureModel | None = None,
) -> PredictedScenario:
    """Predict a valve under a scenario, with the uncertainty of its estimate.

    InputError if estimate and model do not have the same parameters.

    Parameters
    ----------
    model : ClosureModel
        The model under the scenario. With ``continuation``, every sample is continued from the
        closed valve at the estimate.
    estimate : Estimate
    samples : ndarray
        ``(k, p)`` of its posterior.
    on_sample : callable, optional
        Called with the number of each finished sample, to show progress.
    finer : ClosureModel, optional
        The same model on a finer mesh, closed once at the estimate, for the mesh error.
    """
    if estimate.names != model.names:
        raise InputError(
            f"the estimate is of {', '.join(estimate.names)}, the model has "
            f"{', '.join(model.names)}"
        )
    # The derivatives predict the equilibria of the samples.
    first, shape = closed_valve(model, estimate.mean, sensitivities=True)
    start = model.closed
    predicted = []
    for number, m in enumerate(samples):
        # All samples have the same start, so that none depends on the previous one.
        model.restart(start)
        predicted.append(closed_valve(model, m)[0])
        if on_sample is not None:
            on_sample(number)
    check = None if finer is None else closed_valve(finer, estimate.mean)[0]
    return PredictedScenario(first, shape, tuple(predicted), check)
