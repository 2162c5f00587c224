"""One run of a filter: its problem in filter coordinates, its runs of the model, its iterates."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.estimation.check import ApproximationCheck, Run, check_against_runs, worst
from mvest.estimation.estimate import Estimate, InnovationSummary, OnIterate, Reason
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.consistency import chi_square_band
from mvest.estimation.noise import NoiseCovariance, observation_noise
from mvest.estimation.prediction import (
    ObservationModel,
    Prediction,
    predict,
    read_only,
    require_finite,
)
from mvest.estimation.transform import Identity, Transform, to_filter
from mvest.estimation.update import Update, kalman_update
from mvest.typing import FloatArray


class FilterRun:
    """The checked problem of a filter, and its history so far.

    Every run of the model is counted, and none is repeated at the parameters of the run before.

    Attributes
    ----------
    model, y, R, noise, transform, names
        The problem, checked; ``noise`` is R factorised.
    physical_prior, prior, unit : Gaussian
        Prior of the parameters themselves and in filter coordinates, and N(0, I).
    L : (p, p)
        Root of the prior's covariance. With z = m + L x the prior of x is N(0, I), also if the
        prior holds a parameter fixed.
    forward_solves : int
    """

    def __init__(
        self,
        model: ObservationModel,
        prior: Gaussian,
        y: FloatArray,
        R: NoiseCovariance,
        names: Sequence[str] | None,
        transform: Transform | None,
        on_iterate: OnIterate | None,
    ) -> None:
        self.model, self.physical_prior, self.R = model, prior, R
        self.y = read_only(y)
        if self.y.ndim != 1 or self.y.size == 0:
            raise InputError(f"the observation y must have shape (n,), n > 0; got {self.y.shape}")
        require_finite(self.y, "the observation y")
        self.noise = observation_noise(R, self.y.size)
        self.transform = Identity() if transform is None else transform
        self.names = tuple(f"m[{i}]" for i in range(prior.size)) if names is None else tuple(names)
        if len(self.names) != prior.size or len(set(self.names)) != prior.size:
            raise InputError(
                f"{prior.size} parameters need as many different names; got {self.names}"
            )
        self.prior = to_filter(self.transform, prior)
        self.L = self.prior.factor
        self.unit = Gaussian(np.zeros(prior.size), np.eye(prior.size))
        self.forward_solves = 0
        self._on_iterate = on_iterate
        self._last: tuple[FloatArray, Prediction] | None = None
        self._runs: list[Run] = []
        self._history: list[tuple[FloatArray, FloatArray, float, float]] = []

    def z(self, x: FloatArray) -> FloatArray:
        """Filter coordinates m + L x (p,)."""
        return self.prior.mean + self.L @ x

    def predict(self, z: FloatArray, *, derivatives: bool = True) -> Prediction:
        """Run the model at filter coordinates z (p,), unless it was just run there.

        See `as_prediction` for the errors. Without ``derivatives`` any model will do.
        """
        if self._last is not None and np.array_equal(self._last[0], z):
            return self._last[1]
        m = self.transform.inverse(z)
        if not np.all(np.isfinite(m)):
            return Prediction.failed(f"the parameters {m} are not finite")
        self.forward_solves += 1
        prediction = predict(self.model, m, self.y.size, derivatives=derivatives)
        self._last = (z.copy(), prediction)
        if prediction.converged:
            H = self.jacobian(z, prediction) if prediction.differentiated else None
            self._runs.append(Run(z.copy(), prediction.y, H))
        return prediction

    def jacobian(self, z: FloatArray, prediction: Prediction) -> FloatArray:
        """dh/dz (n, p) at filter coordinates z, from the model's dh/dm."""
        return prediction.jacobian * self.transform.derivative(z)

    def misfit(self, prediction: Prediction) -> float:
        """½ (y − h)ᵀ R⁻¹ (y − h)."""
        e = self.noise.whiten(self.y - prediction.y)
        return 0.5 * float(e @ e)

    def negligible(self, change: FloatArray, z: FloatArray, P: FloatArray, limit: float) -> bool:
        """Whether a change of z moves no parameter by more than the relative `limit`.

        Relative to ``|m|``, or to the standard deviation of m if that is larger.
        """
        D = np.abs(self.transform.derivative(z))
        std = D * np.sqrt(np.diagonal(P))
        scale = np.maximum(np.abs(self.transform.inverse(z)), std)
        return bool(np.all(D * np.abs(change) <= limit * scale))

    def record(self, z: FloatArray, P: FloatArray, objective: float, log_likelihood: float) -> None:
        """Append an iterate (filter coordinates) to the history."""
        self._history.append((np.array(z), np.array(P), objective, log_likelihood))
        if self._on_iterate is not None:
            number = len(self._history) - 1
            self._on_iterate(number, self.transform.inverse(z).copy(), objective)

    def check(
        self,
        prediction: Prediction,
        *,
        others: Sequence[ApproximationCheck] = (),
        prior: Gaussian | None = None,
    ) -> ApproximationCheck | None:
        """The worst check of the last iterate's posterior, at whose mean `prediction` was made.

        It is compared with all runs of the model. ``others`` are the filter's own checks.
        """
        z, P, *_ = self._history[-1]
        if not np.all(np.isfinite(P)) or not np.any(P):
            return worst(others)
        checks = check_against_runs(
            y=self.y,
            noise=self.noise,
            prior=self.prior if prior is None else prior,
            posterior=Gaussian(z, P),
            predicted=prediction.y,
            H=self.jacobian(z, prediction),
            runs=self._runs,
        )
        return worst([*checks, *others])

    def finish(
        self,
        reason: Reason,
        detail: str,
        prediction: Prediction,
        innovation: FloatArray,
        update: Update,
        *,
        prior: Gaussian | None = None,
        **more: Any,
    ) -> Estimate:
        """The estimate at the last recorded iterate, at which `prediction` was made.

        ``prior`` was updated last, if not that of the problem; ``more`` are further fields of the
        `Estimate`. Noise that was ``learned`` widens the covariance.
        """
        if "check" not in more:
            # The posterior for this noise is checked before the noise's uncertainty widens it.
            more["check"] = self.check(prediction, prior=prior)
        if learned := more.get("learned"):
            z, P, *values = self._history[-1]
            self._history[-1] = (z, P + learned.covariance, *values)
        more["innovation"] = InnovationSummary(
            size=innovation.size,
            rms=float(np.sqrt(np.mean(innovation**2))),
            max_abs=float(np.max(np.abs(innovation))),
            nis=update.nis,
            nis_band=chi_square_band(innovation.size),
            residual_rms=float(np.sqrt(np.mean((self.y - prediction.y) ** 2))),
        )
        standardised = update.standardised_innovation
        return self._estimate(reason, detail, prediction, standardised=standardised, **more)

    def finish_with_slope(
        self,
        z: FloatArray,
        P: FloatArray,
        slope: FloatArray,
        reason: Reason,
        detail: str,
        samples: FloatArray | None = None,
        checks: Sequence[ApproximationCheck] = (),
    ) -> Estimate:
        """Run the model at the estimate N(z, P) in filter coordinates, record it, and finish.

        ``slope (n, p)`` is dh/dz between the filter's points, used if the model has no derivative.
        ``checks`` are the filter's own; to ``samples (s, p)`` of the posterior no others apply.
        """
        prediction = self.predict(z, derivatives=False)
        if not prediction.converged:
            return self.fail(z, P, prediction)
        if not prediction.differentiated:
            jacobian = slope / self.transform.derivative(z)
            prediction = replace(prediction, jacobian=jacobian)
        H = self.jacobian(z, prediction)
        innovation = self.y - prediction.y + H @ (z - self.prior.mean)
        update = kalman_update(self.prior, innovation, H, self.noise)
        # Fixed parameters have no share in the prior's term.
        x = np.linalg.lstsq(self.L, z - self.prior.mean, rcond=None)[0]
        objective = self.misfit(prediction) + 0.5 * float(x @ x)
        self.record(z, P, objective, update.log_likelihood)
        check = self.check(prediction, others=checks) if samples is None else worst(checks)
        drawn = None if samples is None else read_only(samples)
        return self.finish(
            reason, detail, prediction, innovation, update, check=check, transformed_samples=drawn
        )

    def fail(self, z: FloatArray, P: FloatArray, prediction: Prediction) -> Estimate:
        """End a run whose next iterate (z, P) has no prediction."""
        self.record(z, P, np.nan, np.nan)
        detail = f"at {self.transform.inverse(z)}: {prediction.reason}"
        return self._estimate(Reason.MODEL_FAILED, detail, None, innovation=None)

    def _estimate(
        self, reason: Reason, detail: str, prediction: Prediction | None, **more: Any
    ) -> Estimate:
        iterates, covariances, objective, log_likelihood = (
            read_only(np.array(column)) for column in zip(*self._history, strict=True)
        )
        return Estimate(
            names=self.names,
            prior=self.physical_prior,
            transform=self.transform,
            transformed_iterates=iterates,
            transformed_iterate_covariances=covariances,
            objective=objective,
            log_likelihood=log_likelihood,
            prediction=prediction,
            reason=reason,
            detail=detail,
            forward_solves=self.forward_solves,
            **more,
        )


class Filter:
    """Settings of a filter, which can be called on a model, a prior and observations.

    A filter overrides `estimate`, a function of its `FilterRun`.
    """

    __slots__ = ()

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
        """Estimate the parameters of a model.

        InputError if a setting, a shape or a covariance is not admissible; never for a failing
        model.

        Parameters
        ----------
        model : ObservationModel
        prior : Gaussian
            N(m, P) of the parameters themselves.
        y : (n,)
            Observation.
        R : NoiseCovariance
        names : sequence of str, (p,), optional
        transform : Transform, optional
            Filter coordinates; default `Identity`.
        on_iterate : callable, optional
            Called with each iterate.
        """
        return self.estimate(FilterRun(model, prior, y, R, names, transform, on_iterate))

    def estimate(self, run: FilterRun) -> Estimate:
        """Run the filter, from the prior to `FilterRun.finish` or `FilterRun.fail`."""
        raise NotImplementedError


def by_filter(slope: FloatArray, L: FloatArray) -> FloatArray:
    """dh/dz (n, p) from dh/dx where z = m + L x; 0 for parameters that the prior holds fixed."""
    return np.asarray(np.linalg.lstsq(L.T, slope.T, rcond=None)[0].T, dtype=np.float64)
