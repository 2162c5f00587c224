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
from mvest.errors import GeometryError, InputError
from mvest.estimation.estimate import Estimate, OnIterate, Reason
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction, of_some, predict
from mvest.estimation.run import Filter
from mvest.estimation.transform import Log, to_filter
from mvest.personalisation.errors import FrameErrors, WeighedObservation, linearise, with_samples
from mvest.personalisation.fitted_frames import FittedFrames
from mvest.personalisation.geometry import displacement
from mvest.personalisation.joint import JointPosterior, damped_step
from mvest.personalisation.model import CaseClosure, build_model, held_state, with_pressures
from mvest.personalisation.settings import STIFFENS, PersonaliseSettings, Prior
from mvest.personalisation.sources import ClosedValve
from mvest.problem.estimate import Observed, Problem, StudyResult, estimate
from mvest.problem.registration import REGISTRATION
from mvest.typing import FloatArray

ROUGH = 0.05
"""Relative tolerance of an estimate that serves as linearisation point."""

LEARNED = 4
"""Iterates in which errors are learned, if the start is an estimate without errors of geometry."""

SETTLED = 0.25
"""Distance of the moduli from the linearisation point, in standard deviations, that is enough."""

OnStep = Callable[[float, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPoint:
    """A closed valve, with its parameters ``m (p,)``, prediction and linearised errors."""

    closure: CaseClosure
    errors: FrameErrors
    m: FloatArray
    prediction: Prediction

    @property
    def valve(self) -> ClosedValve:
        """The valve for `linearise`."""
        return ClosedValve(self.closure.registered, self.m, self.prediction.y)

    def sampled(self) -> LinearisationPoint:
        """The point with the effect of the error samples of its case."""
        return replace(self, errors=with_samples(self.errors, self.valve))


@dataclass(frozen=True, slots=True, eq=False)
class CaseEstimate:
    """The estimate of all unknowns of a case."""

    result: StudyResult
    point: LinearisationPoint  #: of the last estimate
    #: Largest distance of a modulus from there in standard deviations; None if the geometry was
    #: linearised about the measured one only.
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
    stated: CaseClosure  #: of the valve as the case states it
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
        stated = CaseClosure.of(model, several, tuple(u.name for u in unknowns), start)
        names = None if several is None else several.frames
        fitted = FittedFrames(case, settings, model.valve, names)
        return cls(case, settings, unknowns, prior, transform, fitted, stated, on_iterate)

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
        start = self.stated.shared.start
        prediction = self.stated.shared(start)
        errors = FrameErrors(self.fitted.beside(prediction))
        return LinearisationPoint(self.stated, errors, start, prediction)

    def filter(self, tolerance: float) -> IteratedFilter:
        """The filter of all unknowns, to a relative tolerance."""
        return IteratedFilter(tolerance, max_iterations=self.settings.max_iterations)

    def estimate(
        self, point: LinearisationPoint, filter_: Filter, observation: Observed
    ) -> StudyResult:
        """All unknowns by one run of a filter, with the closure and the errors of a point."""
        model, tissue = point.closure.shared, self.settings.mechanics.tissue
        whole = Problem(self.names, model, self.prior, filter_, self.transform, tissue)
        return self._estimated(point, whole, observation)

    def alternatives(self, point: LinearisationPoint) -> dict[str, StudyResult]:
        """The moduli alone: all else at its prior mean, with geometry and law known exactly.

        ``moduli_only`` and ``paper`` (by the paper's filter with its independent R), as the
        settings request. Tissue does not stiffen.
        """
        settings, moduli, shared = self.settings, np.array(self.moduli), point.closure.shared
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
    quarter. So a rough estimate without them gives the first linearisation point. The generic valve
    has the effect of the error samples of its case, if there are any.
    """
    settings = problem.settings
    if settings.nuisance_geometry is None and not settings.nuisance_law:
        plain = problem.filter(settings.tolerance)
        return CaseEstimate(problem.estimate(generic, plain, generic.errors.observation()), generic)
    began = time.perf_counter()
    filter_ = problem.filter(max(ROUGH, settings.tolerance))
    rough = problem.estimate(generic, filter_, generic.errors.rough_observation())
    at = generic.m if rough.estimate is None else rough.estimate
    prediction = generic.closure.shared(at)
    if not prediction.converged:
        return CaseEstimate(rough, generic, unaccounted=(prediction.reason,))
    plain_errors = FrameErrors(problem.fitted.beside(prediction))
    point = linearised(LinearisationPoint(generic.closure, plain_errors, at, prediction), problem)
    moved, unaccounted, first = None, point.errors.unaccounted, point
    if problem.case.error_samples is not None:
        # The samples describe the geometry, so it has no other posterior mean.
        point = point.sampled()
    elif point.errors.geometry:
        point, moved, more = _relinearised(problem, point)
        unaccounted = point.errors.unaccounted + more
    result = _estimate_about(problem, point)
    if not result.converged and point.errors.displaced_by:
        reason = f"about the expected geometry: {result.reason} ({result.detail})"
        point, moved, unaccounted = first, None, (*first.errors.unaccounted, reason)
        result = _estimate_about(problem, point)
    result = replace(result, seconds=time.perf_counter() - began)
    return CaseEstimate(result, point, moved, unaccounted)


def linearised(point: LinearisationPoint, problem: CaseProblem) -> LinearisationPoint:
    """The point with its errors of geometry and law."""
    seen = problem.stated.model if point.errors.displaced_by else None
    return replace(point, errors=linearise(point.errors, point.valve, seen))


def _estimate_about(
    problem: CaseProblem, point: LinearisationPoint, *, final: bool = True
) -> StudyResult:
    """Estimate all unknowns, starting at ``point``; the covariance is exact only if ``final``."""
    tolerance = problem.settings.tolerance
    filter_ = replace(
        problem.filter(tolerance if final else max(ROUGH, tolerance)),
        start=tuple(point.m.tolist()),
        max_learned=LEARNED,
        second_order=final,
    )
    return problem.estimate(point, filter_, point.errors.observation())


def _relinearised(
    problem: CaseProblem, point: LinearisationPoint
) -> tuple[LinearisationPoint, float | None, tuple[str, ...]]:
    """The joint mode of parameters and geometry, by Gauss-Newton steps from ``point``.

    Each step displaces the geometry of the closure; the prior of its errors stays about the
    measured one. Also the distance of the moduli from there (`CaseEstimate.moved`), and why
    the steps ended early.
    """
    nuisance = problem.settings.nuisance_geometry
    assert nuisance is not None
    result, moved, why = None, None, ""
    for _ in range(nuisance.renewals):
        before = result or _estimate_about(problem, point, final=False)
        found = _nearer(problem, before, point)
        if found is point:
            return point, _distance(problem, before, point), ()
        if isinstance(found, str):
            why = found
            break
        found = linearised(found, problem)
        if not found.errors.geometry:
            why = "; ".join(found.errors.unaccounted)
            break
        trial = _estimate_about(problem, found, final=False)
        # Out of iterations, it still leads on: a next point must be more probable than this one.
        unfinished = trial.filtered is not None and trial.filtered.reason is Reason.MAX_ITERATIONS
        if not (trial.converged or unfinished):
            why = f"{trial.reason} ({trial.detail})"
            break
        point, result = found, trial
        moved = _distance(problem, result, point)
        if moved < SETTLED:
            break
    return point, moved, (f"about the expected geometry: {why}",) if why else ()


def _distance(problem: CaseProblem, result: StudyResult, point: LinearisationPoint) -> float:
    """Largest distance of an estimated modulus from a point, in standard deviations."""
    assert result.filtered is not None
    found, z = result.filtered.transformed, problem.transform.forward(point.m)
    moduli = problem.moduli
    return float(np.max(np.abs(found.mean - z)[moduli] / found.std[moduli]))


def _nearer(
    problem: CaseProblem, result: StudyResult, point: LinearisationPoint
) -> LinearisationPoint | str:
    """A more probable point towards the estimate and its expected geometry, or why there is none.

    ``point`` itself if it is as good.
    """
    filtered, residual = result.filtered, result.residual
    posterior = joint(problem, result, point.errors)
    if posterior is None or filtered is None or residual is None:
        return result.reason
    z, H = filtered.transformed.mean, slopes(filtered)
    # A filter stops before its last small step; this step takes it.
    end = posterior.step(z, residual, H)
    residual = residual - H @ (end - z)
    modes = posterior.expected(residual)
    begin = problem.transform.forward(point.m)
    was = point.errors.displaced_by or tuple(np.zeros_like(one) for one in modes)
    here = posterior.misfit_at(point.m, point.prediction, point.errors.displaced_by)
    offset = point.errors.offset(modes)
    predicted = here - posterior.misfit(end, residual - offset, modes)

    def trial(share: float) -> tuple[float, LinearisationPoint] | str:
        return _displaced(
            problem,
            tuple(a + share * (b - a) for a, b in zip(was, modes, strict=True)),
            problem.transform.inverse(begin + share * (end - begin)),
            posterior,
        )

    found = damped_step(trial, here, predicted)
    if found == "" and predicted < SETTLED**2:
        # To first order the gain is the squared distance in standard deviations.
        return point
    return found or "no step towards it fits the observation better"


def joint(problem: CaseProblem, result: StudyResult, errors: FrameErrors) -> JointPosterior | None:
    """Of parameters and geometry about an estimate; None without either."""
    filtered = result.filtered
    if filtered is None or filtered.prediction is None or not errors.geometry:
        return None
    prior = to_filter(problem.transform, problem.prior)
    measured = errors.measured()
    return JointPosterior(prior, problem.transform, measured, errors, filtered.learned)


def _displaced(
    problem: CaseProblem, modes: tuple[FloatArray, ...], m: FloatArray, posterior: JointPosterior
) -> tuple[float, LinearisationPoint] | str:
    """Misfit and point of the valve displaced by modes, or why it does not close.

    It is closed at ``m (p,)``, then with the best parameters for this geometry.
    """
    kinds = [source.modes for source in posterior.errors.geometry if source.modes is not None]
    try:
        closure = problem.stated.displaced(displacement(kinds, modes), m)
    except GeometryError as error:  # a leaflet without thickness, a mesh that is torn
        return str(error)
    first = closure.shared(m)
    if not first.converged:
        return first.reason
    errors = posterior.errors.displaced(modes)
    better = posterior.refitted(m, first)
    again = predict(closure.shared, better)
    tried = [(m, first), (better, again)] if again.converged else [(m, first)]
    found = [
        (posterior.misfit_at(at, y, modes), LinearisationPoint(closure, errors, at, y))
        for at, y in tried
    ]
    return min(found, key=lambda one: one[0])
