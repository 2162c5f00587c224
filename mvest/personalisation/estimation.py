"""Estimation of a case, from the generic valve to an estimate; read from `estimate_all` on.

Each step takes a `LinearisationPoint`, a closed valve with its linearised errors, and returns
another one or an estimate. Objects do not change, except that closures remember their last closed
state, which saves time and changes no number.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvest.cases.case import Role, ValveCase
from mvest.closure.frames import FramesModel, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.estimation.estimate import Estimate, OnIterate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction, of_some
from mvest.estimation.run import Filter
from mvest.estimation.transform import Log, to_filter
from mvest.personalisation.errors import FrameErrors, WeighedObservation, linearise, with_samples
from mvest.personalisation.fitted_frames import FittedFrames
from mvest.personalisation.model import CaseClosure, build_model, held_state, with_pressures
from mvest.personalisation.settings import STIFFENS, PersonaliseSettings, Prior
from mvest.personalisation.sources import ClosedValve
from mvest.problem.estimate import Observed, Problem, StudyResult, estimate
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.typing import FloatArray

ROUGH = 0.05
"""Relative tolerance of an estimate that serves as linearisation point."""

LEARNED = 4
"""Iterates in which errors are learned, if the start is an estimate without errors of geometry."""

SETTLED = 0.5
"""Distance of the moduli from the linearisation point, in standard deviations, that is enough: at
most 15 % of a modulus, where effects of the geometry are off by some 7 %."""

OnStep = Callable[[float, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPoint:
    """A closed valve, with its parameters ``m (p,)``, prediction and linearised errors."""

    registered: RegisteredModel
    errors: FrameErrors
    m: FloatArray
    prediction: Prediction

    @property
    def valve(self) -> ClosedValve:
        """The valve for `linearise`."""
        return ClosedValve(self.registered, self.m, self.prediction.y)

    def sampled(self) -> LinearisationPoint:
        """The point with the effect of the error samples of its case."""
        return replace(self, errors=with_samples(self.errors, self.valve))


@dataclass(frozen=True, slots=True, eq=False)
class CaseEstimate:
    """The estimate of all unknowns of a case."""

    result: StudyResult
    point: LinearisationPoint  #: of the last estimate
    #: Largest distance of a modulus from there in standard deviations; None if the geometry was
    #: linearised once only.
    moved: float | None = None
    #: Why some errors of geometry or law are not in the intervals.
    unaccounted: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CaseProblem:
    """The estimation problem of a case."""

    case: ValveCase
    #: With the errors of the pressures of several frames among the unknowns.
    settings: PersonaliseSettings
    #: (p,), the estimated ones: those of the closure in its order, then the displacement.
    unknowns: tuple[Prior, ...]
    prior: Gaussian  #: of these
    transform: Log
    fitted: FittedFrames
    closure: CaseClosure
    on_iterate: OnIterate | None = None

    @classmethod
    def of(
        cls,
        case: ValveCase,
        settings: PersonaliseSettings,
        store: Path | None = None,
        on_step: OnStep | None = None,
        on_iterate: OnIterate | None = None,
        model: ClosureModel | None = None,
    ) -> CaseProblem:
        """The problem of a case; the parameters are those of `personalise`.

        ``model`` comes from `build_model` and may have been closed.

        InputError if the case lacks an unknown, has error samples and several fitted frames, or
        errors of pressures are unknown but their common factor is not.
        """
        settings = with_pressures(case, settings)
        if case.fitted and case.error_samples is not None:
            raise InputError(
                f"case {case.name}: error samples and several fitted frames; expected one closed "
                "frame, or no samples"
            )
        if model is None:
            model = build_model(case, settings, store)
            model.on_step = on_step
        free = [u for u in settings.unknowns if not u.fixed]
        unknowns = tuple(sorted(free, key=lambda u: u.name in REGISTRATION))
        prior = Gaussian.from_variance(
            np.array([u.mean for u in unknowns]), np.array([u.std for u in unknowns]) ** 2
        )
        transform = Log(tuple(u.is_positive for u in unknowns))
        # Filters start here; the last bit may differ from the prior's mean.
        start = transform.inverse(transform.forward(prior.mean))
        several = None
        if case.fitted:
            closed = case.frame(Role.CLOSED)
            ordered = sorted(case.fitted, key=lambda f: abs(f.pressure_mmHg - closed.pressure_mmHg))
            states = {frame.name: held_state(model, frame) for frame in ordered}
            errors = tuple(u.name for u in settings.unknowns if is_frame_pressure(u.name))
            several = FramesModel(model, closed.name, states, closed.pressure_mmHg, errors)
        closure = CaseClosure.of(model, several, tuple(u.name for u in unknowns), start)
        names = None if several is None else several.frames
        fitted = FittedFrames(case, settings, model.valve, names)
        return cls(case, settings, unknowns, prior, transform, fitted, closure, on_iterate)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the estimated unknowns, ``(p,)``."""
        return tuple(u.name for u in self.unknowns)

    @property
    def moduli(self) -> list[int]:
        """Which unknowns are moduli."""
        return [k for k, u in enumerate(self.unknowns) if u.is_modulus]

    def generic(self) -> LinearisationPoint:
        """The generic valve, where every estimation starts; nothing is linearised yet."""
        start = self.closure.shared.start
        prediction = self.closure.shared(start)
        errors = FrameErrors(self.fitted.beside(prediction))
        return LinearisationPoint(self.closure.registered, errors, start, prediction)

    def filter(self, tolerance: float) -> IteratedFilter:
        """The filter of all unknowns, to a relative tolerance."""
        return IteratedFilter(tolerance, max_iterations=self.settings.max_iterations)

    def estimate(
        self, point: LinearisationPoint, filter_: Filter, observation: Observed
    ) -> StudyResult:
        """All unknowns by one run of a filter, with the errors of a point."""
        model, tissue = self.closure.shared, self.settings.mechanics.tissue
        whole = Problem(self.names, model, self.prior, filter_, self.transform, tissue)
        return self._estimated(point, whole, observation)

    def alternatives(self, point: LinearisationPoint) -> dict[str, StudyResult]:
        """The moduli alone: all else at its prior mean, with geometry and law known exactly.

        ``moduli_only`` and ``paper`` (by the paper's filter with its independent R), as the
        settings request. Tissue does not stiffen.
        """
        settings, moduli, shared = self.settings, np.array(self.moduli), self.closure.shared
        found: dict[str, StudyResult] = {}
        stiffens = [u.name.startswith(STIFFENS) for u in self.unknowns]
        known = np.where(stiffens, 0.0, shared.start)
        prior = Gaussian(self.prior.mean[moduli], self.prior.covariance[np.ix_(moduli, moduli)])
        names, filter_ = tuple(self.names[k] for k in moduli), self.filter(settings.tolerance)
        model, tissue = of_some(shared, known, moduli, snap=1e-14), settings.mechanics.tissue
        plain = Problem(names, model, prior, filter_, Log(), tissue)
        if settings.moduli_only:
            found["moduli_only"] = self._estimated(point, plain, point.errors.observation())
        if (paper := settings.paper) is not None:
            own = replace(
                plain,
                prior=Gaussian.from_variance(prior.mean, paper.P0),
                filter=PaperFilter(paper.Q, max_iterations=paper.max_iterations),
                transform=Log((False,) * len(moduli)),
            )
            found["paper"] = self._estimated(point, own, self.fitted.as_in_paper(paper))
        return found

    def _estimated(
        self, point: LinearisationPoint, problem: Problem, observation: Observed
    ) -> StudyResult:
        """An estimate, with the covariance from the error samples if its noise includes them."""
        result = estimate(problem, observation, on_iterate=self.on_iterate)
        filtered, samples = result.filtered, point.errors.samples
        weighed = samples is not None and isinstance(observation, WeighedObservation)
        if not weighed or filtered is None or filtered.prediction is None:
            return result
        assert samples is not None
        learned = filtered.learned
        if learned is not None:
            samples = point.errors.weighing(samples, learned)
        prior = to_filter(filtered.transform, filtered.prior)
        posterior = samples.posterior(slopes(filtered), prior.covariance, filtered.curvature)
        covariances = np.array(filtered.transformed_iterate_covariances)
        covariances[-1] = posterior.covariance
        if learned is not None:
            covariances[-1] += learned.covariance
        widened = replace(filtered, transformed_iterate_covariances=covariances)
        return replace(result, filtered=widened)


