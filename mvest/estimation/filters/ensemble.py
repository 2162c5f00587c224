"""Ensemble Kalman filter and smoother: covariances of many runs of the model."""

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.estimation.check import STEP_LIMIT, ApproximationCheck
from mvest.estimation.estimate import Estimate, Reason
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction
from mvest.estimation.run import Filter, FilterRun
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray

KINDS = ("square_root", "perturbed")


@dataclass(frozen=True, slots=True)
class EnsembleFilter(Filter):
    """Conditions an ensemble on the observation, in one step or in several smaller ones.

    N members xⱼ are drawn from the prior, which is N(0, I) in these coordinates. One step with the
    noise α R, in whitened observations (W R Wᵀ = I), is::

        dⱼ = W (y − h(xⱼ))                       N runs of the model
        A  = (xⱼ − x̄) / √(N−1),  S = (d̄ − dⱼ) / √(N−1)      anomalies, (p, N) and (n, N)
        K  = A Sᵀ (S Sᵀ + α I)⁻¹ = A (Sᵀ S + α I)⁻¹ Sᵀ      gain

    and then, with observations perturbed for each member (Evensen 1994, J. Geophys. Res. 99:10143;
    Burgers, van Leeuwen and Evensen 1998, Mon. Weather Rev. 126:1719)::

        xⱼ⁺ = xⱼ + K (dⱼ + √α εⱼ),   εⱼ ~ N(0, I), centred

    or by a square root without random numbers (Bishop, Etherton and Majumdar 2001, Mon. Weather
    Rev. 129:420; symmetric as Hunt, Kostelich and Szunyogh 2007, Physica D 230:112)::

        x̄⁺ = x̄ + K d̄,   A⁺ = A (I + Sᵀ S / α)^(−1/2)

    One step with α = 1 is the ensemble Kalman filter. k steps with α = k are the ensemble smoother
    with multiple data assimilation (Emerick and Reynolds 2013, Comput. Geosci. 55:3): each uses a
    k-th of the observation's information and linearises the model at the current ensemble.

    Members are drawn with exactly the prior's mean and covariance (second-order exact sampling,
    Pham 2001, Mon. Weather Rev. 129:1194). For a linear model and N > p the square root is then
    exactly the Kalman filter; the perturbed form has its mean in one step, and its covariance up to
    the error of N draws. Members whose model fails are left out.
    """

    #: N and k
    members: int = 30
    steps: int = 1
    kind: str = "square_root"  #: ``square_root`` or ``perturbed``
    seed: int = 1

    def __post_init__(self) -> None:
        if self.members < 3 or self.steps < 1:
            raise InputError(
                f"an ensemble needs at least 3 members and 1 step; got {self.members} and "
                f"{self.steps}"
            )
        if self.kind not in KINDS:
            raise InputError(f"kind of ensemble = {self.kind!r}, expected {' or '.join(KINDS)}")

    def estimate(self, run: FilterRun) -> Estimate:
        """Condition an ensemble."""
        p = run.prior.size
        if self.members < p + 2:
            raise InputError(f"{p} parameters need at least {p + 2} members; got {self.members}")
        rng = np.random.default_rng(self.seed)
        X = exact_ensemble(self.members, p, rng)
        for _ in range(self.steps):
            X, predicted, failure = _run_members(run, X)
            z, P = _moments(run, X)
            if failure is not None and len(X) < p + 2:
                return run.fail(z, P, failure)
            D = run.noise.whiten((run.y - predicted).T)
            x, d = X.mean(axis=0), D.mean(axis=1)
            run.record(z, P, 0.5 * float(d @ d + x @ x), np.nan)
            members = X
            noise = rng.standard_normal(D.shape) if self.kind == "perturbed" else None
            X = _conditioned(X, D, float(self.steps), noise)
        z, P = _moments(run, X)
        detail = f"{len(X)} of {self.members} members, {self.steps} steps"
        slope = _slope(run, members, predicted)
        checks = _halves(run, members, predicted, Gaussian(z, P))
        return run.finish_with_slope(z, P, slope, Reason.COMPLETED, detail, checks=checks)


