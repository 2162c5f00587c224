"""The Schmidt-Kalman filter: parameters that are not estimated, but whose doubt is counted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvest.errors import InputError
from mvest.estimation.estimate import Estimate, OnIterate, Reason
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import (
    NoiseCovariance,
    ObservationNoise,
    low_rank_noise,
    observation_noise,
)
from mvest.estimation.noise_family import ErrorColumns, NoiseFamily
from mvest.estimation.prediction import ObservationModel, Prediction, predict, read_only
from mvest.estimation.run import require_settings
from mvest.estimation.transform import Identity, Transform, to_filter
from mvest.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class SchmidtFilter:
    """Estimates some parameters and considers the others.

    A considered parameter c keeps its prior N(c₀, P_c), and its doubt is carried into the noise of
    the observations (Schmidt 1966, Adv. Control Syst. 3:293; Jazwinski, Stochastic Processes and
    Filtering Theory, 1970, section 8.4)::

        R' = R + C P_c Cᵀ,   C = dh/dc
        m⁺, P_mm = estimate of m alone with the noise R'
        P_mc = −K C P_c,     K = P_mm Hᵀ R'⁻¹,     P_cc = P_c

    For one observation of a linear model the estimate of m and its covariance are those of the
    filter that estimates c as well; c itself stays where it was. C depends on m, so that rounds of
    estimation alternate with its renewal until m no longer changes.

    Attributes
    ----------
    inner : IteratedFilter
        Estimates the other parameters.
    considered : tuple of str
        Names of the parameters that are considered.
    tolerance : float
        Stop when a further round changes no parameter by more than this part of its posterior
        standard deviation.
    max_rounds : int

    Raises
    ------
    InputError
        For a considered parameter that the problem does not have, or none left to estimate.
    """

    inner: IteratedFilter
    considered: tuple[str, ...]
    tolerance: float = 0.02
    max_rounds: int = 6

    def __post_init__(self) -> None:
        require_settings(tolerance=self.tolerance, max_iterations=self.max_rounds)
        if len(set(self.considered)) != len(self.considered):
            raise InputError(f"considered parameters {self.considered} are not all different")

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
        """Estimate; see `Filter` for the arguments."""
        names = tuple(f"m[{i}]" for i in range(prior.size)) if names is None else tuple(names)
        unknown = sorted(set(self.considered) - set(names))
        if unknown or len(self.considered) == len(names):
            raise InputError(
                f"considered parameters {', '.join(self.considered)}: expected some, but not all, "
                f"of {', '.join(names)}"
            )
        among = np.array([name in self.considered for name in names])
        if np.any(prior.covariance[np.ix_(among, ~among)]):
            raise InputError("considered parameters must be independent of the others in the prior")
        problem = _Problem(
            model,
            prior,
            Identity() if transform is None else transform,
            names,
            among,
        )
        size = np.size(y)
        base = R if isinstance(R, NoiseFamily) else observation_noise(R, size)
        estimated = problem.estimated
        start = problem(estimated.mean)
        if not start.converged:
            return problem.failed(start)
        filter_, solves = self.inner, 1
        noise = _with_columns(base, problem.columns)
        last: Estimate | None = None
        for _ in range(self.max_rounds):
            result = filter_(
                problem,
                estimated,
                y,
                noise,
                names=problem.kept_names,
                transform=problem.kept_transform,
                on_iterate=on_iterate,
            )
            solves += result.forward_solves
            if not result.converged or (last is not None and self._settled(last, result)):
                break
            last = result
            problem(result.mean)
            noise = _with_columns(base, problem.columns)
            filter_ = replace(self.inner, start=tuple(map(float, result.mean)))
        final = noise if result.learned is None else result.learned.noise
        return problem.whole(result, observation_noise(final, size), solves)

    def _settled(self, last: Estimate, new: Estimate) -> bool:
        change = np.abs(new.transformed_iterates[-1] - last.transformed_iterates[-1])
        return bool(np.all(change <= self.tolerance * new.transformed.std))


def _with_columns(
    base: ObservationNoise | NoiseFamily, columns: FloatArray
) -> ObservationNoise | NoiseFamily:
    """The noise with what the considered parameters add to it."""
    if isinstance(base, NoiseFamily):
        return base.plus(ErrorColumns("considered", columns))
    return low_rank_noise(base, columns)


class _Problem:
    """The model as a function of the estimated parameters, the considered ones at their prior.

    The last prediction is kept whole, so that its derivative by the considered parameters costs no
    further run.
    """

    def __init__(
        self,
        model: ObservationModel,
        prior: Gaussian,
        transform: Transform,
        names: tuple[str, ...],
        considered: BoolArray,
    ) -> None:
        self.model, self.prior, self.transform, self.names = model, prior, transform, names
        # As the finished estimate states them, to the last bit.
        self._mean = transform.inverse(transform.forward(prior.mean))
        self.kept = np.flatnonzero(~considered)
        self.considered = np.flatnonzero(considered)
        self.estimated = _part(prior, self.kept)
        self.kept_names = [names[i] for i in self.kept]
        self.kept_transform = _PartTransform(transform, prior.mean, self.kept)
        self._last: tuple[FloatArray, Prediction] | None = None

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict at estimated parameters ``m``, differentiated by them only."""
        if self._last is None or not np.array_equal(self._last[0], m):
            prediction = predict(self.model, self._filled(m), derivatives=True)
            self._last = np.array(m, dtype=np.float64), prediction
        prediction = self._last[1]
        if not prediction.converged:
            return prediction
        return replace(prediction, jacobian=prediction.jacobian[:, self.kept])

    @property
    def columns(self) -> FloatArray:
        """C L with P_c = L Lᵀ at the last prediction, (n, q)."""
        assert self._last is not None
        return np.asarray(
            self._last[1].jacobian[:, self.considered] @ _part(self.prior, self.considered).factor
        )

    def _filled(self, m: FloatArray) -> FloatArray:
        """All parameters (p,), the considered ones at their prior mean."""
        whole = np.array(self._mean)
        whole[self.kept] = m
        return whole

    def failed(self, prediction: Prediction) -> Estimate:
        """The end of a run whose first prediction failed."""
        prior = to_filter(self.transform, self.prior)
        nan = np.full(1, np.nan)
        return Estimate(
            names=self.names,
            prior=self.prior,
            transform=self.transform,
            transformed_iterates=prior.mean[None],
            transformed_iterate_covariances=prior.covariance[None],
            objective=nan,
            log_likelihood=nan,
            prediction=None,
            innovation=None,
            reason=Reason.MODEL_FAILED,
            detail=f"at {self.prior.mean}: {prediction.reason}",
            forward_solves=1,
        )

    def whole(self, part: Estimate, noise: ObservationNoise, solves: int) -> Estimate:
        """The estimate of all parameters, from that of the estimated ones."""
        k = len(part.transformed_iterates)
        prior = to_filter(self.transform, self.prior)
        iterates = np.tile(prior.mean, (k, 1))
        iterates[:, self.kept] = part.transformed_iterates
        covariances = np.tile(prior.covariance, (k, 1, 1))
        for c, P in zip(covariances, part.transformed_iterate_covariances, strict=True):
            c[np.ix_(self.kept, self.kept)] = P
        prediction = None
        if part.prediction is not None and self(part.mean).converged and self._last is not None:
            prediction = self._last[1]
            learned = 0.0 if part.learned is None else part.learned.covariance
            covariances[-1] = self._with_cross(
                covariances[-1], learned, iterates[-1], prediction, noise
            )
        return replace(
            part,
            names=self.names,
            prior=self.prior,
            transform=self.transform,
            transformed_iterates=read_only(iterates),
            transformed_iterate_covariances=read_only(covariances),
            prediction=prediction,
            forward_solves=solves,
        )

    def _with_cross(
        self,
        P: FloatArray,
        learned: float | FloatArray,
        z: FloatArray,
        prediction: Prediction,
        noise: ObservationNoise,
    ) -> FloatArray:
        """The covariance (p, p) with P_mc = −K C P_c.

        ``learned`` is the part of that of m that is due to the doubt of the noise.
        """
        D = self.transform.derivative(z)
        WH = noise.whiten(prediction.jacobian * D)
        H, C = WH[:, self.kept], WH[:, self.considered]
        P = P.copy()
        P_mm = P[np.ix_(self.kept, self.kept)] - learned
        P_cc = P[np.ix_(self.considered, self.considered)]
        cross = -P_mm @ (H.T @ C) @ P_cc
        P[np.ix_(self.kept, self.considered)] = cross
        P[np.ix_(self.considered, self.kept)] = cross.T
        return P


@dataclass(frozen=True, slots=True, eq=False)
class _PartTransform:
    """A transform of all parameters, of some of them; it takes each parameter by itself."""

    transform: Transform
    values: FloatArray
    kept: IntArray

    def forward(self, m: FloatArray, /) -> FloatArray:
        return self.transform.forward(self._filled(self.values, m))[self.kept]

    def inverse(self, z: FloatArray, /) -> FloatArray:
        return self.transform.inverse(self._filled(self.transform.forward(self.values), z))[
            self.kept
        ]

    def derivative(self, z: FloatArray, /) -> FloatArray:
        return self.transform.derivative(self._filled(self.transform.forward(self.values), z))[
            self.kept
        ]

    def _filled(self, values: FloatArray, part: FloatArray) -> FloatArray:
        whole = np.array(values, dtype=np.float64)
        whole[self.kept] = part
        return whole


def _part(prior: Gaussian, members: IntArray) -> Gaussian:
    """The marginal of some parameters."""
    return Gaussian(prior.mean[members], prior.covariance[np.ix_(members, members)])