def slopes(filtered: Estimate) -> FloatArray:
    """Derivatives ``(k, p)`` of the observation at an estimate, in filter coordinates."""
    assert filtered.prediction is not None
    z = filtered.transformed_iterates[-1]
    return np.asarray(filtered.prediction.jacobian * filtered.transform.derivative(z))


def estimate_all(problem: CaseProblem, generic: LinearisationPoint) -> CaseEstimate:
    """Estimate all unknowns, with the errors of geometry and law.

    The effects of these errors depend on the moduli: at half the modulus, derivatives are off by a
    quarter. So a rough estimate without them gives the first linearisation point, and estimates
    with them give the next ones. The geometry stays the measured one. The generic valve has the
    effect of the error samples of its case, if there are any.
    """
    settings = problem.settings
    if settings.nuisance_geometry is None and not settings.nuisance_law:
        plain = problem.filter(settings.tolerance)
        return CaseEstimate(problem.estimate(generic, plain, generic.errors.observation()), generic)
    began = time.perf_counter()
    filter_ = problem.filter(max(ROUGH, settings.tolerance))
    rough = problem.estimate(generic, filter_, generic.errors.rough_observation())
    at = generic.m if rough.estimate is None else rough.estimate
    prediction = problem.closure.shared(at)
    if not prediction.converged:
        return CaseEstimate(rough, generic, unaccounted=(prediction.reason,))
    errors = FrameErrors(problem.fitted.beside(prediction))
    point = linearised(replace(generic, errors=errors, m=at, prediction=prediction))
    geometry, start, moved = settings.nuisance_geometry, at, None
    unaccounted = point.errors.unaccounted
    renewals = geometry.renewals if geometry is not None and point.errors.geometry else 0
    if problem.case.error_samples is not None:
        # The samples describe most of the geometry.
        point, renewals = point.sampled(), 0
    elif renewals:
        point, start, more = _relinearised(problem, point, renewals)
        unaccounted = tuple(dict.fromkeys((*point.errors.unaccounted, *more)))
    result = _estimate_about(problem, point, start)
    if renewals and result.filtered is not None:
        moved = _distance(problem, result, point)
    result = replace(result, seconds=time.perf_counter() - began)
    return CaseEstimate(result, point, moved, unaccounted)