def _conditioned(
    X: FloatArray, D: FloatArray, alpha: float, noise: FloatArray | None
) -> FloatArray:
    """Members (N, p) after a step from ``X``, with innovations ``D`` and ``noise`` (n, N)."""
    root = np.sqrt(len(X) - 1.0)
    x, d = X.mean(axis=0), D.mean(axis=1)
    A, S = (X - x).T / root, (d[:, None] - D) / root
    values, V = np.linalg.eigh(S.T @ S)
    values = np.maximum(values, 0.0)
    if noise is not None:
        noise = (noise - noise.mean(axis=1, keepdims=True)) * np.sqrt(len(X) / (len(X) - 1.0))
        moved = (V / (values + alpha)) @ (V.T @ (S.T @ (D + np.sqrt(alpha) * noise)))
        return np.asarray(X + (A @ moved).T)
    weights = (V / (values + alpha)) @ (V.T @ (S.T @ d))
    square_root = (V / np.sqrt(1.0 + values / alpha)) @ V.T
    return np.asarray(x + (A @ weights) + root * (A @ square_root).T)


def exact_ensemble(members: int, size: int, rng: np.random.Generator) -> FloatArray:
    """Members (N, p) whose mean is 0 and whose covariance, divided by N − 1, is I."""
    drawn = rng.standard_normal((members, size))
    # Orthonormal columns, all orthogonal to the column of ones.
    Q = np.linalg.qr(drawn - drawn.mean(axis=0))[0]
    return np.asarray(np.sqrt(members - 1.0) * Q)


def _run_members(run: FilterRun, X: FloatArray) -> tuple[FloatArray, FloatArray, Prediction | None]:
    """Members with a prediction, their predictions (N, n), and the last failure if any failed."""
    kept: list[FloatArray] = []
    predicted: list[FloatArray] = []
    failure: Prediction | None = None
    for x in X:
        prediction = run.predict(run.z(x), derivatives=False)
        if prediction.converged:
            kept.append(x)
            predicted.append(prediction.y)
        else:
            failure = prediction
    if not kept:
        return X[:1], np.empty((0, run.y.size)), failure
    return np.array(kept), np.array(predicted), failure


def _moments(run: FilterRun, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (p,) and covariance (p, p) of members in filter coordinates."""
    x = X.mean(axis=0)
    A = run.L @ (X - x).T / np.sqrt(max(len(X) - 1.0, 1.0))
    return run.z(x), A @ A.T


def _slope(run: FilterRun, X: FloatArray, predicted: FloatArray) -> FloatArray:
    """Regression dh/dz (n, p) of predictions (N, n) on their members (N, p)."""
    Z = (X - X.mean(axis=0)) @ run.L.T
    return np.asarray(np.linalg.lstsq(Z, predicted - predicted.mean(axis=0), rcond=None)[0].T)


def _halves(
    run: FilterRun, X: FloatArray, predicted: FloatArray, posterior: Gaussian
) -> list[ApproximationCheck]:
    """Compare the updates of the prior by either half of the members.

    The slope of a linear model is the same for all members; that of a non-linear one varies.
    """
    half = len(X) // 2
    if half < X.shape[1] + 2:
        return []
    means = []
    for part in (slice(None, half), slice(half, 2 * half)):
        H = _slope(run, X[part], predicted[part])
        e = run.y - predicted[part].mean(axis=0) + H @ run.L @ X[part].mean(axis=0)
        means.append(kalman_update(run.prior, e, H, run.noise).posterior.mean)
    apart = np.linalg.lstsq(posterior.factor, means[1] - means[0], rcond=None)[0]
    # The error of the whole ensemble is about half the distance between its halves.
    return [
        ApproximationCheck(
            "estimates by the two halves of the ensemble, half their distance in standard "
            "deviations",
            0.5 * float(np.linalg.norm(apart)),
            STEP_LIMIT,
            2 * half,
        )
    ]
