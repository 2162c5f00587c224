"""Is a posterior the Gaussian that a filter assumes? A check against runs of the model."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import ObservationNoise
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray

DISTANCE_LIMIT = 0.25
"""Error of a distance of one standard deviation. Twice that distance is wrong by about four times
as much: an end of a 95 % interval by a fifth of the interval."""

STEP_LIMIT = 0.5
"""Standard deviations by which one more update may move an estimate."""

TIMES_LIMIT = 2.0
"""Largest relative error of a distance that is within `BEYOND` by the posterior or by the model."""

BEYOND = 6.0
"""Standard deviations beyond which a point is practically impossible."""

NEAREST, FURTHEST = 0.2, 10.0
"""Standard deviations between which a run measures the curvature at the estimate."""

LEVEL = 0.95
"""Probability of the region in which a posterior must be Gaussian."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One run of the model: filter coordinates (p,), prediction (n,) and, if known, H (n, p)."""

    z: FloatArray
    y: FloatArray
    H: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class ApproximationCheck:
    """One property of a filter's posterior, with its limit."""

    compared: str  #: what was compared
    #: the difference, infinite if it could not be computed; the estimate's interval is valid up to
    #: the limit
    value: float
    limit: float
    runs: int  #: runs of the model that were compared

    def __post_init__(self) -> None:
        if np.isnan(self.value) or not self.limit > 0.0:
            raise InputError(
                f"a check needs a value and a positive limit; got {self.value} and {self.limit}"
            )

    @property
    def holds(self) -> bool:
        """Whether the value is within the limit."""
        return self.value <= self.limit

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        verdict = "within" if self.holds else "above"
        return (
            f"{self.compared}: {self.value:.2g}, {verdict} {self.limit:g} "
            f"({self.runs} {'run' if self.runs == 1 else 'runs'})"
        )


def worst(checks: Sequence[ApproximationCheck]) -> ApproximationCheck | None:
    """The check that exceeds its limit most, or comes nearest to it; None without checks."""
    return max(checks, key=lambda check: check.value / check.limit, default=None)


def check_against_runs(
    *,
    y: FloatArray,
    noise: ObservationNoise,
    prior: Gaussian,
    posterior: Gaussian,
    predicted: FloatArray,
    H: FloatArray,
    runs: Sequence[Run],
) -> list[ApproximationCheck]:
    """Compare N(z, P) with the objective J at runs of the model, and with one more update.

    If the posterior were N(z, P) with P = C Cᵀ, a point at the distance ``δ = |C⁻¹ (zₖ − z)|``
    would have ``τ = √(2 (J(zₖ) − J(z))) = δ``, the profile of Bates and Watts (Nonlinear Regression
    Analysis and Its Applications, 1988, section 6.1). Two comparisons are made at every run:

    * τ with δ, closely if the point is probable by either of them, and roughly if it is within
      `BEYOND` by either. This finds a point that is as likely as the estimate but far outside of
      its intervals.
    * The residual of linearisation q = W (h(zₖ) − h(z) − H (zₖ − z)), which grows with δ², scaled
      to one standard deviation: q/δ² (their curvature, section 7.1). With e = W (y − h(z)),
      a = W H (zₖ − z)/δ and x = L⁻¹ (zₖ − z)/δ for a prior covariance L Lᵀ, J differs at a distance
      of ± 1 from its Gaussian by ``½ (|a|² + |x|² − 1) − (q/δ²)·(e ∓ a) + ½ |q/δ²|²``, where the
      brackets are 0 unless P includes second derivatives. A run with derivatives gives
      ½ W (Hₖ − H) C u/δ for other directions u as well.

    Further, an update of the prior with H and e should give N(z, P) itself.

    ``prior`` and ``posterior`` are in filter coordinates. ``predicted (n,)`` and its derivative or
    slope ``H (n, p)`` are those at the posterior's mean.
    """
    z, C = posterior.mean, posterior.factor
    e = noise.whiten(y - predicted)
    WH = noise.whiten(H)
    # The Hessian of the linearised J less that of the Gaussian.
    WC = WH @ C
    X = np.linalg.lstsq(prior.factor, C, rcond=None)[0]
    counted = WC.T @ WC + X.T @ X - np.linalg.lstsq(C, C, rcond=None)[0]

    def objective(at: FloatArray, residual: FloatArray) -> float:
        x = _coordinates(prior.factor, at - prior.mean)[0]
        return 0.5 * float(residual @ residual + x @ x)

    here = objective(z, e)
    probable = float(np.sqrt(2.0 * scipy.special.gammaincinv(0.5 * z.size, LEVEL)))
    compared = 0
    apart: list[float] = []
    times: list[float] = []
    curved: list[float] = []
    for run in runs:
        d = run.z - z
        u, fixed = _coordinates(C, d)
        delta = float(np.linalg.norm(u))
        if delta < NEAREST or fixed:
            continue
        compared += 1
        residual = noise.whiten(y - run.y)
        tau = _signed_root(2.0 * (objective(run.z, residual) - here))
        if min(delta, tau) <= probable:
            apart.append(abs(tau - delta) / max(delta, 1.0))
        if min(delta, tau) <= BEYOND:
            times.append(max(delta, tau) / max(min(delta, tau), NEAREST) - 1.0)
        if delta <= FURTHEST:
            q = (e - residual - WH @ d) / delta**2
            u = u / delta
            curved.append(_change_of_distance(q, e, WC @ u, 0.5 * float(u @ counted @ u)))
            if run.H is not None:
                M = noise.whiten(run.H - H) @ C * (0.5 / delta)
                for v in np.linalg.svd(M, full_matrices=False)[2]:
                    more = 0.5 * float(u @ counted @ v)
                    curved.append(_change_of_distance(M @ v, e, WC @ v, more))

    update = kalman_update(prior, y - predicted + H @ (z - prior.mean), H, noise)
    step = float(np.linalg.norm(_coordinates(C, update.posterior.mean - z)[0]))
    return [
        *(
            ApproximationCheck(what, max(values), limit, compared)
            for values, limit, what in (
                (apart, DISTANCE_LIMIT, "error of distances from the estimate in the posterior"),
                (times, TIMES_LIMIT, "relative error of a distance in the posterior"),
                (curved, DISTANCE_LIMIT, "curvature of the model over one standard deviation"),
            )
            if values
        ),
        ApproximationCheck("step of one more update in standard deviations", step, STEP_LIMIT, 1),
    ]


def _change_of_distance(q: FloatArray, e: FloatArray, a: FloatArray, more: float) -> float:
    """Error of the distance 1 in the direction a (n,), to either side, by the curvature q (n,).

    ``more`` is the linearised J less its Gaussian there.
    """
    changes = [more + 0.5 * float(q @ q) - float(q @ (e - sign * a)) for sign in (1.0, -1.0)]
    return max(abs(_signed_root(1.0 + 2.0 * change) - 1.0) for change in changes)


def _coordinates(factor: FloatArray, offset: FloatArray) -> tuple[FloatArray, bool]:
    """C⁻¹ d (p,), and whether part of d is in a direction of zero variance."""
    u = np.asarray(np.linalg.lstsq(factor, offset, rcond=None)[0], dtype=np.float64)
    left = np.linalg.norm(factor @ u - offset)
    return u, bool(left > 1e-6 * np.linalg.norm(offset))


def _signed_root(value: float) -> float:
    return float(np.sign(value) * np.sqrt(abs(value)))