def linearised(point: LinearisationPoint) -> LinearisationPoint:
    """The point with its errors of geometry and law."""
    return replace(point, errors=linearise(point.errors, point.valve))


def _estimate_about(
    problem: CaseProblem, point: LinearisationPoint, start: FloatArray, *, final: bool = True
) -> StudyResult:
    """Estimate all unknowns, from ``start (p,)`` on; the covariance is exact only if ``final``."""
    tolerance = problem.settings.tolerance
    filter_ = replace(
        problem.filter(tolerance if final else max(ROUGH, tolerance)),
        start=tuple(start.tolist()),
        max_learned=LEARNED,
        second_order=final,
    )
    return problem.estimate(point, filter_, point.errors.observation())


def _relinearised(
    problem: CaseProblem, point: LinearisationPoint, renewals: int
) -> tuple[LinearisationPoint, FloatArray, tuple[str, ...]]:
    """A linearisation point near its own estimate, that estimate ``(p,)``, and what went wrong.

    Each step goes to the estimate about the last point, while estimates come nearer to their
    points. They need not: effects of the geometry that are computed for too stiff a leaflet may
    make its estimate too soft, and conversely.
    """
    following, start, nearest = point, point.m, np.inf
    for k in range(renewals + 1):
        result = _estimate_about(problem, following, start, final=False)
        if result.filtered is None or result.estimate is None:
            return point, start, (f"about the estimate: {result.reason} ({result.detail})",)
        moved = _distance(problem, result, following)
        if moved >= nearest:
            break
        point, start, nearest = following, result.estimate, moved
        if moved < SETTLED or k == renewals:
            break
        prediction = problem.closure.shared(start)
        if not prediction.converged:
            return point, start, (f"about the estimate: {prediction.reason}",)
        following = linearised(replace(point, m=start, prediction=prediction))
        if not following.errors.geometry:
            return point, start, following.errors.unaccounted
    return point, start, ()


def _distance(problem: CaseProblem, result: StudyResult, point: LinearisationPoint) -> float:
    """Largest distance of an estimated modulus from a point, in standard deviations."""
    assert result.filtered is not None
    found, z = result.filtered.transformed, problem.transform.forward(point.m)
    moduli = problem.moduli
    return float(np.max(np.abs(found.mean - z)[moduli] / found.std[moduli]))
